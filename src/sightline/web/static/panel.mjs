// What stands beside the map: the list, the chosen target, health. All names are set as text.

import { degreesMinutes, ellipse } from "/static/geometry.mjs";
import { course, kind, label, metres, mmsi, number, plain, speed, time, title } from "/static/words.mjs";

const element = (id) => document.getElementById(id);

function put(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Fill a list of terms, reusing what is there. */
function fill(list, rows) {
  while (list.children.length > 2 * rows.length) list.lastChild.remove();
  rows.forEach(([term, value], i) => {
    if (list.children.length <= 2 * i) {
      list.append(document.createElement("dt"), document.createElement("dd"));
    }
    put(list.children[2 * i], term);
    put(list.children[2 * i + 1], value);
  });
}

export class Panel {
  /** @param {(id: number | null) => void} choose Called with the target that was picked. */
  constructor(choose) {
    this.choose = choose;
    this.rows = new Map();
    this.body = element("targets");
    this.body.addEventListener("keydown", (event) => this.move(event));
    element("release").addEventListener("click", () => choose(null));
  }

  /** Up and down go from row to row. */
  move(event) {
    const way = { ArrowDown: "nextElementSibling", ArrowUp: "previousElementSibling" }[event.key];
    const button = way && event.target.closest("tr")?.[way]?.querySelector("button");
    if (button) {
      button.focus();
      event.preventDefault();
    }
  }

  row(id) {
    const row = document.createElement("tr");
    const button = document.createElement("button");
    button.type = "button";
    button.addEventListener("click", () =>
      this.choose(row.getAttribute("aria-selected") === "true" ? null : id));
    const cells = Array.from({ length: 5 }, () => document.createElement("td"));
    cells[0].append(button);
    row.append(...cells);
    this.rows.set(id, { row, button, cells });
    return this.rows.get(id);
  }

  list(targets, chosen, units) {
    const present = new Set(targets.map((one) => one.id));
    for (const [id, { row }] of this.rows) {
      if (!present.has(id)) {
        row.remove();
        this.rows.delete(id);
      }
    }
    const sorted = [...targets].sort((one, other) => one.id - other.id);
    let before = null;
    for (const one of sorted) {
      const { row, button, cells } = this.rows.get(one.id) ?? this.row(one.id);
      const place = before ? before.nextSibling : this.body.firstChild;
      if (row !== place) this.body.insertBefore(row, place);
      before = row;
      row.dataset.kind = kind(one);
      row.setAttribute("aria-selected", String(one.id === chosen));
      button.setAttribute("aria-pressed", String(one.id === chosen));
      put(button, title(one));
      button.title = title(one);
      put(cells[1], one.state);
      put(cells[2], speed(one.speed_mps, units));
      put(cells[3], course(one));
      put(cells[4], metres(ellipse(one.covariance_m2).major_m));
    }
    put(element("targets-title"), `Targets (${targets.length})`);
    put(element("speed-unit"), units);
    element("none").hidden = targets.length > 0;
  }

  detail(target, chosen, units) {
    const section = element("chosen-section");
    section.hidden = chosen === null;
    if (chosen === null) return;
    if (!target) {
      // The heading stays, so that one sees whose track has ended.
      fill(element("chosen"), [["state", "not seen now"]]);
      return;
    }
    const shape = ellipse(target.covariance_m2);
    const place = [
      degreesMinutes(target.latitude_deg, "NS"), degreesMinutes(target.longitude_deg, "EW"),
    ].join(", ");
    const share = (value) => `${Math.round(100 * value)} %`;
    put(element("chosen-title"), title(target));
    fill(element("chosen"), [
      ["number", String(target.id)],
      ["MMSI", target.mmsi === null ? "unidentified" : mmsi(target)],
      ...(target.match === null ? [] : [["match", share(target.match)]]),
      ["state", target.state],
      ["position", place],
      ["speed", `${speed(target.speed_mps, units)} ${units}`],
      ["course", course(target)],
      ["95 % ellipse", `± ${metres(shape.major_m)} m (${Math.round(shape.bearing_deg)}°), `
        + `± ${metres(shape.minor_m)} m`],
      ...(target.confidence === null ? [] : [["confidence of the box", share(target.confidence)]]),
    ]);
  }

  health(told) {
    const state = element("health-state");
    const fine = told.state === "ok";
    state.dataset.state = fine ? "ok" : "bad";
    const reason = told.reason ? `: ${plain(told.reason)}` : "";
    put(state, fine ? "All is well." : `${plain(told.state ?? "unknown")}${reason}`);
    const rows = [];
    const visit = (table, before) => {
      for (const [key, value] of Object.entries(table)) {
        if (!before && (key === "state" || key === "reason")) continue;
        if (value !== null && typeof value === "object") {
          if (!Array.isArray(value)) visit(value, `${before}${label(key)}: `);
        } else if (key.endsWith("_utc_s") && typeof value === "number") {
          rows.push([`${before}${label(key)}`, time(1000 * value, "UTC")]);
        } else if (typeof value === "number" || typeof value === "boolean") {
          rows.push([`${before}${label(key)}`, number(value)]);
        } else {
          rows.push([`${before}${label(key)}`, value === null ? "–" : plain(value)]);
        }
      }
    };
    visit(told, "");
    fill(element("health"), rows.slice(0, 60));
  }
}
