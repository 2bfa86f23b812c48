// Control points: a pixel and its place on the earth, with what a fit makes of them.

import { BaseMap, colour, line } from "/static/basemap.mjs";
import { ask, send } from "/static/server.mjs";
import { metres, plain } from "/static/words.mjs";

const element = (id) => document.getElementById(id);
const PLACE_WAIT_MS = 250;
const HINT = "Typed, pasted, or clicked on the map below.";

function layers() {
  return [
    line("fit-lines", "fit-lines", { "line-color": colour("bad"), "line-width": 2 }),
    {
      id: "camera", type: "circle", source: "camera",
      paint: {
        "circle-radius": 5, "circle-color": colour("ink"),
        "circle-stroke-color": colour("paper"), "circle-stroke-width": 1.5,
      },
    },
    {
      id: "points", type: "circle", source: "points",
      paint: {
        "circle-radius": ["case", ["get", "chosen"], 8, 5], "circle-color": colour("identified"),
        "circle-stroke-color": colour("paper"), "circle-stroke-width": 1.5,
      },
    },
    {
      id: "new-place", type: "circle", source: "new-place",
      paint: {
        "circle-radius": 6, "circle-color": colour("unidentified"),
        "circle-stroke-color": colour("paper"), "circle-stroke-width": 2,
      },
    },
  ];
}

export class Points {
  /**
   * @param {object} page What the page offers: `pick` a pixel, `show` marks, `say` a line.
   */
  constructor(page) {
    this.page = page;
    this.list = [];
    this.fits = new Map();
    this.fitting = 0;
    this.chosen = null;
    this.pixel = null;
    this.map = null;
    this.timer = 0;
    element("point-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.save();
    });
    element("place").addEventListener("input", () => this.parse());
    element("point-remove").addEventListener("click", () => this.remove());
    element("point-new").addEventListener("click", () => this.choose(null));
    for (const i of [0, 1]) {
      element(`pixel-${i}`).addEventListener("input", (event) => {
        const value = event.target.valueAsNumber;
        if (!Number.isFinite(value)) return;
        const pixel = this.pixel ? [...this.pixel] : page.size().map((size) => size / 2);
        pixel[i] = Math.min(Math.max(value, 0), page.size()[i]);
        this.pixel = pixel;
        page.pick(pixel);
      });
    }
  }

  async open() {
    if (!this.map) this.openMap();
    try {
      this.take(await ask("/api/points"));
      if (this.list.length) this.fit();
    } catch (error) {
      this.page.say(error.message, "refused");
    }
  }

  openMap() {
    try {
      this.map = new BaseMap(
        element("point-map"), ["camera", "fit-lines", "points", "new-place"], layers,
        "Map: click the place of the pixel",
      );
    } catch (error) {
      element("point-map").textContent = `The map cannot be drawn: ${error.message}`;
      this.map = null;
      return;
    }
    this.map.scale.setUnit("metric");
    this.map.map.getCanvas().style.cursor = "crosshair";
    this.map.map.on("click", ({ lngLat }) => {
      element("place").value = `${lngLat.lat.toFixed(7)}, ${lngLat.lng.toFixed(7)}`;
      this.parse();
    });
    this.map.ready.then(async () => {
      const scene = await ask("/api/scene");
      const places = scene.places_deg.map(([latitude, longitude]) => [longitude, latitude]);
      const all = [...places, ...this.list.map((one) => [one.longitude_deg, one.latitude_deg])];
      const [west, south, east, north] = scene.basemap?.bounds_deg ?? [];
      if (all.length) this.map.fitPlaces(all, 30, false);
      // Of a place that nothing tells, the user's map does.
      else if (scene.basemap) this.map.fitPlaces([[west, south], [east, north]], 10, false);
      this.map.set("camera", places.slice(0, 1).map((place) => spot(place)));
      this.map.setTiles(scene.basemap);
      if (scene.shore) this.map.setShore(await ask("/shore.geojson"));
      this.draw();
    }).catch((error) => this.page.say(error.message, "refused"));
  }

  take(told) {
    this.list = told.points;
    if (told.error) this.note(told.error);
    const rows = this.list.map((one) => {
      const row = document.createElement("tr");
      const name = document.createElement("button");
      name.type = "button";
      name.textContent = titleOf(one);
      name.setAttribute("aria-pressed", String(one.number === this.chosen));
      name.addEventListener("click", () => this.choose(one.number));
      const cells = Array.from({ length: 3 }, () => document.createElement("td"));
      const fit = this.fits.get(one.number);
      cells[0].append(name);
      cells[1].textContent = fit?.error_m == null ? "–" : metres(fit.error_m);
      cells[2].textContent = fit?.left_out_m == null ? "–" : metres(fit.left_out_m);
      row.setAttribute("aria-selected", String(one.number === this.chosen));
      row.append(...cells);
      return row;
    });
    const held = document.activeElement?.closest?.("#points tr");
    const at = held ? [...element("points").children].indexOf(held) : -1;
    element("points").replaceChildren(...rows);
    rows[at]?.querySelector("button").focus();
    this.draw();
  }

  note(text) {
    element("points-note").textContent = plain(text);
  }

  /** Ask what a fit makes of them; what is newest counts. */
  async fit() {
    this.fitting += 1;
    const number = this.fitting;
    this.fits = new Map();
    this.take({ points: this.list });
    this.note(this.list.length ? "Fitting …" : "");
    try {
      // That of all points is there at once; those without each take longer.
      for (const leftOut of [false, true]) {
        let told = { stale: true };
        while (told.stale) {
          told = await ask(`/api/points/fit?left_out=${leftOut}`);
          if (number !== this.fitting) return;
        }
        this.fits = new Map(told.points.map((one) => [one.number, one]));
        this.note(told.error || fitWords(told, leftOut));
        this.take({ points: this.list });
        if (told.error) return;
      }
    } catch (error) {
      if (number === this.fitting) this.note(error.message);
    }
  }

  draw() {
    this.page.show(this.list.map((one) => ({
      pixel: one.pixel_px, label: titleOf(one), chosen: one.number === this.chosen,
    })));
    this.map?.set("points", this.list.map((one) =>
      spot([one.longitude_deg, one.latitude_deg], { chosen: one.number === this.chosen })));
    this.map?.set("fit-lines", this.list.flatMap((one) => {
      const place = this.fits.get(one.number)?.place_deg;
      const coordinates = place
        && [[one.longitude_deg, one.latitude_deg], [place[1], place[0]]];
      return place
        ? [{ type: "Feature", properties: {}, geometry: { type: "LineString", coordinates } }] : [];
    }));
  }

  setPixel(pixel) {
    this.pixel = pixel;
    for (const i of [0, 1]) {
      element(`pixel-${i}`).value = pixel ? String(Math.round(100 * pixel[i]) / 100) : "";
    }
  }

  /** Take a point up to be mended; null for a new one. */
  choose(number) {
    this.chosen = number;
    const one = this.list.find((each) => each.number === number) ?? null;
    element("place").value = one ? `${one.latitude_deg}, ${one.longitude_deg}` : "";
    element("point-name").value = one ? plain(one.name) : "";
    element("point-name").disabled = Boolean(one);
    element("points-title").textContent = one ? titleOf(one) : "Control point";
    element("point-save").textContent = one ? "Save" : "Add";
    element("point-remove").hidden = !one;
    element("point-new").hidden = !one;
    this.setPixel(one ? [...one.pixel_px] : null);
    this.page.pick(this.pixel);
    this.parse();
    this.take({ points: this.list });
  }

  /** Say what a place is read as. */
  parse() {
    clearTimeout(this.timer);
    const text = element("place").value.trim();
    this.timer = setTimeout(async () => {
      const note = element("place-note");
      if (!text) {
        note.dataset.state = "";
        note.textContent = HINT;
        this.map?.set("new-place", []);
        return;
      }
      try {
        const { latitude_deg: latitude, longitude_deg: longitude, reason } =
          await send("POST", "/api/place", { place: text });
        if (element("place").value.trim() !== text) return;
        if (reason) throw new Error(reason);
        note.dataset.state = "";
        note.textContent = `Read as ${latitude.toFixed(7)}, ${longitude.toFixed(7)}.`;
        this.map?.set("new-place", [spot([longitude, latitude])]);
      } catch (error) {
        note.dataset.state = "refused";
        note.textContent = plain(error.message);
        this.map?.set("new-place", []);
      }
    }, PLACE_WAIT_MS);
  }

  async change(method, path, body, words) {
    try {
      const told = await send(method, path, body);
      this.chosen = null;
      this.take(told);
      this.choose(null);
      this.page.say(told.count ? words : "nothing to take back");
      // The next thing is another pixel.
      element("stage").focus({ preventScroll: true });
      this.fit();
      return true;
    } catch (error) {
      this.page.say(error.message, "refused");
      return false;
    }
  }

  async save() {
    if (!this.pixel) {
      this.page.say("choose a pixel in the picture first", "refused");
      return;
    }
    const place = element("place").value.trim();
    if (!place) {
      this.page.say("give the place of the pixel: type or paste it, or click the map", "refused");
      return;
    }
    const body = { pixel_px: this.pixel, place };
    if (this.chosen === null) {
      const name = element("point-name").value;
      await this.change("POST", "/api/points", { ...body, name }, "point added");
    } else {
      await this.change("PUT", "/api/points", { ...body, number: this.chosen }, "point saved");
    }
  }

  async remove() {
    if (this.chosen === null) return;
    await this.change("DELETE", "/api/points", { number: this.chosen }, "point removed");
  }

  async back(again) {
    await this.change(
      "POST", again ? "/api/points/redo" : "/api/points/undo", {}, again ? "made again" : "taken back",
    );
  }

  repaint() {
    this.map?.repaint();
  }
}

function fitWords(told, leftOut) {
  if (!told.points.length) return "";
  const without = !leftOut ? "; each is being left out in turn …"
    : told.left_out_m === null ? "" : `, ${metres(told.left_out_m)} m each by a fit without it`;
  const out = told.points.filter((one) => one.outlier).map((one) => one.number);
  const outliers = out.length ? ` It leaves out point ${out.join(", ")}.` : "";
  const off = told.rmse_m === null ? "" : `The fit is ${metres(told.rmse_m)} m RMSE off the points`;
  return `${off}${without}.${outliers}`;
}

function titleOf(one) {
  return one.name ? plain(one.name) : `point ${one.number}`;
}

function spot(place, properties = {}) {
  return { type: "Feature", properties, geometry: { type: "Point", coordinates: place } };
}
