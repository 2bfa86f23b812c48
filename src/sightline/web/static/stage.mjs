// The picture of a frame: boxes are drawn and mended on it, with a mouse, a pen or a finger.

import { sharpContext } from "/static/canvas.mjs";

const LARGEST_SCALE = 24;
const SMALLEST_BOX_PX = 2;
const REACH_CSS = { mouse: 8, pen: 12, touch: 22 };
// On pictures, which are of any brightness, these are seen with a dark line beneath them.
const LINES = { drawn: "#4fd0a5", proposed: "#f0a030", new: "#ffffff", other: "#56b4e9" };

/** A box with its corners in order. */
export function ordered([x1, y1, x2, y2]) {
  return [Math.min(x1, x2), Math.min(y1, y2), Math.max(x1, x2), Math.max(y1, y2)];
}

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

export class Stage extends EventTarget {
  /**
   * Tells `box` while and after a box is drawn, `point` when a pixel is chosen, and `look` when
   * the pointer or the view has moved.
   *
   * @param {HTMLCanvasElement} canvas What is drawn on.
   */
  constructor(canvas) {
    super();
    this.canvas = canvas;
    this.size = [1, 1];
    this.bitmap = null;
    this.box = null;
    this.kind = "new";
    this.others = [];
    this.cells = [];
    this.points = [];
    this.point = null;
    this.hint = null;
    this.lines = [];
    this.spots = [];
    this.mode = "boxes";
    this.scale = 1;
    this.offset = [0, 0];
    this.zoomed = false;
    this.drag = null;
    this.fingers = new Map();
    this.pointer = null;
    for (const [kind, action] of [
      ["pointerdown", this.down], ["pointermove", this.move], ["pointerup", this.up],
      ["pointercancel", this.cancel],
    ]) canvas.addEventListener(kind, action.bind(this));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomAt(this.css(event), Math.exp(-event.deltaY / 300));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    new ResizeObserver(() => this.fit(true)).observe(canvas);
  }

  show(bitmap, size) {
    this.bitmap = bitmap;
    if (size[0] !== this.size[0] || size[1] !== this.size[1]) {
      this.size = size;
      this.fit();
    }
    this.paint();
  }

  tell(name, detail = null) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // The view.

  smallestScale() {
    return Math.min(
      this.canvas.clientWidth / this.size[0], this.canvas.clientHeight / this.size[1],
    );
  }

  fit(keep = false) {
    if (keep && this.zoomed) {
      this.zoomAt([0, 0], 1);
      return;
    }
    this.zoomed = false;
    this.scale = this.smallestScale() || 1;
    this.offset = [0, 0];
    this.settle();
  }

  zoomAt(at, factor) {
    const before = this.toPicture(at);
    this.scale = clamp(this.scale * factor, this.smallestScale(), LARGEST_SCALE);
    this.zoomed = this.scale > this.smallestScale() * 1.001;
    this.offset = [at[0] - before[0] * this.scale, at[1] - before[1] * this.scale];
    this.settle();
  }

  /** Zoom about the box, or about the middle where there is none. */
  zoom(factor) {
    const box = this.box;
    const about = this.mode === "points" && this.point ? this.point
      : box ? [(box[0] + box[2]) / 2, box[3]] : [this.size[0] / 2, this.size[1] / 2];
    this.zoomAt(this.toCss(about), factor);
    this.bring(about);
  }

  /** Move the view so far that a pixel is well inside it. */
  bring(at) {
    const css = this.toCss(at);
    [this.canvas.clientWidth, this.canvas.clientHeight].forEach((size, i) => {
      if (css[i] < 0.1 * size || css[i] > 0.9 * size) this.offset[i] += size / 2 - css[i];
    });
    this.settle();
  }

  /** Keep the picture in the view: in its middle where it is smaller. */
  settle() {
    [this.canvas.clientWidth, this.canvas.clientHeight].forEach((view, i) => {
      const size = this.size[i] * this.scale;
      this.offset[i] = size <= view
        ? (view - size) / 2
        : clamp(this.offset[i], view - size, 0);
    });
    this.paint();
    this.tell("look");
  }

  css(event) {
    const bounds = this.canvas.getBoundingClientRect();
    return [event.clientX - bounds.left, event.clientY - bounds.top];
  }

  toPicture([x, y]) {
    return [(x - this.offset[0]) / this.scale, (y - this.offset[1]) / this.scale];
  }

  toCss([x, y]) {
    return [x * this.scale + this.offset[0], y * this.scale + this.offset[1]];
  }

  inside([x, y]) {
    return [clamp(x, 0, this.size[0]), clamp(y, 0, this.size[1])];
  }

  // Pointers.

  down(event) {
    if (!this.bitmap) return;
    this.canvas.focus({ preventScroll: true });
    const at = this.css(event);
    try {
      this.canvas.setPointerCapture(event.pointerId);
    } catch {
      // It has gone already.
    }
    if (event.pointerType === "touch") {
      this.fingers.set(event.pointerId, at);
      if (this.fingers.size === 2) {
        this.giveUp();
        return;
      }
      if (this.fingers.size > 2) return;
    }
    if (this.mode === "check" || event.button === 1 || event.button === 2) {
      this.drag = { kind: "pan", at, offset: [...this.offset] };
      return;
    }
    if (event.button !== 0) return;
    event.preventDefault();
    if (this.mode === "points") {
      this.drag = { kind: "point", before: this.point, touch: event.pointerType === "touch" };
      this.choosePoint(at);
      return;
    }
    const reach = REACH_CSS[event.pointerType] ?? REACH_CSS.mouse;
    const grip = this.gripAt(at, reach);
    const start = this.inside(this.toPicture(at));
    this.drag = {
      kind: "box", grip, start, before: this.box && [...this.box], kindBefore: this.kind,
      touch: event.pointerType === "touch",
    };
    this.pointer = { at, picture: start, touch: this.drag.touch, down: true };
    this.tell("look");
  }

  move(event) {
    const at = this.css(event);
    if (this.fingers.has(event.pointerId)) {
      const before = new Map(this.fingers);
      this.fingers.set(event.pointerId, at);
      if (this.fingers.size === 2) {
        this.pinch([...before.values()], [...this.fingers.values()]);
        return;
      }
    }
    const picture = this.inside(this.toPicture(at));
    const { drag } = this;
    this.pointer = { at, picture, touch: event.pointerType === "touch", down: drag !== null };
    if (drag?.kind === "pan") {
      this.offset = [drag.offset[0] + at[0] - drag.at[0], drag.offset[1] + at[1] - drag.at[1]];
      this.zoomed = true;
      this.settle();
      return;
    }
    if (drag?.kind === "point") this.choosePoint(at);
    if (drag?.kind === "box") {
      this.box = this.dragged(drag, picture);
      if (this.kind !== "new" || drag.grip) this.changed = true;
      this.paint();
      this.tell("box", { done: false });
    }
    if (!drag) {
      const grip = this.mode === "boxes" ? this.gripAt(at, REACH_CSS.mouse) : null;
      this.canvas.style.cursor = this.mode === "check" ? "grab" : grip === "move" ? "move" : grip ? `${cursorOf(grip)}-resize`
        : "crosshair";
    }
    this.tell("look");
  }

  up(event) {
    this.fingers.delete(event.pointerId);
    const { drag } = this;
    if (!drag) return;
    this.drag = null;
    if (this.pointer) this.pointer.down = false;
    if (drag.kind === "point") this.tell("point", { done: true });
    if (drag.kind === "box") {
      const box = this.box;
      const small = !box || box[2] - box[0] < SMALLEST_BOX_PX || box[3] - box[1] < SMALLEST_BOX_PX;
      if (small) {
        this.box = drag.before;
        this.kind = drag.kindBefore;
      }
      const same = JSON.stringify(this.box) === JSON.stringify(drag.before);
      this.paint();
      this.tell("box", { done: true, same });
    }
    this.tell("look");
  }

  cancel(event) {
    this.fingers.delete(event.pointerId);
    this.giveUp();
  }

  /** Take back what the pointer has begun. */
  giveUp() {
    const { drag } = this;
    this.drag = null;
    if (this.pointer) this.pointer.down = false;
    if (drag?.kind === "box") {
      this.box = drag.before;
      this.kind = drag.kindBefore;
      this.tell("box", { done: true, same: true });
    }
    if (drag?.kind === "point") {
      this.point = drag.before;
      this.tell("point", { done: true });
    }
    this.paint();
    this.tell("look");
  }

  pinch([a, b], [c, d]) {
    const middle = (p, q) => [(p[0] + q[0]) / 2, (p[1] + q[1]) / 2];
    const apart = (p, q) => Math.max(Math.hypot(p[0] - q[0], p[1] - q[1]), 1);
    const [from, to] = [middle(a, b), middle(c, d)];
    this.offset = [this.offset[0] + to[0] - from[0], this.offset[1] + to[1] - from[1]];
    this.zoomAt(to, apart(c, d) / apart(a, b));
  }

  choosePoint(at) {
    this.point = this.inside(this.toPicture(at));
    this.pointer = { at, picture: this.point, touch: this.drag?.touch ?? false, down: true };
    this.paint();
    this.tell("point", { done: false });
    this.tell("look");
  }

  /** What of the box is under the pointer: edges as letters of the compass, or move, or null. */
  gripAt([x, y], reach) {
    if (!this.box) return null;
    const [x1, y1] = this.toCss([this.box[0], this.box[1]]);
    const [x2, y2] = this.toCss([this.box[2], this.box[3]]);
    if (x < x1 - reach || x > x2 + reach || y < y1 - reach || y > y2 + reach) return null;
    // Of a small box the lower edge is the nearest, since it counts the most.
    const near = (value, edge, size) => Math.abs(value - edge) <= Math.min(reach, size / 3 + reach / 2);
    const down = near(y, y2, y2 - y1) ? "s" : near(y, y1, y2 - y1) ? "n" : "";
    const side = near(x, x2, x2 - x1) ? "e" : near(x, x1, x2 - x1) ? "w" : "";
    if (down + side) return down + side;
    return x > x1 && x < x2 && y > y1 && y < y2 ? "move" : null;
  }

  dragged({ grip, start, before }, [x, y]) {
    if (!grip) {
      this.kind = "new";
      return ordered([start[0], start[1], x, y]);
    }
    const box = [...before];
    const by = [x - start[0], y - start[1]];
    if (grip === "move") {
      const [dx, dy] = [
        clamp(by[0], -box[0], this.size[0] - box[2]), clamp(by[1], -box[1], this.size[1] - box[3]),
      ];
      return [box[0] + dx, box[1] + dy, box[2] + dx, box[3] + dy];
    }
    if (grip.includes("w")) box[0] += by[0];
    if (grip.includes("e")) box[2] += by[0];
    if (grip.includes("n")) box[1] += by[1];
    if (grip.includes("s")) box[3] += by[1];
    const [left, top] = this.inside(box);
    const [right, bottom] = this.inside([box[2], box[3]]);
    return ordered([left, top, right, bottom]);
  }

  // What is seen.

  paint() {
    const { canvas } = this;
    const context = sharpContext(canvas);
    context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    if (!this.bitmap) return;
    context.imageSmoothingEnabled = this.scale < 3;
    const [left, top] = this.offset;
    context.drawImage(
      this.bitmap, left, top, this.size[0] * this.scale, this.size[1] * this.scale,
    );
    if (this.mode === "check") {
      context.save();
      context.beginPath();
      context.rect(left, top, this.size[0] * this.scale, this.size[1] * this.scale);
      context.clip();
      const labels = [];
      for (const one of this.lines) this.paintLine(context, one, labels);
      for (const { box, name } of this.others) this.paintBox(context, box, LINES.other, [5, 3], name);
      if (this.box) this.paintBox(context, this.box, LINES[this.kind], [], "");
      for (const one of this.spots) this.paintSpot(context, one);
      context.restore();
      return;
    }
    this.paintCells(context);
    if (this.mode === "points") {
      for (const one of this.points) this.paintPoint(context, one.pixel, one.chosen ? "#ffffff" : LINES.other, one.label);
      if (this.point) this.paintPoint(context, this.point, LINES.proposed, "");
      return;
    }
    if (this.hint && !this.box) this.paintHint(context);
    for (const { box, name } of this.others) this.paintBox(context, box, LINES.other, [5, 3], name);
    if (this.box) {
      this.paintBox(context, this.box, LINES[this.kind], this.kind === "proposed" ? [6, 3] : [], "");
      this.paintGrips(context);
    }
  }

  paintBox(context, [x1, y1, x2, y2], line, dash, name) {
    const [left, top] = this.toCss([x1, y1]);
    const [right, bottom] = this.toCss([x2, y2]);
    for (const [style, width, dashes] of [["rgba(0, 0, 0, 0.65)", 3.5, []], [line, 1.5, dash]]) {
      context.strokeStyle = style;
      context.lineWidth = width;
      context.setLineDash(dashes);
      context.strokeRect(left, top, right - left, bottom - top);
    }
    context.setLineDash([]);
    if (name) label(context, name, left, top - 4);
  }

  paintGrips(context) {
    const [x1, y1] = this.toCss([this.box[0], this.box[1]]);
    const [x2, y2] = this.toCss([this.box[2], this.box[3]]);
    context.fillStyle = LINES[this.kind];
    context.strokeStyle = "rgba(0, 0, 0, 0.8)";
    context.lineWidth = 1;
    // Of a small box they would hide the boat.
    if (Math.min(x2 - x1, y2 - y1) < 18) return;
    const spots = [[x1, y1], [x2, y1], [x1, y2], [x2, y2]];
    if (x2 - x1 > 36) spots.push([(x1 + x2) / 2, y1], [(x1 + x2) / 2, y2]);
    if (y2 - y1 > 36) spots.push([x1, (y1 + y2) / 2], [x2, (y1 + y2) / 2]);
    for (const [x, y] of spots) {
      context.fillRect(x - 3, y - 3, 6, 6);
      context.strokeRect(x - 3, y - 3, 6, 6);
    }
  }

  paintPoint(context, pixel, line, name) {
    const [x, y] = this.toCss(pixel);
    for (const [style, width] of [["rgba(0, 0, 0, 0.7)", 4], [line, 1.8]]) {
      context.strokeStyle = style;
      context.lineWidth = width;
      context.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(x + 4 * dx, y + 4 * dy);
        context.lineTo(x + 12 * dx, y + 12 * dy);
      }
      context.stroke();
    }
    if (name) label(context, name, x + 8, y - 6);
  }

  /** A line of the water, with a dark one beneath; named where there is room among `labels`. */
  paintLine(context, { points, style, width, dash = [], label: text = "" }, labels) {
    context.beginPath();
    points.forEach((point, i) => {
      const [x, y] = this.toCss(point);
      if (i) context.lineTo(x, y);
      else context.moveTo(x, y);
    });
    for (const [colour, wide, dashes] of [["rgba(0, 0, 0, 0.45)", width + 1.5, []], [style, width, dash]]) {
      context.strokeStyle = colour;
      context.lineWidth = wide;
      context.setLineDash(dashes);
      context.stroke();
    }
    context.setLineDash([]);
    if (!text) return;
    const shown = points.map((point) => this.toCss(point)).filter(([x, y]) =>
      x > 4 && y > 16 && x < this.canvas.clientWidth - 60 && y < this.canvas.clientHeight);
    const left = Math.max(this.offset[0], 0);
    const at = shown.find(([x]) => x >= left + 8);
    if (!at || labels.some((y) => Math.abs(y - at[1]) < 16)) return;
    labels.push(at[1]);
    label(context, text, at[0], at[1] - 2);
  }

  /** A place of the log: a cross, or a dot for one of many. */
  paintSpot(context, { pixel, style, label: text, small }) {
    if (small) {
      const [x, y] = this.toCss(pixel);
      context.beginPath();
      context.arc(x, y, 2.5, 0, 2 * Math.PI);
      context.fillStyle = style;
      context.strokeStyle = "rgba(0, 0, 0, 0.7)";
      context.lineWidth = 1;
      context.fill();
      context.stroke();
      return;
    }
    this.paintPoint(context, pixel, style, text);
  }

  /** Point down at where it is expected, and leave the boat itself to the eye. */
  paintHint(context) {
    const [x, y] = this.toCss(this.hint);
    context.beginPath();
    context.moveTo(x, y - 10);
    context.lineTo(x - 8, y - 24);
    context.lineTo(x + 8, y - 24);
    context.closePath();
    context.fillStyle = LINES.proposed;
    context.strokeStyle = "rgba(0, 0, 0, 0.8)";
    context.lineWidth = 2;
    context.stroke();
    context.fill();
  }

  /** Hatch the parts of the picture where boxes are wanted. */
  paintCells(context) {
    for (const [x1, y1, x2, y2] of this.cells) {
      const [left, top] = this.toCss([x1, y1]);
      const [right, bottom] = this.toCss([x2, y2]);
      context.save();
      context.beginPath();
      context.rect(left, top, right - left, bottom - top);
      context.clip();
      context.strokeStyle = "rgba(240, 160, 48, 0.45)";
      context.lineWidth = 1.5;
      context.beginPath();
      const height = bottom - top;
      for (let x = left - height; x < right; x += 12) {
        context.moveTo(x, bottom);
        context.lineTo(x + height, top);
      }
      context.stroke();
      context.restore();
    }
  }
}

function cursorOf(grip) {
  return grip === "n" || grip === "s" ? "ns" : grip === "e" || grip === "w" ? "ew"
    : grip === "se" || grip === "nw" ? "nwse" : "nesw";
}

function label(context, text, left, bottom) {
  context.font = "12px system-ui, sans-serif";
  context.textBaseline = "bottom";
  const width = context.measureText(text).width + 6;
  const base = Math.max(bottom, 16);
  context.fillStyle = "rgba(0, 0, 0, 0.65)";
  context.fillRect(left, base - 15, width, 15);
  context.fillStyle = "#ffffff";
  context.fillText(text, left + 3, base - 1);
}
