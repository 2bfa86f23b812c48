// What the map shows besides targets: lines, zones, and vessels that no target is.

import { collection } from "/static/geometry.mjs";
import { plain } from "/static/words.mjs";

const FONT = ["system-ui, sans-serif"];

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function layers() {
  const text = { "text-font": FONT, "text-size": 12 };
  const halo = { "text-halo-color": colour("water"), "text-halo-width": 2 };
  return [
    {
      id: "zones", type: "fill", source: "boundaries", filter: ["==", ["geometry-type"], "Polygon"],
      paint: { "fill-color": colour("focus"), "fill-opacity": 0.08 },
    },
    {
      id: "boundaries", type: "line", source: "boundaries",
      paint: { "line-color": colour("focus"), "line-width": 2, "line-dasharray": [4, 2] },
    },
    {
      id: "boundary-names", type: "symbol", source: "boundaries",
      layout: { ...text, "text-field": ["get", "title"], "symbol-placement": "point", "text-max-width": 30 },
      paint: { "text-color": colour("focus"), ...halo },
    },
    {
      id: "unseen", type: "symbol", source: "unseen",
      layout: {
        ...text, "text-field": ["concat", "✕ ", ["get", "title"]], "text-anchor": "left",
        "text-offset": [-0.4, 0], "text-max-width": 30, "text-optional": true,
      },
      paint: { "text-color": colour("soft"), ...halo },
    },
  ];
}

export class Overlays {
  /** @param {import("/static/chart.mjs").Chart} chart The map that they are drawn on. */
  constructor(chart) {
    this.map = chart.map;
    this.features = [];
    this.ready = chart.ready.then(() => {
      for (const name of ["boundaries", "unseen"]) {
        this.map.addSource(name, { type: "geojson", data: collection([]) });
      }
      for (const layer of layers()) this.map.addLayer(layer, "trails");
    });
  }

  setBoundaries(data) {
    this.features = data.features;
    this.draw({});
  }

  /** What was counted, and which vessels are not seen, at a moment. */
  draw(moment) {
    const counts = new Map((moment.boundaries ?? []).map((one) => [`${one.kind} ${one.name}`, one]));
    this.map.getSource("boundaries")?.setData(collection(this.features.map((one) => {
      const { name, kind } = one.properties;
      const told = counts.get(`${kind} ${name}`);
      const number = !told ? ""
        : kind === "line" ? `: ${told.left_to_right} → ${told.right_to_left} ←` : `: ${told.inside}`;
      return { ...one, properties: { ...one.properties, title: `${plain(name)}${number}` } };
    })));
    this.map.getSource("unseen")?.setData(collection((moment.vessels_without_target ?? []).map((one) => ({
      type: "Feature",
      properties: { title: one.name ? plain(one.name) : `MMSI ${String(one.mmsi).padStart(9, "0")}` },
      geometry: { type: "Point", coordinates: [one.longitude_deg, one.latitude_deg] },
    }))));
  }

  repaint() {
    for (const { id, paint } of layers()) {
      if (!this.map.getLayer(id)) continue;
      for (const [name, value] of Object.entries(paint)) this.map.setPaintProperty(id, name, value);
    }
  }
}
