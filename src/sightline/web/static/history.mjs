// What was kept, replayed, and which targets are shown.

import { kind, plain, time } from "/static/words.mjs";

const CHUNK_S = 60;
const SPEEDS = [1, 10, 60];
const SHOWN = {
  all: () => true,
  named: (one) => Boolean(one.name) || one.mmsi !== null,
  unnamed: (one) => !one.name && one.mmsi === null,
  moving: (one) => kind(one) !== "moored" && one.speed_mps > 0.5,
  moored: (one) => kind(one) === "moored",
};

function make(name, properties = {}, ...children) {
  const node = Object.assign(document.createElement(name), properties);
  node.append(...children);
  return node;
}

/** Which targets are shown: by what they do, and by their class. */
export class Filter {
  /** @param {() => void} changed Called when another choice was made. */
  constructor(changed) {
    const options = Object.keys(SHOWN).map((name) => make("option", { value: name, textContent: name }));
    this.which = make("select", { id: "filter", onchange: changed, title: "Targets that are shown" }, ...options);
    this.which.setAttribute("aria-label", "Targets that are shown");
    this.classes = make("select", { id: "filter-class", onchange: changed, hidden: true });
    this.classes.setAttribute("aria-label", "Class that is shown");
    this.classes.append(make("option", { value: "", textContent: "every class" }));
    this.known = new Set();
  }

  apply(targets) {
    for (const { label } of targets) {
      if (!label || this.known.has(label) || this.known.size > 50) continue;
      this.known.add(label);
      this.classes.append(make("option", { value: label, textContent: plain(label) }));
      this.classes.hidden = false;
    }
    const shown = SHOWN[this.which.value];
    const label = this.classes.value;
    return targets.filter((one) => shown(one) && (!label || one.label === label));
  }
}

/** Replays what was kept, a chunk at a time. */
export class Replay {
  /**
   * @param {(moment: object | null) => void} show Called with the moment to show; null: live again.
   * @param {() => string} zone `UTC` or `local`.
   */
  constructor(show, zone) {
    this.show = show;
    this.zone = zone;
    this.on = false;
    this.playing = false;
    this.atS = 0;
    this.chunks = new Map();
    this.asked = 0;
    this.toggleButton = make("button", {
      type: "button", id: "replay", textContent: "Replay", title: "Replay what was kept (r)",
      onclick: () => this.toggle(),
    });
    this.toggleButton.setAttribute("aria-pressed", "false");
    this.playButton = make("button", {
      type: "button", id: "play", textContent: "Play", title: "Play or pause (p)", onclick: () => this.play(),
    });
    this.slider = make("input", {
      type: "range", id: "replay-time", step: 1, oninput: () => this.seek(Number(this.slider.value)),
    });
    this.slider.setAttribute("aria-label", "Time that is shown");
    this.speed = make("select", { id: "replay-speed" },
      ...SPEEDS.map((one) => make("option", { value: one, textContent: `${one}×` })));
    this.speed.setAttribute("aria-label", "Speed of the replay");
    this.output = make("output", { id: "replay-clock", className: "numbers" });
    this.controls = make("div", { className: "replay", hidden: true },
      this.playButton, this.slider, this.speed, this.output);
    setInterval(() => this.tick(), 250);
  }

  async toggle() {
    if (this.on) {
      this.on = this.playing = false;
      this.show(null);
    } else {
      const extent = await this.fetch("/api/kept");
      if (!extent || extent.from_utc_s === null) return;
      this.slider.min = Math.floor(extent.from_utc_s);
      this.slider.max = Math.floor(extent.to_utc_s);
      this.chunks.clear();
      this.on = true;
      await this.seek(Math.max(extent.to_utc_s - 300, extent.from_utc_s));
    }
    this.controls.hidden = !this.on;
    this.toggleButton.textContent = this.on ? "Live" : "Replay";
    this.toggleButton.setAttribute("aria-pressed", String(this.on));
    this.write();
    if (this.on) this.slider.focus();
  }

  play() {
    if (!this.on) return;
    this.playing = !this.playing;
    if (this.playing && this.atS >= Number(this.slider.max)) this.atS = Number(this.slider.min);
    this.write();
  }

  write() {
    this.playButton.textContent = this.playing ? "Pause" : "Play";
    const text = time(1000 * this.atS, this.zone());
    this.output.textContent = text;
    this.slider.setAttribute("aria-valuetext", text);
    if (document.activeElement !== this.slider || this.playing) this.slider.value = this.atS;
  }

  tick() {
    if (!this.playing) return;
    const atS = this.atS + 0.25 * Number(this.speed.value);
    if (atS >= Number(this.slider.max)) this.playing = false;
    this.seek(Math.min(atS, Number(this.slider.max)));
  }

  /** Show the moment at a time: the last of the three seconds before it. */
  async seek(atS) {
    this.atS = atS;
    this.write();
    const number = ++this.asked;
    const first = Math.floor(atS / CHUNK_S);
    const moments = await this.chunk(first);
    const before = atS % CHUNK_S < 3 ? await this.chunk(first - 1) : [];
    // Whoever moved on meanwhile wants to see something else.
    if (number !== this.asked || !this.on) return;
    const seen = [...before, ...moments].filter((one) => one.atS <= atS + 1);
    const last = seen.at(-1);
    this.show(last && last.atS > atS - 3
      ? last.moment
      : { time_utc: new Date(1000 * atS).toISOString(), targets: [], camera: null });
  }

  async chunk(number) {
    if (!this.chunks.has(number)) {
      const told = await this.fetch(`/api/replay?at=${CHUNK_S * number}&seconds=${CHUNK_S}`);
      if (!told) return [];
      if (this.chunks.size > 20) this.chunks.delete(this.chunks.keys().next().value);
      this.chunks.set(number, told.moments.map((moment) => ({
        moment, atS: Date.parse(moment.time_utc) / 1000,
      })));
      // The end is still being written.
      if ((number + 1) * CHUNK_S > Number(this.slider.max)) setTimeout(() => this.chunks.delete(number), 2000);
    }
    return this.chunks.get(number) ?? [];
  }

  async fetch(path) {
    try {
      const answer = await fetch(path, { cache: "no-store" });
      return answer.ok ? await answer.json() : null;
    } catch {
      return null;
    }
  }
}
