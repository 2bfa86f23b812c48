// A map without tiles: water, the shore that was given, and lines of latitude and longitude.

import * as maplibre from "/static/maplibre-gl.mjs";
import { collection, graticule } from "/static/geometry.mjs";

maplibre.setWorkerUrl("/static/maplibre-gl-worker.mjs");

const EMPTY = collection([]);
const GROUND = ["grid", "grid-labels", "shore"];

export const FONT = ["system-ui, sans-serif"];

/** A colour of the theme. */
export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

export function line(id, source, paint, more = {}) {
  return { id, type: "line", source, paint, ...more };
}

export function halo() {
  return { "text-halo-color": colour("water"), "text-halo-width": 2 };
}

/** What lies beneath all else, in the colours of the theme. */
function ground() {
  return [
    { id: "water", type: "background", paint: { "background-color": colour("water") } },
    {
      id: "land", type: "fill", source: "shore", filter: ["==", ["geometry-type"], "Polygon"],
      paint: { "fill-color": colour("land") },
    },
    line("shore", "shore", { "line-color": colour("shore"), "line-width": 1.2 }),
    line("grid", "grid", { "line-color": colour("grid"), "line-width": 1 }),
    {
      id: "grid-labels", type: "symbol", source: "grid-labels",
      layout: {
        "text-font": FONT, "text-size": 11, "text-field": ["get", "label"],
        "text-anchor": ["get", "anchor"], "text-padding": 0, "text-offset": [0.2, -0.1],
      },
      paint: { "text-color": colour("soft"), ...halo() },
    },
  ];
}

export class BaseMap {
  /**
   * @param {HTMLElement} element Where it is.
   * @param {string[]} sources Names of what is drawn on it.
   * @param {() => object[]} layers How, in the colours of the theme.
   * @param {string} title What it is to those who do not see it.
   */
  constructor(element, sources, layers, title) {
    this.layers = () => [...ground(), ...layers()];
    this.map = new maplibre.Map({
      container: element,
      style: {
        version: 8,
        sources: Object.fromEntries(
          [...GROUND, ...sources].map((name) =>
            [name, { type: "geojson", data: EMPTY, tolerance: 0 }]),
        ),
        layers: this.layers(),
      },
      center: [0, 0],
      zoom: 1,
      maxZoom: 21,
      attributionControl: false,
      dragRotate: false,
      pitchWithRotate: false,
      touchPitch: false,
      fadeDuration: 0,
      locale: { "Map.Title": title },
    });
    this.map.touchZoomRotate.disableRotation();
    this.map.keyboard.disableRotation();
    this.map.addControl(new maplibre.NavigationControl({ showCompass: false }), "top-right");
    this.scale = new maplibre.ScaleControl({ maxWidth: 140, unit: "nautical" });
    this.map.addControl(this.scale, "bottom-right");
    this.ready = new Promise((resolve) => this.map.once("load", resolve));
    this.ready.then(() => this.drawGrid());
    this.map.on("moveend", () => this.drawGrid());
  }

  set(name, features) {
    this.map.getSource(name)?.setData(collection(features));
  }

  drawGrid() {
    const { lines, labels } = graticule(this.map.getBounds());
    this.map.getSource("grid")?.setData(lines);
    this.map.getSource("grid-labels")?.setData(labels);
  }

  /** Show all of some places, each as [longitude, latitude]. */
  fitPlaces(places, padding, animate = true) {
    const bounds = new maplibre.LngLatBounds();
    for (const place of places) bounds.extend(place);
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.map.fitBounds(bounds, { padding, maxZoom: 18, animate: animate && !calm });
  }

  setShore(data) {
    this.map.getSource("shore")?.setData(data);
  }

  /**
   * Lay a picture onto the water, beneath all else.
   *
   * @param {string} url Where it is.
   * @param {number[][]} corners [longitude, latitude] from its upper left one clockwise.
   * @param {number} opacity From 0 to 1.
   */
  setPicture(url, corners, opacity) {
    const known = this.map.getSource("picture");
    if (known) {
      known.updateImage({ url, coordinates: corners });
      return;
    }
    this.map.addSource("picture", { type: "image", url, coordinates: corners });
    this.map.addLayer({
      id: "picture", type: "raster", source: "picture",
      paint: { "raster-opacity": opacity, "raster-fade-duration": 0 },
    }, "shore");
  }

  fadePicture(opacity) {
    if (this.map.getLayer("picture")) this.map.setPaintProperty("picture", "raster-opacity", opacity);
  }

  /** Take the colours of the theme that is shown now. */
  repaint() {
    for (const { id, paint } of this.layers()) {
      if (!this.map.getLayer(id)) continue;
      for (const [name, value] of Object.entries(paint)) this.map.setPaintProperty(id, name, value);
    }
  }
}
