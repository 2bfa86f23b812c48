// The camera's picture, with the boxes of the targets.

import { kind, title } from "/static/words.mjs";

const EVERY_MS = 400;
const AGAIN_MS = 10_000;
// On pictures, which are of any brightness, those of the dark theme are seen better.
const COLOURS = { identified: "#56b4e9", unidentified: "#f0a030", moored: "#d3dae1" };

export class Picture {
  /**
   * @param {HTMLElement} figure Hidden while there is no picture.
   * @param {HTMLCanvasElement} canvas What is drawn on.
   * @param {(id: number | null) => void} choose Called with the target that was clicked.
   */
  constructor(figure, canvas, choose) {
    this.figure = figure;
    this.canvas = canvas;
    this.targets = [];
    this.chosen = null;
    this.bitmap = null;
    this.frame = null;
    this.offered = false;
    canvas.addEventListener("click", (event) => choose(this.at(event)));
    this.ask();
  }

  async ask() {
    let wait = EVERY_MS;
    try {
      if (!document.hidden) wait = (await this.fetch()) ? EVERY_MS : AGAIN_MS;
    } catch {
      wait = AGAIN_MS / 3;
    }
    setTimeout(() => this.ask(), wait);
  }

  async fetch() {
    // Where there will be none, it is not asked for.
    this.offered ||= (await (await fetch("/api/about", { cache: "no-store" })).json()).picture;
    if (!this.offered) return false;
    const answer = await fetch("/picture.jpg", { cache: "no-store" });
    if (!answer.ok) {
      this.figure.hidden = true;
      return false;
    }
    const bitmap = await createImageBitmap(await answer.blob());
    this.bitmap?.close();
    this.bitmap = bitmap;
    const size = /^(\d+)x(\d+)$/u.exec(answer.headers.get("x-frame-size") ?? "");
    this.frame = size ? [Number(size[1]), Number(size[2])] : [bitmap.width, bitmap.height];
    this.figure.hidden = false;
    this.paint();
    return true;
  }

  draw(targets, chosen) {
    this.targets = targets;
    this.chosen = chosen;
    this.paint();
  }

  paint() {
    if (!this.bitmap || this.figure.hidden) return;
    const { canvas, bitmap } = this;
    const ratio = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.round((width * bitmap.height) / bitmap.width);
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const context = canvas.getContext("2d");
    context.drawImage(bitmap, 0, 0, width, height);
    const [across, down] = [width / this.frame[0], height / this.frame[1]];
    context.font = `${12 * ratio}px system-ui, sans-serif`;
    context.textBaseline = "bottom";
    for (const one of this.targets) {
      if (!one.box_xyxy_px) continue;
      const [x1, y1, x2, y2] = one.box_xyxy_px;
      const [x, y, w, h] = [x1 * across, y1 * down, (x2 - x1) * across, (y2 - y1) * down];
      const picked = one.id === this.chosen;
      // A dark line beneath, so that the box shows on bright water as well.
      context.lineWidth = (picked ? 5 : 3.5) * ratio;
      context.strokeStyle = "rgba(0, 0, 0, 0.6)";
      context.strokeRect(x, y, w, h);
      context.lineWidth = (picked ? 3 : 1.5) * ratio;
      context.strokeStyle = picked ? "#ffffff" : COLOURS[kind(one)];
      context.strokeRect(x, y, w, h);
      if (one.name || picked) {
        const text = title(one);
        const size = context.measureText(text).width + 6 * ratio;
        const left = Math.max(0, Math.min(x, width - size));
        const bottom = Math.max(y - 2 * ratio, 16 * ratio);
        context.fillStyle = "rgba(0, 0, 0, 0.65)";
        context.fillRect(left, bottom - 15 * ratio, size, 15 * ratio);
        context.fillStyle = "#ffffff";
        context.fillText(text, left + 3 * ratio, bottom - 1 * ratio);
      }
    }
  }

  /** The smallest box under the pointer. */
  at(event) {
    if (!this.frame) return null;
    const bounds = this.canvas.getBoundingClientRect();
    const x = ((event.clientX - bounds.left) / bounds.width) * this.frame[0];
    const y = ((event.clientY - bounds.top) / bounds.height) * this.frame[1];
    const hit = this.targets.filter((one) => {
      const box = one.box_xyxy_px;
      return box && box[0] <= x && x <= box[2] && box[1] <= y && y <= box[3];
    });
    const area = ({ box_xyxy_px: [x1, y1, x2, y2] }) => (x2 - x1) * (y2 - y1);
    hit.sort((one, other) => area(one) - area(other));
    return hit[0]?.id ?? null;
  }
}
