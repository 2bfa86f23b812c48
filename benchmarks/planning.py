"""Whether a plan says what a fit then finds, on simulated cameras and drives.

    python benchmarks/planning.py [--cameras 30] [--first 0] [--unknown-lens]

Each camera is planned from what its owner knows: height, field of view, picture, place, heading,
pitch, roll and distortion (or without that). Its boat then drives what was planned, out and back,
across or in a zigzag in turn, before the simulated camera, whose lens has a barrel, with an
annotator's boxes and a receiver's log; and the camera is fitted to these files. Compared are the
semi-major axes of 95 % ellipses at places all over the water in the picture, and which parameters
the data determines.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sightline.camera.parameters import PARAMETERS
from sightline.camera.pinhole import Camera
from sightline.formats import write_boxes, write_fixes
from sightline.geodesy import LocalPlane
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.pipeline.fit import fit
from sightline.planning import (
    PATTERNS,
    DriveNoise,
    Hull,
    Learning,
    Mounting,
    learn,
    pattern_drive,
)
from sightline.planning.drive import SOURCE, Drive
from sightline.planning.learning import LearnSettings
from sightline.planning.mounting import around, horizontal_view, seen_ahead_m
from sightline.planning.water_map import axes_at, boxes_at, width_reach_m
from sightline.scene import Scene
from sightline.simulation import BoxNoise, Harbour, ReceiverNoise, SimulatedCamera
from sightline.simulation.boats import Boat, Shape, motorboat
from sightline.simulation.harbour import DOCK
from sightline.simulation.paths import Path as BoatPath
from sightline.types import FloatArray, StrArray, ellipses

ANNOTATOR = "annotator"
INTERVAL_S = 2.0
LEAST_PX = 8.0
BOX_PX, LOG_M = 1.0, 1.5
NAMED = (
    *("height_m", "focal_px", "pitch_deg", "roll_deg", "heading_deg", "east_m", "north_m"),
    *("principal_dx_px", "principal_dy_px"),
)
"""Parameters that a plan is asked for; of the lens and the water it says the same."""

_BEARINGS, _RANGES = 9, 25


@dataclass(frozen=True, eq=False)
class Case:
    """A camera, as it was planned, and as it was found.

    Attributes:
        pattern: Of the drive.
        boxes: How many the fit had.
        planned_m: (N,) semi-major axes at places, NaN where there is no position.
        reached_m: (N,) of the fitted camera.
        planned: Undetermined parameters, by plan.
        reached: Undetermined parameters, by the fit.
        by_chance: Parameters of which the plan says that the noise decides.
    """

    pattern: str
    boxes: int
    planned_m: FloatArray
    reached_m: FloatArray
    planned: frozenset[str]
    reached: frozenset[str]
    by_chance: frozenset[str]

    @property
    def missed(self) -> frozenset[str]:
        """Which of `NAMED` the fit determines and the plan does not, or the other way round."""
        return (self.planned ^ self.reached) & set(NAMED)

    @property
    def ratio(self) -> float:
        """Median of reached over planned, where both have a position; NaN where nowhere."""
        both = np.isfinite(self.planned_m) & np.isfinite(self.reached_m)
        return (
            float(np.median(self.reached_m[both] / self.planned_m[both])) if both.any() else np.nan
        )


def simulated(number: int) -> tuple[SimulatedCamera, Shape]:
    """A camera with a barrel on a quay or a roof, and a motorboat."""
    rng = np.random.default_rng([number, 16])
    camera = SimulatedCamera.random(rng)
    height_m = float(np.exp(rng.uniform(np.log(3.0), np.log(20.0))))
    pitch_deg = float(rng.uniform(0.0, 8.0))
    camera = replace(camera, height_m=height_m, pitch_deg=pitch_deg)
    return camera, motorboat(rng, float(rng.uniform(5.0, 7.5)))


def planned_camera(camera: SimulatedCamera, *, lens: bool = True) -> Camera:
    """What its owner can say of a camera before it is mounted, with or without its distortion."""
    return Mounting(
        camera.height_m,
        camera.field_of_view_deg,
        camera.image_size_px,
        camera.heading_deg,
        camera.pitch_deg,
        camera.roll_deg,
        (camera.k1, camera.k2) if lens else (0.0, 0.0),
    ).camera


def fitted(
    folder: Path, camera: SimulatedCamera, shape: Shape, drive: Drive, number: int
) -> tuple[CameraRegressor, int, frozenset[str]]:
    """The model of a drive that was filmed, and what the fit could not determine."""
    path = BoatPath(drive.path.time_utc_s, drive.path.east_north_m)
    harbour = Harbour(
        camera,
        DOCK,
        (Boat(1, "target", shape, path),),
        duration_s=drive.duration_s,
        seed=number,
    )
    drawn = harbour.boxes(
        harbour.times(1.0 / INTERVAL_S), noise=BoxNoise(std_px=BOX_PX, source=ANNOTATOR)
    )
    write_boxes(drawn, folder / "boxes.csv")
    write_fixes(harbour.fixes(ReceiverNoise(std_m=LOG_M)), folder / "log.csv")
    lines = [
        *("[camera]", f"latitude_deg = {DOCK.latitude_deg}"),
        *(f"longitude_deg = {DOCK.longitude_deg}", "image_size_px = [1280, 720]"),
        *("[[recordings]]", 'name = "drive"', 'boxes = "boxes.csv"', 'fixes = "log.csv"'),
    ]
    (folder / "scene.toml").write_text("\n".join(lines), encoding="utf-8")
    model = fit(Scene.load(folder / "scene.toml"), "camera")
    assert model.calibrated is not None
    left = frozenset(
        one.name for one in model.report.parameters if one.name in PARAMETERS and not one.determined
    )
    return model.calibrated, model.report.n, left


def places(camera: Camera, length_m: float) -> FloatArray:
    """(N, 2) places all over the water in the picture, to where the boat is just found."""
    nearest, farthest = seen_ahead_m(camera)
    farthest = min(farthest, width_reach_m(camera, length_m, LEAST_PX))
    left, right = horizontal_view(camera)
    off = np.linspace(0.9 * left, 0.9 * right, _BEARINGS)
    ranges = np.geomspace(1.2 * nearest, farthest, _RANGES)
    return around(camera, off[:, None], ranges[None, :]).reshape(-1, 2)


def reached_axes(
    model: CameraRegressor, camera: SimulatedCamera, where: FloatArray, hull: Hull
) -> FloatArray:
    """(N,) semi-major axes that a model states of boats at places, as the true camera sees them."""
    true = Camera(
        *(camera.height_m, camera.pitch_deg, camera.roll_deg, camera.heading_deg),
        *(camera.focal_length_px, camera.k1, camera.k2, 0.0, 0.0, camera.image_size_px),
    )
    boxes = boxes_at(true, where, hull)
    seen = np.isfinite(boxes).all(axis=1)
    out = np.full(len(where), np.nan)
    sources: StrArray = np.full(int(seen.sum()), ANNOTATOR)
    _, covariance = model.predict(boxes[seen], source=sources, return_cov=True)
    out[seen] = ellipses(covariance).semi_major_m
    return out


def case(number: int, *, lens: bool = True) -> Case:
    """Plan a camera, film the drive, fit it, and lay the two beside each other."""
    camera, shape = simulated(number)
    pattern = PATTERNS[number % len(PATTERNS)]
    hull, as_planned = Hull(shape.length_m, shape.beam_m), planned_camera(camera, lens=lens)
    drive = pattern_drive(pattern, as_planned, hull, speed_mps=4.0, least_px=LEAST_PX)
    plan: Learning = learn(
        as_planned,
        LocalPlane(DOCK.latitude_deg, DOCK.longitude_deg),
        drive,
        hull,
        LearnSettings(INTERVAL_S, LEAST_PX, DriveNoise(BOX_PX, LOG_M)),
    )
    with tempfile.TemporaryDirectory() as folder:
        model, boxes, left = fitted(Path(folder), camera, shape, drive, number)
    where = places(as_planned, hull.length_m)
    return Case(
        pattern=pattern,
        boxes=boxes,
        planned_m=axes_at(plan.model, where, hull, camera=as_planned, source=SOURCE)[0],
        reached_m=reached_axes(model, camera, where, hull),
        planned=frozenset(plan.undetermined),
        reached=left,
        by_chance=frozenset(plan.seldom),
    )


def main(cameras: int, first: int, *, lens: bool) -> None:
    """Print a line a camera, and the summary."""
    cases: list[Case] = []
    print(f"{'':4s}{'drive':14s}{'boxes':>6s}{'reached / planned':>19s}  undetermined otherwise")
    for number in range(first, first + cameras):
        one = case(number, lens=lens)
        cases.append(one)
        missed = [f"+{name}" for name in sorted(one.reached - one.planned)]
        missed += [f"-{name}" for name in sorted(one.planned - one.reached)]
        print(
            f"{number:<4d}{one.pattern:14s}{one.boxes:6d}{one.ratio:19.2f}  {' '.join(missed)}",
            flush=True,
        )
    ratios = np.array([one.ratio for one in cases])
    off = np.abs(ratios - 1.0)
    only = [np.mean(np.isfinite(c.planned_m) ^ np.isfinite(c.reached_m)) for c in cases]
    print(
        f"reached over planned axes, by camera: median {np.nanmedian(ratios):.2f}, off by "
        f"{np.nanmedian(off):.0%} in the median, {np.nanquantile(off, 0.9):.0%} in nine of ten; "
        f"{np.mean(only):.0%} of the places have a position by one of them alone"
    )
    exactly = sum(not one.missed for one in cases)
    sure = sum(one.missed <= one.by_chance for one in cases)
    each = 1.0 - sum(len(one.missed) for one in cases) / (len(NAMED) * len(cases))
    print(
        f"undetermined as planned: all of {len(NAMED)} parameters for {exactly} of {len(cases)} "
        f"cameras, all but those that the plan leaves to chance for {sure}; {each:.0%} of single "
        "parameters"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=30)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--unknown-lens", action="store_true")
    chosen = parser.parse_args()
    main(chosen.cameras, chosen.first, lens=not chosen.unknown_lens)
