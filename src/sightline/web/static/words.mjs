// How things are called and written.

const KNOTS_PER_MPS = 3600 / 1852;

// Controls, and marks of no width that turn or hide what is beside them.
const UNSEEN =
  /[\u0000-\u001f\u007f-\u009f\u00ad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb]/gu;

/** A name from outside, without what cannot be seen. It is only ever shown as text. */
export function plain(name) {
  return String(name).replace(UNSEEN, "\ufffd");
}

export function title(target) {
  if (target.name) return plain(target.name);
  return target.mmsi === null ? `target ${target.id}` : `MMSI ${mmsi(target)}`;
}

export function mmsi(target) {
  return String(target.mmsi).padStart(9, "0");
}

export function kind(target) {
  if (target.state === "moored") return "moored";
  return target.mmsi === null ? "unidentified" : "identified";
}

export function speed(mps, units) {
  if (mps === null) return "–";
  return (mps * (units === "kn" ? KNOTS_PER_MPS : 3.6)).toFixed(1);
}

export function course(target) {
  if (target.course_deg === null || target.state === "moored") return "–";
  return `${String(Math.round(target.course_deg) % 360).padStart(3, "0")}°`;
}

/** Metres with as many digits as say something. */
export function metres(value) {
  return value < 10 ? value.toFixed(1) : value.toFixed(0);
}

export function time(milliseconds, zone) {
  const date = new Date(milliseconds);
  if (Number.isNaN(date.getTime())) return "–";
  if (zone === "UTC") return `${date.toISOString().slice(0, 19).replace("T", " ")} UTC`;
  const two = (number) => String(number).padStart(2, "0");
  const day = `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}`;
  return `${day} ${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())} local`;
}

/** A key of health as words: `frames_left_out` → frames left out, `age_s` → age, s. */
export function label(key) {
  const words = plain(key).replaceAll("_", " ");
  return words.replace(/(?<! per)(?: utc)? (s|m|px|deg|mps|ms|bytes|hz)$/u, (all, unit) =>
    all.startsWith(" utc") ? "" : `, ${unit}`);
}

export function number(value) {
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (Number.isInteger(value)) return value.toLocaleString("en");
  return Math.abs(value) >= 100 ? value.toFixed(0) : String(Number(value.toPrecision(3)));
}
