// The page of drawing: boxes are drawn, followed and kept, and the fit says what it makes of them.

import { Advice } from "/static/advice.mjs";
import { Check } from "/static/check.mjs";
import { TIMES, magnify } from "/static/magnifier.mjs";
import { Points } from "/static/points.mjs";
import { ask, askPicture, send } from "/static/server.mjs";
import {
  capital, keptSettings, nextSetting, showTheme, whenThemeChanges,
} from "/static/settings.mjs";
import { Stage, ordered } from "/static/stage.mjs";
import { Whose } from "/static/whose.mjs";
import { plain, time } from "/static/words.mjs";

const element = (id) => document.getElementById(id);
const PICTURES = 10;
const CROP = [96, 56];
const CROP_WAIT_MS = 120;
const ASK_MS = { running: 400, idle: 4000 };
const PARTS = [
  ["lower", "the lower edge"], ["upper", "the upper edge"], ["left", "the left edge"],
  ["right", "the right edge"], ["all", "the whole box"],
];

const choices = { theme: ["auto", "light", "dark"], letters: ["on", "off"] };
const settings = keptSettings(choices);
const state = {
  scene: null, frames: null, boxes: [], suggested: [], advice: null, frame: null, mode: "boxes",
  part: "lower", busy: false, shown: false, unsaved: false, lastBox: null, expected: null,
};
const pictures = new Map();
let crop = null;
let cropTimer = 0;
let askTimer = 0;

const stage = new Stage(element("stage"));
const advice = new Advice(goTo);
const points = new Points({
  size: () => state.scene?.frame_size_px ?? [1, 1],
  pick: (pixel) => {
    stage.point = pixel;
    if (pixel) stage.bring(pixel);
    stage.paint();
    look();
  },
  show: (marks) => {
    stage.points = marks;
    stage.paint();
  },
  say,
});
const inPicture = {
  frame: () => state.frame,
  show: (lines, spots) => {
    stage.lines = lines;
    stage.spots = spots;
    stage.paint();
  },
  say,
};
const check = new Check(inPicture);
const whose = new Whose({
  ...inPicture,
  size: () => state.scene?.frame_size_px ?? [1, 1],
  goTo,
  confirmed: (told) => {
    take(told);
    takeBox();
    stage.paint();
  },
});

function say(text, word = "live") {
  const line = element("status");
  line.dataset.state = word;
  const told = plain(text);
  if (line.textContent !== told) line.textContent = told;
}

// Frames and their pictures.

function picture(frame) {
  let known = pictures.get(frame);
  if (known) {
    pictures.delete(frame);
  } else {
    known = askPicture(`/frames/${frame}.jpg`);
    known.catch(() => pictures.delete(frame));
  }
  pictures.set(frame, known);
  while (pictures.size > PICTURES) {
    const oldest = pictures.keys().next().value;
    pictures.get(oldest).then((one) => one.close(), () => {});
    pictures.delete(oldest);
  }
  return known;
}

const own = () => state.boxes.filter((one) => one.annotator === state.scene.annotator);
const ownBox = (frame) => own().find((one) => one.frame === frame) ?? null;
const proposed = () => own().filter((one) => !one.accepted);

async function goTo(frame) {
  if (!Number.isInteger(frame) || !state.frames?.known.has(frame)) {
    say(`there is no frame ${frame}`, "refused");
    element("frame-number").value = state.frame ?? "";
    return;
  }
  state.frame = frame;
  state.unsaved = false;
  state.shown = false;
  state.expected = null;
  stage.hint = null;
  takeBox();
  showFrame();
  try {
    const bitmap = await picture(frame);
    if (state.frame !== frame) return;
    stage.show(bitmap, state.scene.frame_size_px);
    crop = null;
    if (stage.zoomed && stage.box) stage.bring([(stage.box[0] + stage.box[2]) / 2, stage.box[3]]);
    look();
    state.shown = true;
    document.documentElement.dataset.ready = "true";
    if (state.mode === "check") check.show();
    if (state.mode === "whose") whose.paint();
    askExpected(frame);
    // The next one is there before it is asked for.
    const after = following(frame);
    if (after !== null) picture(after).catch(() => {});
  } catch (error) {
    say(error.message, "refused");
  }
}

/** Point at where log and fit have it, which is no box yet. */
async function askExpected(frame) {
  try {
    const { box_px: box } = await ask(`/api/expected/${frame}`);
    if (state.frame !== frame) return;
    state.expected = box;
    stage.hint = box && [(box[0] + box[2]) / 2, box[1]];
    if (box && stage.zoomed && !stage.box) stage.bring([(box[0] + box[2]) / 2, box[3]]);
    stage.paint();
  } catch {
    // It is found without.
  }
}

/** Take what is known of the box of this frame. */
function takeBox() {
  const known = ownBox(state.frame);
  stage.box = known ? [...known.box_px] : null;
  stage.kind = known ? (known.accepted ? "drawn" : "proposed") : "new";
  stage.others = state.boxes
    .filter((one) => one.frame === state.frame && one.annotator !== state.scene.annotator)
    .map((one) => ({ box: one.box_px, name: plain(one.annotator || "unnamed") }));
  state.unsaved = false;
}

/** The frame that comes after one: the nearest proposal, else the best that is not drawn yet. */
function following(frame) {
  const waiting = proposed().map((one) => one.frame).filter((one) => one !== frame);
  if (waiting.length) {
    return waiting.reduce((best, one) =>
      Math.abs(one - frame) < Math.abs(best - frame) ? one : best);
  }
  return state.suggested.find((one) => one !== frame && !ownBox(one)) ?? null;
}

function step(way) {
  if (state.mode === "whose") {
    whose.step(way);
    return;
  }
  const list = stripFrames().map((one) => one.frame);
  if (!list.length) return;
  const i = list.indexOf(state.frame);
  goTo(list[i < 0 ? 0 : (i + way + list.length) % list.length]);
}

function near(way) {
  const every = state.frames.frame;
  const i = every.indexOf(state.frame) + way;
  if (i >= 0 && i < every.length) goTo(every[i]);
}

// What is shown.

function stripFrames() {
  const list = state.suggested.map((frame) => ({ frame, state: ownBox(frame) ? "" : "none" }));
  const listed = new Set(state.suggested);
  const rest = own().filter((one) => !listed.has(one.frame));
  rest.sort((one, other) => one.accepted - other.accepted || one.frame - other.frame);
  return [
    ...rest.filter((one) => !one.accepted), ...list, ...rest.filter((one) => one.accepted),
  ].map(({ frame }) => {
    const box = ownBox(frame);
    return { frame, state: box ? (box.accepted ? "drawn" : "proposed") : "none" };
  });
}

const MARKS = { drawn: "✓", proposed: "?", none: "○" };
const WORDS = { drawn: "drawn", proposed: "proposed", none: "no box" };

function showStrip() {
  const strip = element("strip");
  const list = stripFrames();
  while (strip.children.length > list.length) strip.lastChild.remove();
  list.forEach((one, i) => {
    if (!strip.children[i]) {
      const item = document.createElement("li");
      const button = document.createElement("button");
      button.type = "button";
      button.addEventListener("click", () => goTo(Number(button.dataset.frame)));
      item.append(button);
      strip.append(item);
    }
    const button = strip.children[i].firstChild;
    button.dataset.frame = one.frame;
    button.dataset.state = one.state;
    button.textContent = `${MARKS[one.state]} ${one.frame}`;
    button.setAttribute("aria-label", `frame ${one.frame}, ${WORDS[one.state]}`);
    if (one.frame === state.frame) button.setAttribute("aria-current", "true");
    else button.removeAttribute("aria-current");
  });
  strip.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest", inline: "nearest" });
}

function showFrame() {
  const { frames, frame } = state;
  element("frame-number").value = frame;
  element("frame-slider").value = frames.frame.indexOf(frame);
  element("frame-slider").setAttribute("aria-valuetext", `frame ${frame}`);
  const i = frames.frame.indexOf(frame);
  const seconds = frames.time_utc_s[i];
  const gap = frames.gap_s[i];
  element("frame-time").textContent = [
    seconds === null ? "no time" : time(1000 * seconds, "UTC"),
    gap === null ? "no fix" : `fix ${gap < 10 ? gap.toFixed(1) : gap.toFixed(0)} s away`,
  ].join(", ");
  showStrip();
  showBox();
}

function showBox() {
  const { box } = stage;
  for (let i = 0; i < 4; i += 1) {
    const field = element(`edge-${i}`);
    field.disabled = !box;
    if (field !== document.activeElement || !box) field.value = box ? rounded(box[i]) : "";
  }
  const known = ownBox(state.frame);
  element("accept").disabled = !box || state.busy;
  element("follow").disabled = !box || state.busy;
  element("remove").disabled = state.busy;
  element("remove").textContent = box ? "Throw away" : "Nothing there";
  element("remove-proposed").disabled = !proposed().length || state.busy;
  const others = stage.others.length
    ? ` ${stage.others.map((one) => one.name).join(", ")} drew it as well.` : "";
  const words = {
    new: box ? "New: not kept until it is accepted." : "None yet: drag over the picture, or press b.",
    drawn: state.unsaved ? "Drawn, and changed since: accept it." : "Drawn.",
    proposed: state.unsaved ? "Proposed, and mended: accept it."
      : `Proposed${known?.confidence == null ? "" : `, ${Math.round(100 * known.confidence)} % sure`}.`,
  };
  element("box-note").textContent = words[stage.kind] + others;
}

function rounded(value) {
  return String(Math.round(100 * value) / 100);
}

/** The magnifiers, and the part of the picture without losses. */
function look() {
  const bitmap = stage.bitmap;
  const inPoints = state.mode === "points";
  const canvas = element(inPoints ? "point-magnifier" : "magnifier");
  const middle = inPoints ? stage.point ?? stage.pointer?.picture : lowerMiddle();
  const marks = inPoints ? { point: stage.point } : { box: stage.box };
  magnify(canvas, { bitmap, crop }, middle ?? null, marks);
  askCrop(middle ?? null);
  const finger = element("finger");
  const { pointer } = stage;
  const touching = Boolean(pointer?.touch && pointer.down && stage.drag);
  finger.hidden = !touching;
  if (touching) {
    const [width, height] = [finger.offsetWidth, finger.offsetHeight];
    const above = pointer.at[1] - height - 40;
    // Above the finger; at the upper edge beside it.
    const left = above >= 0 ? pointer.at[0] - width / 2
      : pointer.at[0] > width + 50 ? pointer.at[0] - width - 50 : pointer.at[0] + 50;
    const most = stage.canvas.clientWidth - width;
    finger.style.left = `${Math.max(0, Math.min(left, most))}px`;
    finger.style.top = `${Math.max(0, above)}px`;
    magnify(finger, { bitmap, crop: null }, pointer.picture, inPoints ? marks : { box: stage.box });
  }
}

function lowerMiddle() {
  if (!stage.box) return stage.pointer?.picture ?? null;
  const [x1, , x2, y2] = stage.box;
  const half = element("magnifier").clientWidth / 2 / TIMES;
  // Of a wide box the part that the pointer is at.
  const at = stage.pointer?.picture[0] ?? (x1 + x2) / 2;
  const middle = x2 - x1 < 2 * half ? (x1 + x2) / 2 : Math.max(x1 + half - 4, Math.min(at, x2 - half + 4));
  return [middle, y2];
}

function askCrop(middle) {
  clearTimeout(cropTimer);
  if (!middle || !state.shown) return;
  const { frame } = state;
  const covers = crop?.frame === frame
    && Math.abs(crop.x + CROP[0] / 2 - middle[0]) < 12 && Math.abs(crop.y + CROP[1] / 2 - middle[1]) < 8;
  if (covers) return;
  if (crop?.frame !== frame) crop = null;
  cropTimer = setTimeout(async () => {
    const x = Math.max(0, Math.round(middle[0] - CROP[0] / 2));
    const y = Math.max(0, Math.round(middle[1] - CROP[1] / 2));
    try {
      const bitmap = await askPicture(
        `/frames/${frame}.png?x=${x}&y=${y}&width=${CROP[0]}&height=${CROP[1]}`,
      );
      if (state.frame === frame) {
        crop = { frame, x, y, bitmap };
        look();
      }
    } catch {
      // That of the whole picture is good enough.
    }
  }, CROP_WAIT_MS);
}

function showCells() {
  stage.cells = element("thin").checked ? (state.advice?.thin ?? []).map((one) => one.cell_px) : [];
  stage.paint();
}

// What the server knows.

function take(told) {
  state.boxes = told.boxes;
  state.suggested = told.suggested;
  state.advice = told.advice;
  if (!state.unsaved && !stage.drag && state.frame !== null && stage.kind !== "new") takeBox();
  else if (state.frame !== null && !stage.box && !stage.drag) takeBox();
  advice.show(told.advice, state.scene.recording);
  showCells();
  if (state.frame !== null) {
    showStrip();
    showBox();
    stage.paint();
    look();
  }
  clearTimeout(askTimer);
  askTimer = setTimeout(refresh, told.advice.running ? ASK_MS.running : ASK_MS.idle);
}

async function refresh() {
  clearTimeout(askTimer);
  try {
    if (!state.busy) {
      const told = await ask("/api/state");
      if (!state.busy) take(told);
    }
    if (element("status").dataset.state === "lost") say("connected again");
  } catch {
    say("the server does not answer; trying again", "lost");
    askTimer = setTimeout(refresh, 2000);
    return;
  }
  clearTimeout(askTimer);
  askTimer = setTimeout(refresh, state.advice?.running ? ASK_MS.running : ASK_MS.idle);
}

/** Ask for a change; false where it was refused or another one is under way. */
async function change(method, path, body, then) {
  if (state.busy) return false;
  state.busy = true;
  showBox();
  try {
    const told = await send(method, path, body);
    state.unsaved = false;
    state.busy = false;
    then(told);
    return true;
  } catch (error) {
    say(error.message, "refused");
    return false;
  } finally {
    state.busy = false;
    showBox();
  }
}

// What can be done.

async function accept(goOn = true) {
  const { box } = stage;
  const { frame } = state;
  if (!box) return false;
  const done = await change("PUT", "/api/boxes", { frame, box_px: box }, (told) => {
    state.lastBox = box;
    stage.kind = "drawn";
    take(told);
    takeBox();
    say(`frame ${frame}: kept`);
  });
  if (done && goOn) {
    const after = following(frame);
    if (after !== null) await goTo(after);
    else say(`frame ${frame}: kept; nothing is left that was suggested`);
  }
  return done;
}

async function remove() {
  const { frame } = state;
  const known = ownBox(frame);
  if (!known && stage.box) {
    stage.box = null;
    stage.kind = "new";
    state.unsaved = false;
    stage.paint();
    showBox();
    look();
    return;
  }
  await change("DELETE", "/api/boxes", { frame }, (told) => {
    stage.kind = "drawn";
    take(told);
    takeBox();
    say(known ? `frame ${frame}: thrown away` : `frame ${frame}: left out, there is nothing to draw`);
    if (!known?.accepted && following(frame) !== null) goTo(following(frame));
    else showFrame();
    stage.paint();
    look();
  });
}

async function removeProposed() {
  const waiting = proposed().map((one) => one.frame);
  for (const frame of waiting) {
    const done = await change("DELETE", "/api/boxes", { frame }, (told) => take(told));
    if (!done) return;
  }
  takeBox();
  showFrame();
  stage.paint();
  look();
  say(`${waiting.length} proposed boxes thrown away`);
}

async function follow() {
  const { frame } = state;
  if (!stage.box) return;
  if ((state.unsaved || stage.kind !== "drawn") && !(await accept(false))) return;
  say(`looking for it around frame ${frame}`, "waiting");
  await change("POST", "/api/follow", { frame }, (told) => {
    take(told);
    const { count } = told;
    say(count ? `${count} boxes proposed: accept, mend or throw away each` : "not sure of it in any frame around");
    if (count && following(frame) !== null) goTo(following(frame));
  });
}

/** Undo or redo, and go to where something has changed. */
async function back(path, words) {
  if (state.mode === "points") {
    await points.back(path === "/api/redo");
    return;
  }
  if (state.mode === "check") {
    if (path === "/api/undo") await check.back();
    return;
  }
  const texts = new Map(own().map((one) => [one.frame, JSON.stringify(one)]));
  await change("POST", path, {}, (told) => {
    stage.kind = "drawn";
    take(told);
    takeBox();
    say(told.count ? words : "nothing to take back");
    const after = new Map(own().map((one) => [one.frame, JSON.stringify(one)]));
    const changed = [...new Set([...texts.keys(), ...after.keys()])]
      .find((frame) => texts.get(frame) !== after.get(frame));
    goTo(changed ?? state.frame);
  });
}

/** A box for those who do not drag: where it is expected, where the last one was, or in the middle. */
function newBox() {
  if (!state.scene) return;
  const [width, height] = state.scene.frame_size_px;
  const { expected } = state;
  const inside = expected && expected[0] >= 0 && expected[1] >= 0
    && expected[2] <= width && expected[3] <= height;
  stage.box = (inside ? whole(expected) : null) ?? state.lastBox?.slice()
    ?? [0.475 * width, 0.475 * height, 0.525 * width, 0.525 * height].map(Math.round);
  edited();
  stage.bring([(stage.box[0] + stage.box[2]) / 2, stage.box[3]]);
}

/** A box in whole pixels, of two at the least. */
function whole(box) {
  const [x1, y1, x2, y2] = box.map(Math.round);
  return [x1, y1, Math.max(x2, x1 + 2), Math.max(y2, y1 + 2)];
}

function edited() {
  state.unsaved = true;
  stage.paint();
  showBox();
  look();
}

function nudge(dx, dy) {
  if (state.mode === "check") {
    check.nudge(0.1 * dx);
    return;
  }
  if (state.mode === "whose") return;
  if (state.mode === "points") {
    const [width, height] = state.scene.frame_size_px;
    const from = stage.point ?? [width / 2, height / 2];
    stage.point = stage.inside([from[0] + dx, from[1] + dy]);
    stage.bring(stage.point);
    points.setPixel(stage.point);
    look();
    return;
  }
  if (!stage.box) {
    newBox();
    return;
  }
  const [width, height] = state.scene.frame_size_px;
  const [x1, y1, x2, y2] = stage.box;
  const within = (value, low, high) => Math.min(Math.max(value, low), high);
  if (state.part === "all" || (state.part === "lower" || state.part === "upper" ? dx : dy)) {
    // What an edge cannot do, the box does: sideways it goes as a whole.
    const by = [within(dx, -x1, width - x2), within(dy, -y1, height - y2)];
    stage.box = [x1 + by[0], y1 + by[1], x2 + by[0], y2 + by[1]];
  } else {
    const least = 0.25;
    stage.box = {
      lower: () => [x1, y1, x2, within(y2 + dy, y1 + least, height)],
      upper: () => [x1, within(y1 + dy, 0, y2 - least), x2, y2],
      left: () => [within(x1 + dx, 0, x2 - least), y1, x2, y2],
      right: () => [x1, y1, within(x2 + dx, x1 + least, width), y2],
    }[state.part]();
  }
  stage.bring([(stage.box[0] + stage.box[2]) / 2, stage.box[3]]);
  edited();
}

function setPart(part) {
  state.part = part;
  element("part").value = part;
}

const STAGE_LABELS = {
  boxes: "The frame's picture: drag to draw a box",
  points: "The frame's picture: choose a pixel",
  check: "The frame's picture, with the log and the water drawn into it",
  whose: "The frame's picture, with a candidate for the logged vessel",
};
const SECTIONS = {
  boxes: ["box-section", "advice-section"], points: ["points-section"], check: ["check-section"],
  whose: ["whose-section"],
};

/** Go over to a mode; from there back to the boxes. */
function setMode(asked) {
  const mode = asked === state.mode ? "boxes" : asked;
  state.mode = mode;
  // In both the picture is only looked at.
  stage.mode = mode === "whose" ? "check" : mode;
  stage.lines = stage.spots = [];
  element("whose-mode").setAttribute("aria-pressed", String(mode === "whose"));
  element("mode").setAttribute("aria-pressed", String(mode === "points"));
  element("check-mode").setAttribute("aria-pressed", String(mode === "check"));
  for (const [name, ids] of Object.entries(SECTIONS)) {
    for (const id of ids) element(id).hidden = name !== mode;
  }
  stage.canvas.setAttribute("aria-label", STAGE_LABELS[mode]);
  if (mode === "points") points.open();
  if (mode === "check") check.open();
  if (mode === "whose") whose.open();
  stage.paint();
  look();
}

function fade(by) {
  const slider = element("opacity");
  slider.value = Math.round(slider.valueAsNumber + 100 * by);
  check.fade();
}

function showSettings() {
  element("theme").textContent = capital(settings.theme);
  element("letters").checked = settings.letters === "on";
  showTheme(settings.theme);
  points.repaint();
  check.repaint();
  stage.paint();
}

// Keys.

const KEYS = [
  ["n, p", "next suggested frame, the one before"],
  [", and .", "frame before, next frame"],
  ["g", "go to a frame by its number"],
  ["arrows", "move the lower edge by a pixel; with Shift by a quarter, with Ctrl by ten"],
  ["e", "what the arrows move: lower, upper, left, right edge, the whole box"],
  ["b", "a new box where it is expected, or where the last one was"],
  ["Enter", "accept, and go on"],
  ["Delete", "throw the box away; without one, leave the frame out"],
  ["f", "follow: propose it in the frames around"],
  ["x", "throw all proposed boxes away"],
  ["z, y", "undo, redo"],
  ["+, -, 0", "larger, smaller, the whole picture"],
  ["t", "hatch where boxes are wanted"],
  ["c", "boxes or control points"],
  ["v", "see it fit, or back to the boxes; there:"],
  ["left, right", "the clock by 0.1 s; with Shift by 0.025, with Ctrl by one"],
  ["r, w", "the clock as fitted; write it to the scene"],
  ["1, 2, 3, 4", "log, rings, grid, horizon"],
  ["o, O", "the picture on the map more opaque, less"],
  ["l", "whose log it is, or back to the boxes; there:"],
  ["m", "weigh all that moves against the log"],
  ["1 to 9, n, p", "show a candidate, its next frame, the one before"],
  ["Enter", "it is the one that is shown: label it"],
  ["d", "light or dark"],
  ["Escape", "take back what is not kept"],
  ["?", "this list"],
];
const ARROWS = { ArrowUp: [0, -1], ArrowDown: [0, 1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };
const actions = {
  n: () => step(1),
  p: () => step(-1),
  ",": () => near(-1),
  ".": () => near(1),
  g: () => {
    element("frame-number").focus();
    element("frame-number").select();
  },
  e: () => {
    const names = PARTS.map(([name]) => name);
    setPart(names[(names.indexOf(state.part) + 1) % names.length]);
    say(`arrow keys move ${PARTS.find(([name]) => name === state.part)[1]}`);
  },
  b: () => state.mode === "boxes" && newBox(),
  Delete: () => (state.mode === "boxes" ? remove() : state.mode === "points" && points.remove()),
  f: () => state.mode === "boxes" && follow(),
  x: () => state.mode === "boxes" && removeProposed(),
  z: () => back("/api/undo", "taken back"),
  y: () => back("/api/redo", "made again"),
  "+": () => stage.zoom(1.5),
  "-": () => stage.zoom(1 / 1.5),
  0: () => stage.fit(),
  t: () => element("thin").click(),
  c: () => setMode("points"),
  v: () => setMode("check"),
  r: () => state.mode === "check" && element("clock-fit").click(),
  w: () => state.mode === "check" && element("clock-write").click(),
  o: () => state.mode === "check" && fade(0.1),
  O: () => state.mode === "check" && fade(-0.1),
  l: () => setMode("whose"),
  m: () => state.mode === "whose" && element("weigh").click(),
  d: () => {
    nextSetting(settings, choices, "theme");
    showSettings();
  },
  Escape: () => {
    if (state.mode === "points") {
      points.choose(null);
      return;
    }
    takeBox();
    stage.paint();
    showBox();
    look();
  },
  "?": () => element("help").showModal(),
};
const SWITCHES = ["show-log", "show-rings", "show-grid", "show-horizon"];
for (let i = 0; i < 9; i += 1) {
  actions[i + 1] = () => {
    if (state.mode === "whose") whose.choose(i);
    else if (state.mode === "check" && SWITCHES[i]) element(SWITCHES[i]).click();
  };
}
const ENTERS = { boxes: () => accept(), points: () => points.save(), whose: () => whose.confirm() };
actions.Enter = () => ENTERS[state.mode]?.();
actions.Backspace = actions.Delete;
actions["="] = actions["+"];

function keyed(event) {
  if (event.metaKey || event.altKey || element("help").open || !state.scene) return;
  const { target, key } = event;
  const typing = target.closest?.("input:not([type=checkbox]), select, textarea");
  if (typing) {
    if (key === "Escape") element("stage").focus();
    else if (key === "Enter" && target.closest("#edges")) accept();
    else if (key === "Enter" && target.id === "frame-number") {
      element("stage").focus();
      goTo(target.valueAsNumber);
    }
    else return;
    event.preventDefault();
    return;
  }
  if (target.closest?.(".maplibregl-map")) return;
  const arrow = ARROWS[key];
  if (arrow) {
    const by = event.shiftKey ? 0.25 : event.ctrlKey ? 10 : 1;
    nudge(arrow[0] * by, arrow[1] * by);
    event.preventDefault();
    return;
  }
  if (event.ctrlKey) return;
  if ((key === "Enter" || key === " ") && target.closest?.("button, a, input, summary")) return;
  if (key.length === 1 && settings.letters === "off") return;
  const action = actions[key];
  if (action) {
    event.preventDefault();
    action();
  }
}

// Everything is bound.

for (const [value, words] of PARTS) {
  const option = document.createElement("option");
  option.value = value;
  option.textContent = words;
  element("part").append(option);
}
for (const [keys, words] of KEYS) {
  const term = document.createElement("dt");
  const key = document.createElement("kbd");
  key.textContent = keys;
  term.append(key);
  const what = document.createElement("dd");
  what.textContent = words;
  element("keys").append(term, what);
}
for (const [id, action] of [
  ["mode", actions.c], ["check-mode", actions.v], ["whose-mode", actions.l],
  ["undo", actions.z], ["redo", actions.y], ["theme", actions.d],
  ["help-open", actions["?"]], ["previous", actions.p], ["next", actions.n],
  ["zoom-in", actions["+"]], ["zoom-out", actions["-"]], ["zoom-fit", actions[0]],
  ["accept", () => accept()], ["follow", follow], ["remove", remove], ["new", newBox],
  ["remove-proposed", removeProposed],
]) element(id).addEventListener("click", action);
element("part").addEventListener("change", (event) => setPart(event.target.value));
element("letters").addEventListener("change", () => nextSetting(settings, choices, "letters"));
element("thin").addEventListener("change", showCells);
element("frame-number").addEventListener("change", (event) => {
  if (event.target.valueAsNumber !== state.frame) goTo(event.target.valueAsNumber);
});
element("frame-slider").addEventListener("input", (event) =>
  goTo(state.frames.frame[Number(event.target.value)]));
for (let i = 0; i < 4; i += 1) {
  element(`edge-${i}`).addEventListener("input", (event) => {
    const value = event.target.valueAsNumber;
    if (!stage.box || !Number.isFinite(value)) return;
    const box = [...stage.box];
    box[i] = Math.min(Math.max(value, 0), state.scene.frame_size_px[i % 2]);
    if (box[0] < box[2] && box[1] < box[3]) {
      stage.box = box;
      edited();
    }
  });
}
stage.addEventListener("box", ({ detail }) => {
  if (detail.done && !detail.same) {
    stage.box = stage.box && ordered(stage.box);
    state.unsaved = true;
  }
  showBox();
  look();
});
stage.addEventListener("point", () => {
  points.setPixel(stage.point);
  look();
});
stage.addEventListener("look", look);
let held = null;
element("magnifier").addEventListener("pointerdown", (event) => {
  if (!stage.box) return;
  held = { y: event.clientY, lower: stage.box[3] };
  event.target.setPointerCapture(event.pointerId);
});
element("magnifier").addEventListener("pointermove", (event) => {
  if (!held || !stage.box) return;
  // The picture beneath goes with the pointer, and the edge stays in the middle.
  const lower = held.lower - (event.clientY - held.y) / TIMES;
  stage.box[3] = Math.min(Math.max(lower, stage.box[1] + 0.25), state.scene.frame_size_px[1]);
  edited();
});
for (const kind of ["pointerup", "pointercancel"]) {
  element("magnifier").addEventListener(kind, () => { held = null; });
}
document.addEventListener("keydown", keyed);
whenThemeChanges(showSettings);
addEventListener("resize", look);

async function begin() {
  showSettings();
  try {
    state.scene = await ask("/api/scene");
    const title = plain(`${state.scene.scene} ${state.scene.recording}`.trim());
    element("title").textContent = title;
    document.title = `${title} – sightline draw`;
    const frames = await ask("/api/frames");
    state.frames = { ...frames, known: new Set(frames.frame) };
    element("frame-slider").max = frames.frame.length - 1;
    element("frame-number").max = frames.frame.at(-1);
    take(await ask("/api/state"));
    say(`drawing as ${state.scene.annotator || "unnamed"}`);
    const first = proposed()[0]?.frame ?? following(null) ?? own()[0]?.frame ?? frames.frame[0];
    await goTo(first);
  } catch (error) {
    say(error.message, "refused");
    setTimeout(begin, 2000);
  }
}
begin();

// For those who look, and for tests.
globalThis.sightline = { stage, state, points, check, whose, goTo };
