// The map: targets with their ellipses, courses, trails and names.

import { BaseMap, colour, FONT, halo, line } from "/static/basemap.mjs";
import { ahead, ellipseRing } from "/static/geometry.mjs";
import { kind, title } from "/static/words.mjs";

const AHEAD_S = 60;
const TRAIL_S = 300;
const TRAIL_POINTS = 200;
const SOURCES = ["trails", "ellipses", "courses", "targets"];

function byKind() {
  return [
    "match", ["get", "kind"],
    "identified", colour("identified"),
    "moored", colour("moored"),
    colour("unidentified"),
  ];
}

const CHOSEN = ["get", "chosen"];

/** What is painted how, in the colours of the theme. */
function layers() {
  return [
    line("trails", "trails", {
      "line-color": byKind(), "line-width": ["case", CHOSEN, 3, 1.5], "line-opacity": 0.55,
    }, { layout: { "line-cap": "round", "line-join": "round" } }),
    {
      id: "ellipses", type: "fill", source: "ellipses",
      paint: { "fill-color": byKind(), "fill-opacity": ["case", CHOSEN, 0.25, 0.1] },
    },
    line("ellipse-edges", "ellipses", {
      "line-color": byKind(), "line-width": ["case", CHOSEN, 2.5, 1],
    }, { filter: ["!=", ["get", "state"], "predicted"] }),
    line("ellipse-edges-predicted", "ellipses", {
      "line-color": byKind(), "line-width": ["case", CHOSEN, 2.5, 1.2], "line-dasharray": [3, 2],
    }, { filter: ["==", ["get", "state"], "predicted"] }),
    line("courses", "courses", { "line-color": colour("ink"), "line-width": 1.8 }),
    {
      id: "targets", type: "circle", source: "targets",
      paint: {
        "circle-radius": [
          "+", ["case", CHOSEN, 3, 0], ["match", ["get", "kind"], "moored", 3.5, 5],
        ],
        "circle-color": ["match", ["get", "kind"], "unidentified", colour("paper"), byKind()],
        "circle-stroke-color": [
          "case", CHOSEN, colour("ink"),
          ["match", ["get", "kind"], "unidentified", colour("unidentified"), colour("paper")],
        ],
        "circle-stroke-width": ["match", ["get", "kind"], "unidentified", 3, 1.5],
      },
    },
    {
      id: "names", type: "symbol", source: "targets",
      layout: {
        "text-font": FONT, "text-size": 12, "text-field": ["get", "title"], "text-anchor": "left", "text-offset": [0.9, 0],
        "text-max-width": 30,
        "text-optional": true, "symbol-sort-key": ["case", CHOSEN, 0, 1],
      },
      paint: { "text-color": colour("ink"), ...halo() },
    },
  ];
}

function moves(target) {
  return target.speed_mps > 0.2 && target.course_deg !== null && target.state !== "moored";
}

function feature(target, geometry, chosen) {
  return {
    type: "Feature",
    id: target.id,
    properties: {
      id: target.id,
      kind: kind(target),
      state: target.state,
      title: title(target),
      chosen: target.id === chosen,
    },
    geometry,
  };
}

export class Chart extends BaseMap {
  /**
   * @param {HTMLElement} element Where it is.
   * @param {(id: number | null) => void} choose Called with the target that was clicked.
   */
  constructor(element, choose) {
    super(element, SOURCES, layers, "Map of the targets");
    this.trails = new Map();
    this.fitted = false;
    this.map.on("click", (event) => choose(this.at(event.point)));
    this.map.on("mousemove", (event) => {
      this.map.getCanvas().style.cursor = this.at(event.point) === null ? "" : "pointer";
    });
  }

  /** The target near a point of the screen. */
  at(point) {
    if (!this.map.loaded() && !this.map.getLayer("targets")) return null;
    const around = [[point.x - 8, point.y - 8], [point.x + 8, point.y + 8]];
    const found = this.map.queryRenderedFeatures(around, { layers: ["targets"] });
    const near = found.length
      ? found
      : this.map.queryRenderedFeatures(point, { layers: ["ellipses"] });
    return near.length ? near[0].properties.id : null;
  }

  /** Draw the targets of a moment. */
  draw(targets, timeS, chosen) {
    const point = (place) => ({ type: "Point", coordinates: place });
    const line = (places) => ({ type: "LineString", coordinates: places });
    this.set("targets", targets.map((one) =>
      feature(one, point([one.longitude_deg, one.latitude_deg]), chosen)));
    this.set("ellipses", targets.map((one) =>
      feature(one, { type: "Polygon", coordinates: [ellipseRing(one)] }, chosen)));
    this.set("courses", targets
      .filter(moves)
      .map((one) =>
        feature(one, line([[one.longitude_deg, one.latitude_deg], ahead(one, AHEAD_S)]), chosen)));
    this.remember(targets, timeS);
    this.set("trails", targets.flatMap((one) => {
      const trail = this.trails.get(one.id) ?? [];
      const places = trail.map((each) => each.place);
      places.push([one.longitude_deg, one.latitude_deg]);
      return places.length > 1 ? [feature(one, line(places), chosen)] : [];
    }));
    if (!this.fitted && targets.length) {
      this.fitted = true;
      this.fit(targets, false);
    }
  }

  /** Keep a place every two seconds of each target, for some minutes. */
  remember(targets, timeS) {
    const present = new Set();
    for (const one of targets) {
      present.add(one.id);
      const trail = this.trails.get(one.id) ?? [];
      this.trails.set(one.id, trail);
      const last = trail.at(-1)?.timeS ?? -Infinity;
      // A clock that was set back begins anew.
      if (timeS < last) trail.length = 0;
      if (timeS < last || timeS - last >= 2) {
        trail.push({ timeS, place: [one.longitude_deg, one.latitude_deg] });
      }
      while (trail.length > TRAIL_POINTS || (trail.length && trail[0].timeS < timeS - TRAIL_S)) {
        trail.shift();
      }
    }
    for (const id of this.trails.keys()) {
      if (!present.has(id)) this.trails.delete(id);
    }
  }

  /** Take trails from what the server remembers. */
  recall(tracks) {
    for (const { id, geometry, properties } of tracks.features) {
      if (geometry.type !== "LineString") continue;
      const before = geometry.coordinates.map((place, i) => ({
        place, timeS: Date.parse(properties.coordTimes[i]) / 1000,
      }));
      const since = this.trails.get(id) ?? [];
      const first = since[0]?.timeS ?? Infinity;
      this.trails.set(id, [...before.filter((one) => one.timeS < first), ...since]);
    }
  }

  /** Show all targets. */
  fit(targets, animate = true) {
    if (!targets.length) return;
    const places = targets.flatMap((one) => [
      [one.longitude_deg, one.latitude_deg],
      ...ellipseRing(one, 8),
      ...(moves(one) ? [ahead(one, AHEAD_S)] : []),
      ...(this.trails.get(one.id) ?? []).map((each) => each.place),
    ]);
    // Room for the legend above and for names at the right.
    const side = Math.min(110, 0.12 * this.map.getContainer().clientWidth);
    this.fitPlaces(places, { top: 70, bottom: 60, left: 0.5 * side, right: side }, animate);
  }

  /** Bring a target into view. */
  show(target) {
    const place = [target.longitude_deg, target.latitude_deg];
    if (!this.map.getBounds().contains(place)) this.map.easeTo({ center: place });
  }

  setUnits(units) {
    this.scale.setUnit(units === "kn" ? "nautical" : "metric");
  }
}
