// Shapes on the WGS 84 ellipsoid, near a point.

const A_M = 6378137.0;
const E2 = 0.00669437999014;
const RADIANS = Math.PI / 180;

// The 95 % quantile of chi squared with two degrees of freedom is -2 ln 0.05.
export const SCALE_95 = Math.sqrt(-2 * Math.log(0.05));

/** Metres of a degree of longitude and of latitude. */
export function metresPerDegree(latitudeDeg) {
  const sine = Math.sin(latitudeDeg * RADIANS);
  const w2 = 1 - E2 * sine * sine;
  const east = (A_M / Math.sqrt(w2)) * Math.cos(latitudeDeg * RADIANS) * RADIANS;
  const north = ((A_M * (1 - E2)) / (w2 * Math.sqrt(w2))) * RADIANS;
  return [east, north];
}

/** A place some metres east and north of another, as [longitude, latitude]. */
export function offset(target, eastM, northM) {
  const [perLongitude, perLatitude] = metresPerDegree(target.latitude_deg);
  return [target.longitude_deg + eastM / perLongitude, target.latitude_deg + northM / perLatitude];
}

/** Half axes and the bearing of the long one, from the covariance in metres east and north. */
export function ellipse(covariance) {
  const [[east, cross], [, north]] = covariance;
  const middle = (east + north) / 2;
  const root = Math.hypot((east - north) / 2, cross);
  const angle = 0.5 * Math.atan2(2 * cross, east - north);
  return {
    major_m: SCALE_95 * Math.sqrt(Math.max(middle + root, 0)),
    minor_m: SCALE_95 * Math.sqrt(Math.max(middle - root, 0)),
    angle,
    bearing_deg: (((90 - angle / RADIANS) % 180) + 180) % 180,
  };
}

/** The ring of the 95 % ellipse of a target. */
export function ellipseRing(target, corners = 48) {
  const { major_m, minor_m, angle } = ellipse(target.covariance_m2);
  const [perLongitude, perLatitude] = metresPerDegree(target.latitude_deg);
  const cosine = Math.cos(angle);
  const sine = Math.sin(angle);
  const ring = [];
  for (let i = 0; i <= corners; i += 1) {
    const turn = (2 * Math.PI * (i % corners)) / corners;
    const along = major_m * Math.cos(turn);
    const across = minor_m * Math.sin(turn);
    ring.push([
      target.longitude_deg + (along * cosine - across * sine) / perLongitude,
      target.latitude_deg + (along * sine + across * cosine) / perLatitude,
    ]);
  }
  return ring;
}

/** Where a target will be after some seconds, if it goes on as it does. */
export function ahead(target, seconds) {
  const course = target.course_deg * RADIANS;
  const way = target.speed_mps * seconds;
  return offset(target, way * Math.sin(course), way * Math.cos(course));
}

const STEPS_DEG = [
  10, 5, 2, 1, 1 / 2, 1 / 3, 1 / 6, 1 / 12, 1 / 30, 1 / 60, 1 / 120, 1 / 300, 1 / 600, 1 / 1200,
  1 / 3000, 1 / 6000, 1 / 12000, 1 / 30000, 1 / 60000,
];

/** Lines of latitude and longitude in a view, some of each, and their labels. */
export function graticule(bounds) {
  const [west, south, east, north] = [
    bounds.getWest(), bounds.getSouth(), bounds.getEast(), bounds.getNorth(),
  ];
  const span = Math.min(east - west, 2 * (north - south));
  const step = STEPS_DEG.find((one) => span / one >= 4) ?? STEPS_DEG.at(-1);
  const lines = [];
  const labels = [];
  const add = (line, place, label, anchor) => {
    lines.push({ type: "Feature", properties: {}, geometry: { type: "LineString", coordinates: line } });
    labels.push({
      type: "Feature", properties: { label, anchor }, geometry: { type: "Point", coordinates: place },
    });
  };
  const edge = 0.004;
  for (let i = Math.ceil(west / step); i * step <= east && lines.length < 60; i += 1) {
    const x = i * step;
    const place = [x, south + edge * (north - south)];
    add([[x, south], [x, north]], place, degreesMinutes(x, "EW", step), "bottom-left");
  }
  for (let i = Math.ceil(south / step); i * step <= north && lines.length < 120; i += 1) {
    const y = i * step;
    const place = [west + edge * (east - west), y];
    add([[west, y], [east, y]], place, degreesMinutes(y, "NS", step), "bottom-left");
  }
  return { lines: collection(lines), labels: collection(labels) };
}

/** Degrees and minutes, with as many digits as a step needs. */
export function degreesMinutes(valueDeg, signs, stepDeg = 1 / 60000) {
  const digits = Math.min(3, Math.max(0, Math.ceil(-Math.log10(stepDeg * 60) - 1e-9)));
  const parts = Math.round(Math.abs(valueDeg) * 60 * 10 ** digits);
  const degrees = Math.floor(parts / (60 * 10 ** digits));
  const minutes = (parts - degrees * 60 * 10 ** digits) / 10 ** digits;
  const sign = parts === 0 ? "" : signs[valueDeg < 0 ? 1 : 0];
  const width = digits ? digits + 3 : 2;
  return `${degrees}° ${minutes.toFixed(digits).padStart(width, "0")}′ ${sign}`.trim();
}

export function collection(features) {
  return { type: "FeatureCollection", features };
}
