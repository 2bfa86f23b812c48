r"""How fast `sightline track` makes tracks of a table of boxes, beside ByteTrack and SORT.

    pip install --no-deps trackers==2.6.1 supervision pydeprecate defusedxml pyyaml requests tqdm
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/track_table.py \
        [--boxes 24000] [--model camera+gpr] [--keep FOLDER]

The table holds the boxes of eight simulated vessels, ten moments a second, without track ids. The
first row is a process of its own, from its start to the file of tracks; the rows below take the
same way inside one process, and time its stages apart. The trackers of the package `trackers` get
the same boxes as arrays in memory, moment by moment: reading, placing, smoothing and writing are
not in their time. Times are those that a core worked, so that others on the machine do not count.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import sightline
from sightline import formats
from sightline.camera.state import CameraHistory
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.track import TrackSettings, iter_tracks, positions_on_earth, smooth_boxes
from sightline.scene import Scene
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise
from sightline.tracking import WorldTracker
from sightline.trajectory import method
from sightline.types import NO_TRACK, Boxes, FloatArray, Track

T = TypeVar("T")

RATE_HZ = 10.0
TARGETS = 100
FRAMES = 200


@dataclass(frozen=True, eq=False)
class World:
    """A table of boxes, and a model of the camera that saw them, as files."""

    boxes: Path
    model: Path


def make_world(folder: Path, boxes: int, model: str) -> World:
    """Eight vessels under way as a detector sees them, and a model fitted on another day."""
    duration_s = boxes / RATE_HZ / 4.0
    harbour = Harbour.random(
        3,
        HarbourSettings(
            duration_s=duration_s, motorboats=4, sailboats=2, ferries=1, anchored=0, gulls=0
        ),
    )
    noise = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.05, source="detector")
    seen = harbour.boxes(harbour.times(RATE_HZ), noise=noise, of="all", seed=1)[:boxes]
    if len(seen) < boxes:
        raise SystemExit(f"the harbour shows {len(seen)} boxes only; ask for fewer")
    world = World(folder / "boxes.csv", folder / "camera.safetensors")
    formats.write_boxes(
        seen.with_columns(track_id=np.full(boxes, NO_TRACK), frame=seen.frame), world.boxes
    )
    scene = _scene(folder, harbour)
    sightline.fit(scene, model).save(world.model)
    return world


def _scene(folder: Path, harbour: Harbour) -> Scene:
    """The same camera a day before, with the boxes and the log of one boat."""
    before = Harbour.random(
        5003,
        HarbourSettings(
            duration_s=240.0,
            camera=harbour.camera,
            start_utc_s=harbour.start_utc_s - 86400.0,
            gulls=0,
        ),
    )
    noise = BoxNoise(std_px=1.5, correlation_time_s=0.8, source="detector")
    formats.write_boxes(before.boxes(before.times(0.5), noise=noise), folder / "learned.csv")
    formats.write_fixes(before.fixes(ReceiverNoise()), folder / "fixes.csv")
    width, height = harbour.camera.image_size_px
    path = folder / "scene.toml"
    path.write_text(
        f"[camera]\nlatitude_deg = {harbour.plane.latitude_deg}\n"
        f"longitude_deg = {harbour.plane.longitude_deg}\nimage_size_px = [{width}, {height}]\n"
        '[[recordings]]\nname = "a"\nboxes = "learned.csv"\nfixes = "fixes.csv"\n',
        encoding="utf-8",
    )
    return Scene.load(path)


def whole_command(world: World, out: Path) -> float:
    """Seconds of a process of its own, its start included."""
    command = [sys.executable, "-c", "from sightline.cli import main; main()"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [*command, "track", str(world.boxes), "--model", str(world.model), "-o", str(out)],
        check=True,
        capture_output=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


class Watch:
    """Adds up the seconds spent in stages."""

    def __init__(self) -> None:
        """Begin at zero."""
        self.seconds: dict[str, float] = {}

    def run(self, stage: str, work: Callable[[], T]) -> T:
        """Do some work, and add its time to a stage."""
        started = time.process_time()
        done = work()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.process_time() - started
        return done


def stages(world: World, out: Path) -> tuple[dict[str, float], int]:
    """Seconds of reading, following, smoothing and writing, one after the other; and the tracks."""
    watch = Watch()
    model = watch.run("loading the model", lambda: sightline.load(world.model))
    boxes = watch.run("reading", lambda: formats.read_boxes(world.boxes))
    tracker = WorldTracker(positions_on_earth)
    located = watch.run("placing", lambda: model.place(CameraHistory().observed(boxes)))
    followed = watch.run("following", lambda: tracker.follow(located))
    own = [followed[followed.track_id == i] for i in np.unique(followed.track_id)]
    smoother, settings = method("rts"), TrackSettings()

    def smoothed() -> list[Track]:
        made = (
            smooth_boxes(one, smoother, settings, track_id=i + 1, shortest_s=2.0)
            for i, one in enumerate(own)
        )
        return [track for track in made if track is not None]

    tracks = watch.run("smoothing", smoothed)
    watch.run("writing", lambda: formats.write_tracks(tracks, out))
    return watch.seconds, len(tracks)


def _moments(boxes: Boxes) -> Iterator[Boxes]:
    cuts = np.flatnonzero(np.diff(boxes.time_utc_s)) + 1
    for rows in np.split(np.arange(len(boxes)), cuts):
        yield boxes[rows]


def in_one_go(world: World, out: Path) -> float:
    """Seconds from a loaded model to the file of tracks, in this process."""
    model = sightline.load(world.model)
    started = time.process_time()
    with formats.track_writer(out) as writer:
        for track in iter_tracks(world.boxes, model):
            writer.add(track)
    return time.process_time() - started


def crowd(model: Georeferencer, rng: np.random.Generator) -> list[Boxes]:
    """A hundred targets before the camera of a model, moment by moment."""
    width, height = model.image_size_px
    camera = model.camera
    assert camera is not None, "the model is one with a camera"
    horizon = float(np.max(camera.horizon_y_px([0.0, width])))
    foot = np.column_stack(
        [
            rng.uniform(0.05 * width, 0.95 * width, TARGETS),
            horizon + (height - horizon) * rng.uniform(0.1, 0.9, TARGETS),
        ]
    )
    size = np.column_stack([rng.uniform(12.0, 30.0, TARGETS), rng.uniform(8.0, 16.0, TARGETS)])
    velocity = rng.normal(0.0, 2.0, (TARGETS, 2)) * [1.0, 0.1]
    moments = []
    for i in range(FRAMES):
        at = foot + i / RATE_HZ * velocity + rng.normal(0.0, 0.5, foot.shape)
        xyxy = np.hstack([at - size * [0.5, 1.0], at + size * [0.5, 0.0]])
        moments.append(Boxes.of(xyxy, time_utc_s=i / RATE_HZ, frame=i, source="detector"))
    return moments


def following_ms(model: Georeferencer) -> FloatArray:
    """Milliseconds of each frame of a hundred targets, once they are confirmed."""
    tracker = WorldTracker(positions_on_earth)
    taken = []
    for moment in crowd(model, np.random.default_rng(0)):
        started = time.process_time()
        tracker.update(model.place(CameraHistory().observed(moment)))
        taken.append(time.process_time() - started)
    return 1e3 * np.array(taken[10:])


def others() -> dict[str, Callable[[], Any]]:
    """The trackers of the package `trackers`, by name; none where it is not installed."""
    try:
        import trackers
    except ImportError:
        return {}
    return {
        "ByteTrack": lambda: trackers.ByteTrackTracker(frame_rate=RATE_HZ),
        "SORT": lambda: trackers.SORTTracker(frame_rate=RATE_HZ),
    }


def theirs(make: Callable[[], Any], moments: Iterable[Boxes]) -> float:
    """Seconds that a tracker takes for boxes, moment by moment."""
    import supervision

    given = [
        supervision.Detections(
            xyxy=moment.xyxy_px.astype(np.float32),
            confidence=moment.confidence,
            class_id=np.zeros(len(moment), dtype=int),
        )
        for moment in moments
    ]
    tracker = make()
    started = time.process_time()
    for detections in given:
        tracker.update(detections)
    return time.process_time() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--boxes", type=int, default=24_000)
    parser.add_argument("--model", default="camera+gpr", choices=("camera", "camera+gpr"))
    parser.add_argument("--keep", type=Path, help="folder for the table, the model and the tracks")
    parser.add_argument("--repeats", type=int, default=3)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        world = make_world(folder, chosen.boxes, chosen.model)
        report(world, folder, chosen.boxes, chosen.repeats)


def report(world: World, folder: Path, count: int, repeats: int) -> None:
    """Measure, and print."""

    def row(what: str, seconds: float) -> None:
        print(f"{what:44s}{seconds:8.2f} s{count / seconds:10.0f} boxes a second")

    out = folder / "tracks.geojson"
    row("sightline track, the process", min(whole_command(world, out) for _ in range(repeats)))
    row("sightline track, without its start", min(in_one_go(world, out) for _ in range(repeats)))
    parts, tracks = min(
        (stages(world, out) for _ in range(repeats)), key=lambda p: sum(p[0].values())
    )
    for stage, seconds in parts.items():
        row(f"    {stage}", seconds)
    print(f"{tracks} tracks of {count} boxes; best of {repeats}")
    model = sightline.load(world.model)
    taken = following_ms(model)
    print(
        f"a frame of {TARGETS} targets, placed and followed: {np.median(taken):.1f} ms in the "
        f"median, {np.percentile(taken, 95):.1f} ms in 95 %"
    )
    beside = others()
    if not beside:
        print("ByteTrack, SORT: skipped, since the package trackers is not installed")
    moments = list(_moments(formats.read_boxes(world.boxes)))
    many = crowd(model, np.random.default_rng(0))
    for name, make in beside.items():
        row(name, min(theirs(make, moments) for _ in range(repeats)))
        print(f"    {1e3 * theirs(make, many) / len(many):.1f} ms a frame of {TARGETS} targets")


if __name__ == "__main__":
    main()
