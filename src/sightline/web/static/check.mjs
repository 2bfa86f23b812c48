// The fit held against the picture: log and water drawn into it, and the picture on the map.

import { BaseMap, colour, line } from "/static/basemap.mjs";
import { ask, send } from "/static/server.mjs";
import { metres, number, plain } from "/static/words.mjs";

const element = (id) => document.getElementById(id);
const PARTS = ["log", "rings", "grid", "horizon"];
const REACH_S = 10;
const ON_PICTURE = { now: "#ffffff", fix: "#f0a030", rings: "#ffffff", grid: "#8cc8e9", horizon: "#e69f00" };

function layers() {
  return [
    {
      id: "ellipses", type: "fill", source: "ellipses",
      paint: { "fill-color": colour("unidentified"), "fill-opacity": 0.12 },
    },
    line("ellipse-edges", "ellipses", {
      "line-color": ["case", ["get", "fix"], colour("unidentified"), colour("ink")],
      "line-width": ["case", ["get", "fix"], 1, 2.5],
    }),
    {
      id: "log", type: "circle", source: "log",
      paint: {
        "circle-radius": ["case", ["get", "fix"], 2.5, 6],
        "circle-color": ["case", ["get", "fix"], colour("unidentified"), colour("ink")],
        "circle-stroke-color": colour("paper"), "circle-stroke-width": 1,
      },
    },
    {
      id: "camera", type: "circle", source: "camera",
      paint: {
        "circle-radius": 5, "circle-color": colour("identified"),
        "circle-stroke-color": colour("paper"), "circle-stroke-width": 1.5,
      },
    },
  ];
}

export class Check {
  /**
   * @param {object} page What the page offers: `frame()`, `show` lines, `say` a line.
   */
  constructor(page) {
    this.page = page;
    this.about = null;
    this.offset = null;
    this.water = null;
    this.log = null;
    this.map = null;
    this.fitted = false;
    this.waterOf = null;
    this.before = null;
    this.asking = { log: null, map: null };
    for (const part of PARTS) element(`show-${part}`).addEventListener("change", () => this.paint());
    element("clock").addEventListener("input", (event) => this.setOffset(event.target.valueAsNumber));
    element("clock-number").addEventListener("input", (event) => this.setOffset(event.target.valueAsNumber));
    element("clock-fit").addEventListener("click", () => this.setOffset(this.about?.clock_offset_s));
    element("clock-write").addEventListener("click", () => this.write(this.offset));
    element("clock-back").addEventListener("click", () => this.back());
    element("reach").addEventListener("change", () => {
      this.fitted = false;
      this.askMap(this.page.frame());
    });
    element("opacity").addEventListener("input", () => this.fade());
  }

  async open() {
    if (!this.map) this.openMap();
    this.waterOf = null;
    try {
      this.take(await ask("/api/fit"));
      this.show();
    } catch (error) {
      this.page.say(error.message, "refused");
    }
  }

  openMap() {
    try {
      this.map = new BaseMap(
        element("check-map"), ["ellipses", "log", "camera"], layers, "Map: the picture as it lies on the water",
      );
    } catch (error) {
      element("check-map").textContent = `The map cannot be drawn: ${error.message}`;
      this.map = null;
      return;
    }
    this.map.scale.setUnit("metric");
    this.map.ready.then(async () => {
      const scene = await ask("/api/scene");
      this.map.setTiles(scene.basemap);
      if (scene.shore) this.map.setShore(await ask("/shore.geojson"));
      this.draw();
    }).catch((error) => this.page.say(error.message, "refused"));
  }

  take(about) {
    this.about = about;
    const there = !about.reason;
    element("check-model").textContent = there ? `Camera: ${plain(about.model)}.` : plain(about.reason);
    element("check-model").dataset.state = there ? "" : "refused";
    for (const id of ["clock", "clock-number", "clock-fit", "clock-write"]) {
      element(id).disabled = !there || !about.logs;
    }
    if (there && this.offset === null) this.setOffset(about.clock_offset_s, false);
    this.showClock();
  }

  /** Take another offset of the clock, and show the log by it. */
  setOffset(seconds, draw = true) {
    if (!Number.isFinite(seconds)) return;
    this.offset = Math.round(1000 * seconds) / 1000;
    const slider = element("clock");
    if (seconds < Number(slider.min) || seconds > Number(slider.max) || !slider.dataset.set) {
      slider.dataset.set = "true";
      slider.min = Math.floor(seconds) - REACH_S;
      slider.max = Math.ceil(seconds) + REACH_S;
    }
    slider.value = this.offset;
    slider.setAttribute("aria-valuetext", `${this.offset} seconds ahead of the log`);
    const field = element("clock-number");
    if (field !== document.activeElement) field.value = this.offset;
    this.showClock();
    if (draw) this.askLog();
  }

  nudge(seconds) {
    if (this.offset !== null) this.setOffset(this.offset + seconds);
  }

  showClock() {
    const { about } = this;
    if (!about || about.reason) {
      element("clock-note").textContent = "";
      element("clock-key").textContent = "";
      return;
    }
    const off = this.log && this.log.rmse_m !== null
      ? `${this.log.boxes} drawn boxes lie ${metres(this.log.rmse_m)} m RMSE from the log by it. ` : "";
    const sigma = about.clock_sigma_s === null ? "" : ` ± ${number(about.clock_sigma_s)}`;
    const stated = about.stated_s === null ? "nothing" : `${number(about.stated_s)} s`;
    const offset = Math.round(1000 * about.clock_offset_s) / 1000;
    element("clock-note").textContent = about.logs
      ? `${off}The fit has ${offset}${sigma} s; the scene states ${stated}.`
      : "The recording has no log.";
    element("clock-key").textContent = about.logs && this.offset !== null
      ? `In the scene: clock_offset_s = ${this.offset}. For sightline track and show: --clock-offset ${this.offset}.`
      : "";
  }

  /** Show all of the frame that is looked at now. */
  async show() {
    if (!this.about || this.about.reason) {
      this.water = this.log = null;
      this.paint();
      return;
    }
    const frame = this.page.frame();
    this.askMap(frame);
    this.askLog();
    try {
      const water = await ask(`/api/fit/${frame}/water`);
      if (frame !== this.page.frame()) return;
      this.water = water;
      this.waterOf = frame;
      this.paint();
    } catch (error) {
      this.page.say(error.message, "refused");
    }
  }

  /** One question at a time, and the newest last: a slider asks faster than it is answered. */
  async newest(name, path, then) {
    const under = this.asking[name] !== null;
    this.asking[name] = path;
    if (under) return;
    let asked = null;
    try {
      while (asked !== this.asking[name]) {
        asked = this.asking[name];
        await then(asked);
      }
    } catch (error) {
      this.page.say(error.message, "refused");
    } finally {
      this.asking[name] = null;
    }
  }

  askLog() {
    if (!this.about || this.about.reason || !this.about.logs || this.offset === null) return;
    const path = `/api/fit/${this.page.frame()}/log?clock_offset_s=${this.offset}`;
    this.newest("log", path, async (asked) => {
      this.log = await ask(asked);
      this.showClock();
      this.paint();
      this.draw();
    });
  }

  askMap(frame) {
    if (!this.about || this.about.reason) return;
    const field = element("reach");
    const wanted = Number.isFinite(field.valueAsNumber) && field.checkValidity()
      ? `reach_m=${field.valueAsNumber}` : "";
    this.newest("map", `${frame}?${wanted}`, async (asked) => {
      const [picture, reach] = asked.split("?");
      const told = await ask(`/api/fit/${picture}/map?${reach}`);
      await this.map?.ready;
      element("check-reach").textContent =
        `The picture on the water as far as ${metres(told.furthest_m)} m${reach ? "" : ": beyond, a row of "
        + "it is more than a tenth of the range"}. What stands above the water lies too far away here.`;
      const corners = told.corners_deg.map(([latitude, longitude]) => [longitude, latitude]);
      const address = new URL(`/rectified/${picture}.webp?fit=${Date.now()}&${reach}`, location.href).href;
      this.map?.setPicture(address, corners, this.opacity());
      if (this.map && !this.fitted) {
        this.fitted = true;
        this.map.fitPlaces(corners, 20, false);
      }
    });
  }

  opacity() {
    return element("opacity").valueAsNumber / 100;
  }

  fade() {
    element("opacity").setAttribute("aria-valuetext", `${element("opacity").value} percent`);
    this.map?.fadePicture(this.opacity());
  }

  /** The lines that belong into the picture. */
  paint() {
    const on = (part) => element(`show-${part}`).checked;
    const lines = [];
    const { water, log } = this;
    if (water && on("grid")) {
      lines.push(...water.grid_px.map((points) => ({ points, style: ON_PICTURE.grid, width: 1 })));
    }
    if (water && on("rings")) {
      for (const ring of water.rings) {
        ring.lines_px.forEach((points, i) => lines.push({
          points, style: ON_PICTURE.rings, width: 1.2, label: i ? "" : distance(ring.radius_m),
        }));
      }
    }
    if (water && on("horizon")) {
      lines.push(...water.horizon_px.map((points) =>
        ({ points, style: ON_PICTURE.horizon, width: 1.5, dash: [8, 5] })));
    }
    const spots = [];
    if (log && on("log")) {
      for (const one of [...log.places].reverse()) {
        const style = one.fix ? ON_PICTURE.fix : ON_PICTURE.now;
        lines.push(...one.ellipse_px.map((points) =>
          ({ points, style, width: one.fix ? 1 : 2, dash: one.fix ? [] : [6, 3] })));
        const label = one.fix ? "" : plain(one.name || "log");
        if (one.pixel_px) spots.push({ pixel: one.pixel_px, style, label, small: one.fix });
      }
    }
    this.page.show(lines, spots);
  }

  draw() {
    if (!this.map) return;
    const places = this.log?.places ?? [];
    const at = ([latitude, longitude]) => [longitude, latitude];
    const features = (geometry) => places.map((one) =>
      ({ type: "Feature", properties: { fix: one.fix }, geometry: geometry(one) }));
    this.map.set("log", features((one) => ({ type: "Point", coordinates: at(one.place_deg) })));
    this.map.set("ellipses", features((one) =>
      ({ type: "Polygon", coordinates: [one.ellipse_deg.map(at)] })));
    if (this.about?.camera_deg) {
      this.map.set("camera", [{
        type: "Feature", properties: {}, geometry: { type: "Point", coordinates: at(this.about.camera_deg) },
      }]);
    }
  }

  /** Write an offset into the scene; null takes it out. */
  async write(seconds) {
    if (!this.about || this.about.reason) return;
    try {
      const told = await send("PUT", "/api/clock", { clock_offset_s: seconds });
      this.before = { seconds: told.before_s };
      element("clock-back").disabled = false;
      this.take(told);
      this.page.say(seconds === null ? "the scene states no clock offset any more"
        : `the scene states clock_offset_s = ${seconds}`);
    } catch (error) {
      this.page.say(error.message, "refused");
    }
  }

  async back() {
    if (!this.before) {
      this.page.say("nothing to take back");
      return;
    }
    await this.write(this.before.seconds);
  }

  repaint() {
    this.map?.repaint();
  }
}

function distance(radius) {
  return radius < 1000 ? `${radius} m` : `${radius / 1000} km`;
}
