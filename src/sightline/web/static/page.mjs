// The page: takes moments from the server, and shows them.

import { Chart } from "/static/chart.mjs";
import { Ground } from "/static/ground.mjs";
import { Filter, Replay } from "/static/history.mjs";
import { Overlays } from "/static/overlays.mjs";
import { Panel } from "/static/panel.mjs";
import { Picture } from "/static/picture.mjs";
import {
  capital, keptSettings, nextSetting, showTheme, whenThemeChanges,
} from "/static/settings.mjs";
import { plain, time } from "/static/words.mjs";

const element = (id) => document.getElementById(id);
const SILENT_MS = 5000;
const LIST_MS = 500;
const HEALTH_MS = 5000;

const choices = { units: ["kn", "km/h"], zone: ["UTC", "local"], theme: ["auto", "light", "dark"], letters: ["on", "off"] };
const settings = keptSettings(choices);

const state = { moment: null, replayed: null, chosen: null, arrivedMs: 0, drawn: true, connected: false };
const panel = new Panel(choose);
const picture = new Picture(element("picture-figure"), element("picture"), choose);
const filter = new Filter(() => {
  draw();
  list();
});
const replay = new Replay(showKept, () => settings.zone);
let chart = null;
let overlays = null;
let ground = null;
try {
  applyTheme();
  chart = new Chart(element("map"), choose);
  overlays = new Overlays(chart);
  ground = new Ground(chart, element("on-map"), element("on-map-opacity"));
} catch (error) {
  element("map-notice").hidden = false;
  element("map-notice").textContent = `The map cannot be drawn: ${error.message}`;
}

/** The moment that is shown: what was kept while that is replayed, else the newest. */
function shown() {
  return state.replayed ?? state.moment;
}

function targets() {
  return filter.apply(shown()?.targets ?? []);
}

function showKept(moment) {
  // The trails of one time are not those of another.
  if ((moment === null) !== (state.replayed === null)) chart?.trails.clear();
  state.replayed = moment;
  ground?.replay(moment !== null);
  draw();
  list();
  status();
}

function choose(id) {
  state.chosen = id;
  const target = targets().find((one) => one.id === id);
  if (target) chart?.show(target);
  draw();
  list();
  if (id !== null) panel.rows.get(id)?.row.scrollIntoView({ block: "nearest" });
}

function draw() {
  const moment = shown();
  if (!moment) return;
  state.drawn = true;
  chart?.draw(targets(), Date.parse(moment.time_utc) / 1000, state.chosen);
  overlays?.draw(moment);
  // The picture is of now.
  picture.draw(state.replayed ? [] : targets(), state.chosen);
}

function list() {
  panel.list(targets(), state.chosen, settings.units);
  const target = targets().find((one) => one.id === state.chosen);
  panel.detail(target, state.chosen, settings.units);
  const moment = shown();
  if (moment) {
    const clock = moment.capture === "arrival" ? " (time of arrival)" : "";
    element("clock").textContent = time(Date.parse(moment.time_utc), settings.zone) + clock;
  }
}

function status() {
  const silent = performance.now() - state.arrivedMs;
  const line = element("status");
  let [word, text] = ["live", "live"];
  if (state.replayed) [word, text] = ["waiting", "replay of what was kept"];
  else if (!state.connected) [word, text] = ["lost", "not connected; trying again"];
  else if (!state.moment) [word, text] = ["waiting", "waiting for the camera"];
  else if (silent > SILENT_MS) [word, text] = ["lost", `nothing for ${Math.round(silent / 1000)} s`];
  line.dataset.state = word;
  if (line.textContent !== text) line.textContent = text;
}

function receive(text) {
  state.moment = JSON.parse(text);
  state.arrivedMs = performance.now();
  const camera = plain(state.moment.camera);
  if (element("camera").textContent !== camera) {
    element("camera").textContent = camera;
    document.title = `${camera} – sightline`;
  }
  // However many arrive, one is drawn a frame.
  if (state.drawn) {
    state.drawn = false;
    requestAnimationFrame(draw);
  }
}

let pauseMs = 500;
function listen() {
  const socket = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}/ws`);
  socket.addEventListener("open", () => {
    state.connected = true;
    pauseMs = 500;
    status();
  });
  socket.addEventListener("message", (event) => receive(event.data));
  socket.addEventListener("close", () => {
    state.connected = false;
    status();
    setTimeout(listen, pauseMs * (0.75 + 0.5 * Math.random()));
    pauseMs = Math.min(2 * pauseMs, 15_000);
  });
}

async function health() {
  try {
    const answer = await fetch("/healthz", { cache: "no-store" });
    if (answer.ok || answer.status === 503) panel.health(await answer.json());
    else panel.health({ state: "unknown", reason: `the server answers ${answer.status}` });
  } catch {
    panel.health({ state: "unknown", reason: "the server does not answer" });
  }
}

async function recall() {
  await chart?.ready;
  for (const [path, take] of [
    ["/tracks.geojson?minutes=5", (data) => chart?.recall(data)],
    ["/shore.geojson", (data) => chart?.setShore(data)],
    ["/boundaries.geojson", (data) => overlays?.ready.then(() => overlays.setBoundaries(data))],
  ]) {
    try {
      const about = await (await fetch("/api/about", { cache: "no-store" })).json();
      replay.toggleButton.hidden = !about.kept;
      element("on-map").hidden = !about.on_the_map || !ground;
      chart?.setTiles(about.basemap);
      if (path === "/shore.geojson" && !about.shore) continue;
      if (path === "/boundaries.geojson" && !about.boundaries) continue;
      const answer = await fetch(path, { cache: "no-store" });
      if (answer.ok) take(await answer.json());
    } catch {
      // The map is of use without them.
    }
  }
  draw();
  document.documentElement.dataset.ready = "true";
}

function applyTheme() {
  showTheme(settings.theme);
  chart?.repaint();
  overlays?.repaint();
  picture.paint();
}

function applySettings() {
  element("units").textContent = settings.units;
  element("zone").textContent = settings.zone;
  element("theme").textContent = capital(settings.theme);
  element("letters").textContent = `Keys ${settings.letters}`;
  chart?.setUnits(settings.units);
  applyTheme();
  list();
}

function next(name) {
  nextSetting(settings, choices, name);
  applySettings();
}

const actions = {
  f: () => chart?.fit(targets()),
  r: () => replay.toggleButton.hidden || replay.toggle(),
  p: () => replay.play(),
  u: () => next("units"),
  t: () => next("zone"),
  d: () => next("theme"),
  o: () => ground?.fade(10),
  O: () => ground?.fade(-10),
  Escape: () => choose(null),
};
element("letters").addEventListener("click", () => next("letters"));
for (const [id, key] of [["fit", "f"], ["units", "u"], ["zone", "t"], ["theme", "d"]]) {
  element(id).addEventListener("click", actions[key]);
}
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  // There, letters choose.
  if (event.target instanceof HTMLSelectElement) return;
  if (event.key.length === 1 && settings.letters === "off") return;
  actions[event.key]?.();
});
whenThemeChanges(applyTheme);
addEventListener("resize", () => picture.paint());

replay.toggleButton.hidden = true;
document.querySelector(".controls").append(filter.which, filter.classes, replay.toggleButton);
element("map-section").append(replay.controls);

chart?.ready.then(applyTheme);
overlays?.ready.then(applyTheme);
applySettings();
listen();
recall();
health();
setInterval(list, LIST_MS);
setInterval(status, 1000);
setInterval(health, HEALTH_MS);

// For those who look, and for tests.
globalThis.sightline = { chart, overlays, ground, picture, replay, state, choose };
