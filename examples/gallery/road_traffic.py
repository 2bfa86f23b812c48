"""Speeds of vehicles on a road, with a camera that was fitted to control points alone."""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import sightline
from sightline.geodesy import LocalPlane
from sightline.simulation import SimulatedCamera

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9")
INK, ROAD = "#333333", "#d9d9d9"
START_UTC_S = 1_717_236_000.0
PLANE = LocalPlane(latitude_deg=54.3233, longitude_deg=10.1394)
# On a bridge over a road that leads to the north-east.
CAMERA = SimulatedCamera(
    height_m=8.0, pitch_deg=9.0, roll_deg=0.6, heading_deg=42.0, focal_length_px=1000.0, k1=-0.12
)
ALONG = np.array([np.sin(np.radians(45.0)), np.cos(np.radians(45.0))])
TO_THE_RIGHT = np.array([ALONG[1], -ALONG[0]])
LANES_M = (-5.2, -1.8, 1.8, 5.2)
# Lane, metres along the road at first, speed, acceleration: the left lanes come towards us.
VEHICLES = (
    (2, 5.0, 14.0, 0.0),
    (3, 25.0, 9.0, 0.7),
    (0, 190.0, -12.0, 0.0),
    (1, 230.0, -19.0, 0.9),
    (2, -85.0, 19.0, 0.0),
)
LENGTH_M, WIDTH_M, HEIGHT_M = 4.4, 1.8, 1.5


def on_road(forward_m: np.ndarray, right_m: np.ndarray | float) -> np.ndarray:
    """(N, 2) metres east and north."""
    right = np.broadcast_to(right_m, np.shape(forward_m))
    return np.asarray(forward_m)[:, None] * ALONG + right[:, None] * TO_THE_RIGHT


def pixels(places_m: np.ndarray, above_m: float = 0.0) -> np.ndarray:
    """(N, 2) where the true camera sees places at a height above the road."""
    return CAMERA.project(np.column_stack([places_m, np.full(len(places_m), above_m)]))


def along_m(vehicle: tuple[int, float, float, float], after_s: np.ndarray | float) -> np.ndarray:
    """(N,) metres along the road."""
    _, first_m, speed_mps, acceleration_mps2 = vehicle
    return np.asarray(first_m + speed_mps * after_s + 0.5 * acceleration_mps2 * after_s**2)


def control_points(rng: np.random.Generator) -> str:
    """A table of ends of road markings, surveyed to 5 cm and clicked to half a pixel."""
    places = np.concatenate([on_road(np.arange(20.0, 130.0, 18.0), r) for r in (-7.0, 0.0, 7.0)])
    pixel = pixels(places) + rng.normal(0.0, 0.5, (len(places), 2))
    latitude, longitude = PLANE.to_geographic(*(places + rng.normal(0.0, 0.05, places.shape)).T)
    rows = [
        f"{x:.1f},{y:.1f},{lat:.7f},{lon:.7f}"
        for (x, y), lat, lon in zip(pixel, latitude, longitude, strict=True)
        if 0.0 < x < 1280.0 and 0.0 < y < 720.0
    ]
    return "\n".join(["x_px,y_px,latitude_deg,longitude_deg", *rows]) + "\n"


def vehicle_boxes(rng: np.random.Generator) -> sightline.Boxes:
    """What a detector sees, ten times a second."""
    rows, times = [], []
    for after_s in np.arange(0.0, 12.0, 0.1):
        for vehicle in VEHICLES:
            ends = along_m(vehicle, after_s) + LENGTH_M * np.array([-0.5, -0.5, 0.5, 0.5])
            sides = LANES_M[vehicle[0]] + WIDTH_M * np.array([-0.5, 0.5, -0.5, 0.5])
            corners = on_road(ends, sides)
            seen = np.concatenate([pixels(corners), pixels(corners, HEIGHT_M)])
            box = np.concatenate([seen.min(axis=0), seen.max(axis=0)])
            if np.isfinite(box).all() and (box > 5.0).all() and box[2] < 1275 and box[3] < 715:
                rows.append(box + rng.normal(0.0, 0.7, 4))
                times.append(START_UTC_S + after_s)
    return sightline.Boxes.of(rows, time_utc_s=times, source="detector", label="car")


def main(folder: Path) -> None:
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as made:
        site = Path(made)
        (site / "points.csv").write_text(control_points(rng), encoding="utf-8")
        (site / "scene.toml").write_text(
            'control_points = "points.csv"\n[camera]\n'
            f"latitude_deg = {PLANE.latitude_deg}\nlongitude_deg = {PLANE.longitude_deg}\n"
            "image_size_px = [1280, 720]\n",
            encoding="utf-8",
        )
        scene = sightline.Scene.load(site / "scene.toml")
        model = sightline.fit(scene, model="camera")
    points = scene.control_points
    print(f"{len(points)} control points, height {model.camera.height_m:.2f} m (true 8.00 m)")
    boxes = vehicle_boxes(rng)
    tracks = sightline.track(boxes, model)

    figure = Figure(figsize=(10.5, 6.0), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
    image = figure.add_subplot(grid[0, 0])
    speeds = figure.add_subplot(grid[1, 0])
    chart = figure.add_subplot(grid[:, 1])
    edge = np.linspace(14.0, 600.0, 300)
    for right_m in (-7.0, 0.0, 7.0):
        image.plot(*pixels(on_road(edge, right_m)).T, color=ROAD, lw=2)
        chart.plot(*on_road(edge[edge < 260.0], right_m).T, color=ROAD, lw=2)
    image.plot(*points.pixel_px.T, "+", color=INK, ms=8, label="control point")
    foot = np.stack([boxes.xyxy_px[:, [0, 2]].mean(axis=1), boxes.xyxy_px[:, 3]], axis=1)
    image.scatter(*foot.T, s=3, color="#9a9a9a", label="foot point of a box")
    image.set(xlim=(0, 1280), ylim=(720, 120), xlabel="x, px", ylabel="y, px", title="In the image")
    image.legend(loc="upper left", fontsize=8)
    for track, colour in zip(tracks, COLOURS, strict=False):
        time_s = track.time_utc_s - START_UTC_S
        places = np.stack([track.east_m, track.north_m], axis=1)
        # A box ends where the near end of a vehicle meets the road.
        near_m = [on_road(along_m(v, time_s) - 0.5 * LENGTH_M, LANES_M[v[0]]) for v in VEHICLES]
        off_m = [np.hypot(*(places - place).T).mean() for place in near_m]
        vehicle = VEHICLES[int(np.argmin(off_m))]
        true_kmh = 3.6 * np.abs(vehicle[2] + vehicle[3] * time_s)
        speed_kmh = 3.6 * track.speed_mps
        variance = np.einsum("i,nij,j->n", ALONG, track.velocity_covariance_m2ps2, ALONG)
        within = 2.0 * 3.6 * np.sqrt(variance)
        chart.plot(track.east_m, track.north_m, color=colour, lw=2)
        speeds.fill_between(
            time_s, speed_kmh - within, speed_kmh + within, color=colour, alpha=0.25, lw=0
        )
        speeds.plot(time_s, speed_kmh, color=colour, lw=2)
        speeds.plot(time_s, true_kmh, color=INK, ls=":")
        rmse_kmh = np.sqrt(np.mean((speed_kmh - true_kmh) ** 2))
        print(f"lane {vehicle[0]}: speed {rmse_kmh:.1f} km/h RMSE, near end {min(off_m):.1f} m off")
    speeds.plot([], [], color=INK, ls=":", label="true speed")
    speeds.set(xlabel="time, s", ylabel="speed, km/h", title="Speeds, with two standard deviations")
    speeds.set_ylim(0.0, 80.0)
    speeds.legend(loc="lower left", fontsize=8)
    chart.plot(0.0, 0.0, marker="^", ms=9, color=INK, ls="", label="camera on a bridge")
    chart.set(aspect="equal", xlabel="east, m", ylabel="north, m", title="On the road")
    chart.legend(loc="upper left", fontsize=8)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "road-traffic.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
