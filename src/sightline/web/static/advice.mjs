// What the fit makes of the boxes so far. All names are set as text.

import { metres, number, plain } from "/static/words.mjs";

const element = (id) => document.getElementById(id);

const MOST_ODD = 5;

export class Advice {
  /** @param {(frame: number) => void} goTo Called with the frame of an odd box. */
  constructor(goTo) {
    this.goTo = goTo;
    this.odd = "";
    this.rows = "";
  }

  /**
   * @param {object} told As the server has it.
   * @param {string} recording Whose odd boxes can be gone to.
   */
  show(told, recording) {
    const line = element("advice-state");
    let [word, text] = ["idle", "No fit yet."];
    if (told.error) [word, text] = ["failed", plain(told.error)];
    else if (told.rmse_m !== null) {
      text = `${told.boxes} boxes lie ${metres(told.rmse_m)} m RMSE from the log`
        + `${told.left_out ? ", each by a fit without it" : ""}.`;
    }
    line.dataset.state = word;
    element("advice-section").dataset.running = String(told.running);
    put(element("advice-running"), told.running ? "Fitting …" : "");
    put(line, text);
    const enough = element("advice-enough");
    enough.dataset.enough = String(told.enough);
    put(enough, plain(told.reason));
    this.showOdd(told.odd, recording);
    element("thin-row").hidden = !told.thin.length;
    const rows = told.axis_m === null ? []
      : [["95 % ellipse", `± ${metres(told.axis_m)} m`]];
    if (told.gain !== null) rows.push(["with ten boxes more", `−${Math.round(100 * told.gain)} %`]);
    for (const one of told.parameters) {
      const sigma = one.sigma === null ? "" : ` ± ${number(one.sigma)}`;
      const value = one.value === null ? "–" : number(one.value);
      const unsure = one.determined ? "" : " (not determined)";
      rows.push([plain(one.name).replace(/_(?:m|deg|px)$/u, "").replaceAll("_", " ") + unsure,
        `${value}${sigma} ${one.unit === "degrees" ? "°" : one.unit}`.trim()]);
    }
    const known = JSON.stringify(rows);
    if (known === this.rows) return;
    this.rows = known;
    element("camera").replaceChildren(...rows.flatMap(([term, value]) => {
      const pair = [document.createElement("dt"), document.createElement("dd")];
      put(pair[0], term);
      put(pair[1], value);
      return pair;
    }));
  }

  showOdd(odd, recording) {
    element("odd-section").hidden = !odd.length;
    const known = JSON.stringify(odd);
    put(element("odd-title"), odd.length > MOST_ODD ? `Odd boxes (${odd.length})` : "Odd boxes");
    // A list that stays as it was keeps the focus that somebody has set.
    if (known === this.odd) return;
    this.odd = known;
    element("odd").replaceChildren(...odd.slice(0, MOST_ODD).map((one) => {
      const item = document.createElement("li");
      const why = document.createElement("span");
      why.textContent = plain(one.why);
      if (one.recording === recording) {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = `frame ${one.frame}`;
        button.addEventListener("click", () => this.goTo(one.frame));
        item.append(button);
      }
      item.append(why);
      return item;
    }));
  }
}

function put(node, text) {
  if (node.textContent !== text) node.textContent = text;
}
