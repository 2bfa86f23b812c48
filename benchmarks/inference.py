"""From boxes to places with their uncertainty: rate, latency and time of a fit, beside the peers.

Run as ``python benchmarks/inference.py``; about two minutes.

All learn from the same 200 boxes of a simulated boat and its log, whose receiver strays by 1.5 m,
and place the same boxes, by the calls that users make. CameraTransform is told the focal length, as
in its guide, and the very place of the camera, and the lens has no distortion; sightline finds the
focal length and the distortion too, and takes the place for known to within some metres.

Times are the processor's, so that other programs do not count; the last column of the latencies is
by the clock. Errors are those of true boxes with noise, in recordings that no fit has seen, against
where the boat truly was.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitInputs, FitSettings, fit
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.scene import Scene
from sightline.scene.correspondences import scene_correspondences
from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.harbour import BoxNoise, Harbour
from sightline.simulation.simulate import SimulationSettings, simulate

try:
    import cameratransform as ct
except ImportError:
    ct = None

FloatArray = NDArray[np.float64]
Place = Callable[[FloatArray], Any]

CAMERA = SimulatedCamera(
    height_m=5.0, pitch_deg=2.0, roll_deg=0.7, heading_deg=40.0, focal_length_px=950.0
)
RECORDINGS, LEARNED_FROM = 8, 2
BOXES = 200
MANY, FEWER = 1_000_000, 200_000
PART = 4_000
"""Boxes a call of scikit-learn's process, which is slower with fewer and with more."""

CALLS, WARM_UP = 2_000, 200
GUIDE_ITERATIONS, MEASURED_ITERATIONS = 10_000, 100


@dataclass(frozen=True)
class Learned:
    """What came out of a fit: how to place boxes, how long it took, what camera it found."""

    name: str
    place: Place
    fit_s: float
    camera: str = "none"


def processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def foot(boxes: FloatArray) -> FloatArray:
    return np.stack([0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]], axis=1)


def world() -> tuple[Scene, Correspondences, Harbour, float]:
    """The scene, boxes of its first recordings with their places by the log, and the harbour."""
    with tempfile.TemporaryDirectory() as folder:
        made = simulate(
            folder,
            SimulationSettings(recordings=RECORDINGS, duration_s=90.0, camera=CAMERA, video=False),
        )
        scene = Scene.load(made.scene)
        assert scene.plane is not None
        pairs = scene_correspondences(scene, scene.plane).certain()
    pairs = pairs[np.isin(pairs.recording, [one.name for one in made.recordings[:LEARNED_FROM]])]
    assert len(pairs) >= BOXES
    chosen = np.linspace(0, len(pairs) - 1, BOXES).astype(int)
    unseen_from_utc_s = float(made.recordings[LEARNED_FROM].time_utc_s[0])
    return scene, pairs[chosen], made.harbour, unseen_from_utc_s


def found(height_m: float, pitch_deg: float, heading_deg: float, roll_deg: float) -> str:
    return f"{height_m:.2f} m, {pitch_deg:.2f}°, {heading_deg:.2f}°, {roll_deg:.2f}°"


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of the processor, and the result."""
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def with_sightline(
    pairs: Correspondences, scene: Scene, model: str
) -> tuple[Learned, Georeferencer]:
    took, georeferencer = timed(
        lambda: fit(
            FitInputs(pairs, CAMERA.image_size_px, scene.control_points), FitSettings(model)
        )
    )
    camera = georeferencer.camera
    camera_found = found(camera.height_m, camera.pitch_deg, camera.heading_deg, camera.roll_deg)

    def place(boxes: FloatArray) -> FloatArray:
        at = georeferencer.locate(boxes)
        return np.stack([at.east_m, at.north_m], axis=1)

    return Learned(f"sightline {model}", place, took, camera_found), georeferencer


def with_scikit_learn(pairs: Correspondences) -> tuple[Learned, Place]:
    kernel = ConstantKernel() * RBF([1.0] * 4, (1e-2, 1e3)) + WhiteKernel(1e-2)
    process = GaussianProcessRegressor(kernel, normalize_y=True)
    model = make_pipeline(StandardScaler(), process)
    took, _ = timed(lambda: model.fit(pairs.boxes.xyxy_px, pairs.east_north_m))

    def with_sigma(boxes: FloatArray) -> Any:
        return model.predict(boxes, return_std=True)

    return Learned("scikit-learn GaussianProcessRegressor", model.predict, took), with_sigma


def with_cameratransform(pairs: Correspondences) -> tuple[Learned, float]:
    """Its optimiser's fit, and the seconds that one iteration of its sampler takes."""
    width_height = CAMERA.image_size_px
    camera = ct.Camera(
        ct.RectilinearProjection(focallength_px=CAMERA.focal_length_px, image=width_height),
        ct.SpatialOrientation(),
    )
    ground = np.column_stack([pairs.east_north_m, np.zeros(len(pairs))])
    # The uncertainty that its documentation suggests for landmarks from GPS, and the unknowns and
    # limits of its guide; but for the heading, which anybody reads off a map.
    camera.addLandmarkInformation(foot(pairs.boxes.xyxy_px), ground, [3, 3, 5])
    towards = np.degrees(np.arctan2(*pairs.east_north_m.mean(axis=0)))
    unknowns = [
        ct.FitParameter("elevation_m", lower=0, upper=100, value=20),
        ct.FitParameter("tilt_deg", lower=0, upper=180, value=80),
        ct.FitParameter("heading_deg", lower=-180, upper=180, value=towards),
        ct.FitParameter("roll_deg", lower=-180, upper=180, value=0),
    ]
    # It shows its progress, and prints what it has found.
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        sampler_s, _ = timed(lambda: camera.metropolis(unknowns, iterations=MEASURED_ITERATIONS))
        took, _ = timed(lambda: camera.fit(unknowns))
    camera_found = found(
        camera.elevation_m, 90.0 - camera.tilt_deg, camera.heading_deg, camera.roll_deg
    )

    def place(boxes: FloatArray) -> FloatArray:
        return camera.spaceFromImage(foot(boxes))[:, :2]

    learned = Learned("CameraTransform, optimiser", place, took, camera_found)
    return learned, sampler_s / MEASURED_ITERATIONS


def rate(place: Place, boxes: FloatArray, part: int | None = None) -> float:
    """Boxes a second, the best of three runs."""
    step = part or len(boxes)

    def work() -> None:
        for start in range(0, len(boxes), step):
            place(boxes[start : start + step])

    return len(boxes) / min(timed(work)[0] for _ in range(3))


def latency_ms(place: Place, boxes: FloatArray) -> FloatArray:
    """Of single calls with one box: median and 99th percentile, and the latter by the clock."""
    times = []
    for i in range(WARM_UP + CALLS):
        box = boxes[i : i + 1]
        by_clock = time.perf_counter()
        took, _ = timed(lambda box=box: place(box))
        times.append((took, time.perf_counter() - by_clock))
    took_s, clock_s = np.array(times[WARM_UP:]).T
    return 1e3 * np.array([*np.percentile(took_s, [50.0, 99.0]), np.percentile(clock_s, 99.0)])


def main() -> None:
    scene, pairs, harbour, unseen_from_utc_s = world()
    rng = np.random.default_rng(0)
    seen = harbour.boxes(harbour.times(2.0), noise=BoxNoise(), of="all").xyxy_px
    boxes = seen[rng.integers(len(seen), size=MANY)]
    times = harbour.times(2.0)
    fresh = harbour.boxes(times[times > unseen_from_utc_s], noise=BoxNoise(), seed=1)
    truth = harbour.truth(fresh.time_utc_s)
    true_m = np.stack([truth.east_m, truth.north_m], axis=1)

    camera, plain = with_sightline(pairs, scene, "camera")
    residual, full = with_sightline(pairs, scene, "camera+gpr")
    process, process_with_sigma = with_scikit_learn(pairs)
    learned = [camera, residual, process]
    missing = "not installed; it is in the dependency group `bench`"

    print(f"{processor()}; threads of BLAS: {os.environ.get('OMP_NUM_THREADS', 'its default')}")
    print()
    rows: list[tuple[str, Place, int, int | None, str]] = []
    for model, count in ((plain, MANY), (full, FEWER)):
        rows.append(
            (f"sightline {model.model}, locate", model.locate, count, None, "2 × 2, and shared")
        )
    rows.append((process.name, process_with_sigma, FEWER, PART, "one sigma an axis"))
    sampler_s = None
    if ct is not None:
        transform, sampler_s = with_cameratransform(pairs)
        learned.append(transform)
        rows.append(("CameraTransform spaceFromImage", transform.place, MANY, None, "none"))
    print(f"{'from boxes to places':42s}{'boxes':>11s}{'boxes/s':>12s}", end="")
    print(f"{'p50 ms':>9s}{'p99 ms':>9s}{'by clock':>10s}  uncertainty")
    for name, place, count, part, uncertainty in rows:
        median, slow, by_clock = latency_ms(place, boxes)
        each_s = rate(place, boxes[:count], part)
        print(f"{name:42s}{count:11,d}{each_s:12,.0f}", end="")
        print(f"{median:9.3f}{slow:9.3f}{by_clock:10.3f}  {uncertainty}")
    if ct is None:
        print(f"{'CameraTransform':42s}{missing}")

    print()
    print(f"{f'fit to {BOXES} boxes':42s}{'s':>9s}{'median error m':>16s}", end="")
    print("  height, pitch, heading, roll")
    truth_is = found(CAMERA.height_m, CAMERA.pitch_deg, CAMERA.heading_deg, CAMERA.roll_deg)
    print(f"{'the truth':42s}{'':>9s}{'':>16s}  {truth_is}")
    for one in learned:
        error = np.nanmedian(np.hypot(*(one.place(fresh.xyxy_px) - true_m).T))
        print(f"{one.name:42s}{one.fit_s:9.2f}{error:16.2f}  {one.camera}")
    if sampler_s is None:
        print(f"{'CameraTransform':42s}{missing}")
    else:
        print(f"{'CameraTransform, sampler':42s}{GUIDE_ITERATIONS * sampler_s:9.0f}", end="")
        print(f"{'':>16s}  the guide's {GUIDE_ITERATIONS:,} steps, from the time of", end="")
        print(f" {MEASURED_ITERATIONS}")


if __name__ == "__main__":
    main()
