// Which log is whose: what recognition weighs, side by side, and somebody confirms one.

import { sharpContext } from "/static/canvas.mjs";
import { ask, askPicture, send } from "/static/server.mjs";
import { number, plain } from "/static/words.mjs";

const element = (id) => document.getElementById(id);
const SHOTS = 3;
const ASK_MS = 700;
const LINES = { box: "#f0a030", place: "#ffffff" };

export class Whose {
  /**
   * @param {object} page What the page offers: `frame()`, `goTo`, `show`, `say`, `confirmed`.
   */
  constructor(page) {
    this.page = page;
    this.list = [];
    this.chosen = null;
    this.known = "";
    this.timer = 0;
    element("weigh").addEventListener("click", () => this.weigh());
  }

  async open() {
    try {
      this.take(await ask("/api/candidates"));
    } catch (error) {
      this.page.say(error.message, "refused");
    }
  }

  async weigh() {
    try {
      this.take(await send("POST", "/api/candidates"));
    } catch (error) {
      this.page.say(error.message, "refused");
    }
  }

  take(told) {
    clearTimeout(this.timer);
    const running = told.state === "running";
    element("weigh").disabled = running;
    element("weigh").textContent = told.state === "idle" ? "Weigh" : "Weigh anew";
    const line = element("whose-state");
    line.dataset.state = told.state === "failed" ? "refused" : "";
    line.textContent = stateWords(told);
    element("whose-progress").hidden = !running;
    if (told.share === null) element("whose-progress").removeAttribute("value");
    else element("whose-progress").value = told.share;
    if (running) {
      this.timer = setTimeout(() => this.open(), ASK_MS);
      return;
    }
    this.feed = told.feed;
    const known = JSON.stringify(told.candidates);
    if (known === this.known) return;
    this.known = known;
    this.list = told.candidates;
    this.chosen = null;
    element("candidates").replaceChildren(...this.list.map((one, i) => this.card(one, i)));
    this.paint();
  }

  card(one, i) {
    const item = document.createElement("li");
    const title = document.createElement("h3");
    title.textContent = `${i + 1}: ${plain(one.vessel || "the logged vessel")}`;
    const odds = document.createElement("p");
    odds.className = "odds";
    odds.textContent = oddsWords(one.probability);
    const told = document.createElement("p");
    told.className = "hint";
    const more = one.evidence >= 0 ? "likelier" : "less likely";
    told.textContent = `${Math.abs(one.evidence).toFixed(0)} nats ${more} than no logged vessel; `
      + `${one.boxes.length} boxes to label of ${one.seen} (${one.sources.map(plain).join(", ")}); `
      + `clock ${number(one.clock_offset_s)} s ahead.${this.together(one)}`;
    const shots = document.createElement("div");
    shots.className = "shots";
    for (const box of spread(one.boxes)) shots.append(this.shot(one, box));
    const actions = document.createElement("div");
    actions.className = "actions";
    const show = button("Show", `Show candidate ${i + 1} in the picture (${i + 1})`, () => this.choose(i));
    show.setAttribute("aria-pressed", "false");
    const confirm = button("It is this one", `Label candidate ${i + 1} as the logged vessel`, () => this.confirm(i));
    confirm.classList.add("main");
    actions.append(show, confirm);
    item.append(title, odds, shots, told, actions);
    return item;
  }

  /** The other vessels of the same explanation, with which it stands or falls. */
  together(one) {
    const others = this.list.filter((each) => each !== one && each.explanation === one.explanation);
    return others.length ? ` Together with ${others.map((each) => plain(each.vessel)).join(", ")}.` : "";
  }

  /** The picture around a box, with the box, and the log's place by this explanation. */
  shot(one, { frame, box_px: box, place_px: place }) {
    const canvas = document.createElement("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Frame ${frame}: its box, and the place of the log`);
    const middle = [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
    const size = this.page.size();
    const half = Math.min(Math.max(1.3 * (box[2] - box[0]), 2.2 * (box[3] - box[1]), 32), 300);
    const wide = Math.min(Math.round(2 * half), size[0], 640);
    const tall = Math.min(Math.round((wide * 9) / 16), size[1], 640);
    const left = Math.round(Math.min(Math.max(middle[0] - wide / 2, 0), size[0] - wide));
    const top = Math.round(Math.min(Math.max(middle[1] - tall / 2, 0), size[1] - tall));
    askPicture(`/frames/${frame}.png?x=${left}&y=${top}&width=${wide}&height=${tall}`).then((bitmap) => {
      const context = sharpContext(canvas);
      const scale = canvas.clientWidth / wide;
      context.drawImage(bitmap, 0, 0, wide * scale, tall * scale);
      const at = ([x, y]) => [(x - left) * scale, (y - top) * scale];
      const [x1, y1] = at([box[0], box[1]]);
      const [x2, y2] = at([box[2], box[3]]);
      for (const [style, width] of [["rgba(0, 0, 0, 0.6)", 3], [LINES.box, 1.5]]) {
        context.strokeStyle = style;
        context.lineWidth = width;
        context.strokeRect(x1, y1, x2 - x1, y2 - y1);
      }
      if (!place) return;
      const [x, y] = at(place);
      for (const [style, width] of [["rgba(0, 0, 0, 0.7)", 4], [LINES.place, 1.8]]) {
        context.strokeStyle = style;
        context.lineWidth = width;
        context.beginPath();
        context.moveTo(x - 6, y);
        context.lineTo(x + 6, y);
        context.moveTo(x, y - 6);
        context.lineTo(x, y + 6);
        context.stroke();
      }
    }).catch(() => {
      // The words beside it say enough.
    });
    return canvas;
  }

  /** Show a candidate in the picture, from the frame in its middle on. */
  choose(i) {
    if (i >= this.list.length) return;
    this.chosen = i;
    const buttons = element("candidates").querySelectorAll("[aria-pressed]");
    buttons.forEach((one, j) => one.setAttribute("aria-pressed", String(i === j)));
    const { boxes } = this.list[i];
    this.page.goTo(boxes[Math.floor(boxes.length / 2)].frame);
    this.page.say(`candidate ${i + 1}: n and p lead through its frames`);
  }

  /** Its next frame, or the one before. */
  step(way) {
    if (this.chosen === null) {
      this.choose(0);
      return;
    }
    const frames = this.list[this.chosen].boxes.map((one) => one.frame);
    const now = this.page.frame();
    const after = way > 0 ? frames.find((one) => one > now) : frames.findLast((one) => one < now);
    this.page.goTo(after ?? (way > 0 ? frames[0] : frames.at(-1)));
  }

  paint() {
    const lines = [];
    const spots = [];
    const one = this.chosen === null ? null : this.list[this.chosen];
    const seen = one?.boxes.find((each) => each.frame === this.page.frame());
    if (seen) {
      const [x1, y1, x2, y2] = seen.box_px;
      lines.push({
        points: [[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]], style: LINES.box, width: 2, dash: [6, 3],
      });
      if (seen.place_px) {
        spots.push({ pixel: seen.place_px, style: LINES.place, label: plain(one.vessel || "log") });
      }
    }
    this.page.show(lines, spots);
  }

  async confirm(i = this.chosen) {
    if (i === null || i >= this.list.length) {
      this.page.say("show a candidate first (1 to 9)", "refused");
      return;
    }
    try {
      const told = await send("POST", "/api/candidates/confirm", { number: this.list[i].number });
      this.page.confirmed(told);
      this.page.say(`candidate ${i + 1}: ${told.count} boxes are labelled as the logged vessel's`);
    } catch (error) {
      this.page.say(error.message, "refused");
    }
  }
}

function stateWords(told) {
  if (told.state === "idle") {
    return "All that moves is held against the log, as a fit without drawn boxes does it. "
      + "Finding the boxes takes some minutes where the scene has no detections.";
  }
  if (told.state === "running") return `${told.doing[0].toUpperCase()}${told.doing.slice(1)} …`;
  if (told.state === "failed") return plain(told.reason);
  if (!told.candidates.length) return "Nothing that is seen here moves as a log says.";
  const none = 100 * told.others;
  return `${told.candidates.length} ${told.candidates.length === 1 ? "candidate" : "candidates"}. `
    + `That it is none of them has ${none < 1 ? "less than 1" : none.toFixed(0)} %.`;
}

/** A probability as odds, which say more of what is nearly sure. */
function oddsWords(probability) {
  const odds = probability / Math.max(1 - probability, 1e-12);
  const said = odds >= 1000 ? "over 1000 : 1" : odds >= 1 ? `${odds.toFixed(odds < 10 ? 1 : 0)} : 1`
    : odds <= 1e-3 ? "under 1 : 1000" : `1 : ${(1 / odds).toFixed(1 / odds < 10 ? 1 : 0)}`;
  return `Odds ${said}`;
}

function spread(boxes) {
  if (boxes.length <= SHOTS) return boxes;
  return Array.from({ length: SHOTS }, (_, k) =>
    boxes[Math.round(((k + 0.5) * boxes.length) / SHOTS - 0.5)]);
}

function button(text, label, action) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.title = label;
  // The words that are seen are part of the name.
  made.setAttribute("aria-label", `${text}: ${label}`);
  made.addEventListener("click", action);
  return made;
}
