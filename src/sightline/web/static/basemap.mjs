// The map: water, the tiles and the shore that were given, and lines of latitude and longitude.

import * as maplibre from "/static/maplibre-gl.mjs";
import { collection, graticule } from "/static/geometry.mjs";
import { plain } from "/static/words.mjs";

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

const WATER = /water|ocean|sea|lake|river|bathy|depth/iu;
const LINES = /road|transport|street|highway|rail|bound|ferry|contour|path/iu;

/** How tiles are painted; of vectors by what their layers are called. */
function tileLayers(about) {
  if (about.kind === "raster") {
    return [{ id: "tiles", type: "raster", source: "tiles", paint: { "raster-fade-duration": 0 } }];
  }
  const is = (kind) => ["==", ["geometry-type"], kind];
  // Land first, and water above it; lines over both.
  const areas = about.layers.filter((name) => !LINES.test(name));
  areas.sort((one, other) => WATER.test(one) - WATER.test(other));
  return [
    ...areas.map((name) => ({
      id: `tiles-fill-${name}`, type: "fill", source: "tiles", "source-layer": name, filter: is("Polygon"),
      paint: { "fill-color": colour(WATER.test(name) ? "water" : "land"), "fill-outline-color": colour("shore") },
    })),
    ...about.layers.map((name) => ({
      id: `tiles-line-${name}`, type: "line", source: "tiles", "source-layer": name, filter: is("LineString"),
      paint: { "line-color": colour(LINES.test(name) ? "edge" : "shore"), "line-width": 1 },
    })),
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
    this.tiles = null;
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

  /**
   * Show the user's basemap, beneath all else.
   *
   * @param {object | null} about What the server says of it; null where there is none.
   */
  setTiles(about) {
    if (!about || this.map.getSource("tiles")) return;
    const [west, south, east, north] = about.bounds_deg;
    this.map.addSource("tiles", {
      type: about.kind, tiles: [`${location.origin}/basemap/{z}/{x}/{y}`],
      minzoom: about.zooms[0], maxzoom: about.zooms[1],
      bounds: [west, Math.max(south, -85), east, Math.min(north, 85)],
      ...(about.kind === "raster" ? { tileSize: 256 } : {}),
    });
    this.tiles = about;
    for (const layer of tileLayers(about)) this.map.addLayer(layer, "land");
    if (!about.attribution) return;
    const owed = document.createElement("p");
    owed.className = "attribution";
    owed.textContent = plain(about.attribution);
    this.map.getContainer().append(owed);
  }

  fadePicture(opacity) {
    if (this.map.getLayer("picture")) this.map.setPaintProperty("picture", "raster-opacity", opacity);
  }

  /** Take the colours of the theme that is shown now. */
  repaint() {
    for (const { id, paint } of [...this.layers(), ...(this.tiles ? tileLayers(this.tiles) : [])]) {
      if (!this.map.getLayer(id)) continue;
      for (const [name, value] of Object.entries(paint)) this.map.setPaintProperty(id, name, value);
    }
  }
}
