"""Simulated recordings whose camera's clock is off by a known time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sightline import formats
from sightline.scene import Scene
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise, SimulatedCamera
from sightline.types import NO_TRACK, Boxes

START_UTC_S = 1_717_236_000.0
CAMERA = SimulatedCamera(
    height_m=7.0,
    pitch_deg=4.0,
    roll_deg=0.8,
    heading_deg=30.0,
    focal_length_px=1000.0,
    k1=-0.12,
    k2=0.01,
)


def drawn_scene(
    folder: Path,
    offset_s: Mapping[str, float],
    *,
    seed: int = 21,
    duration_s: float = 90.0,
    margin_s: float = 60.0,
    keys: str = "",
) -> Scene:
    """Recordings of one harbour, each with boxes that somebody drew of the logged boat.

    Args:
        folder: Where to.
        offset_s: By recording, how far the camera's clock is ahead of the log's.
        seed: Of the boats and of all noise.
        duration_s: Of each recording.
        margin_s: How much longer its log is before and after, 60 at most.
        keys: Further lines of each recording.
    """
    lines = []
    for i, (name, late_s) in enumerate(offset_s.items()):
        # As long a log before and after as people keep, so that another clock has places as well.
        harbour = Harbour.random(
            seed + i,
            HarbourSettings(
                duration_s=duration_s + 120.0,
                camera=CAMERA,
                start_utc_s=START_UTC_S + 7200.0 * i,
                gulls=0,
            ),
        )
        times = harbour.times(2.0)
        times = times[(times > harbour.start_utc_s + 60.0) & (times < times[-1] - 60.0)]
        boxes = harbour.boxes(times, noise=BoxNoise(std_px=1.0, source="annotator"))
        _write(folder, name, boxes, late_s)
        fixes = harbour.fixes(ReceiverNoise())
        inside = np.abs(fixes.time_utc_s - times.mean()) <= 0.5 * np.ptp(times) + margin_s
        formats.write_fixes(fixes[inside], folder / f"fixes-{name}.csv")
        lines += ["[[recordings]]", f'name = "{name}"', f'boxes = "boxes-{name}.csv"']
        lines += [f'fixes = "fixes-{name}.csv"', keys]
    site = [
        "[camera]",
        f"latitude_deg = {harbour.plane.latitude_deg}",
        f"longitude_deg = {harbour.plane.longitude_deg}",
        "image_size_px = [1280, 720]",
    ]
    path = folder / "scene.toml"
    path.write_text("\n".join(site + lines), encoding="utf-8")
    return Scene.load(path)


def _write(folder: Path, name: str, boxes: Boxes, late_s: float) -> None:
    boxes = boxes.with_columns(time_utc_s=boxes.time_utc_s + late_s)
    formats.write_boxes(boxes, folder / f"boxes-{name}.csv")


def unlabelled_recordings(folder: Path, offset_s: float, *, seeds: Sequence[int]) -> Scene:
    """Recordings by one camera as `unlabelled_scene` makes them, of other boats each.

    Args:
        folder: Where to.
        offset_s: How far the camera's clock is ahead of the log's.
        seeds: Of each recording.
    """
    lines: list[str] = []
    for number, seed in enumerate(seeds, start=1):
        name = f"{number:02}"
        (folder / name).mkdir()
        alone = unlabelled_scene(folder / name, offset_s, seed=seed)
        site, _, recording = alone.path.read_text(encoding="utf-8").partition("[[recordings]]")
        recording = recording.replace('"01"', f'"{name}"')
        for file in ("seen.csv", "fixes.csv"):
            recording = recording.replace(file, f"{name}/{file}")
        lines = lines or [site]
        lines.append("[[recordings]]" + recording)
    path = folder / "scene.toml"
    path.write_text("".join(lines), encoding="utf-8")
    return Scene.load(path)


def unlabelled_scene(folder: Path, offset_s: float, *, seed: int = 0) -> Scene:
    """One recording with the detections of all boats, and the log of one.

    Args:
        folder: Where to.
        offset_s: How far the camera's clock is ahead of the log's.
        seed: Of the boats and of all noise.
    """
    harbour = Harbour.random(
        seed,
        HarbourSettings(duration_s=240.0, camera=CAMERA, start_utc_s=START_UTC_S, gulls=0),
    )
    times = harbour.times(4.0)
    times = times[(times > harbour.start_utc_s + 60.0) & (times < times[-1] - 60.0)]
    noise = BoxNoise(std_px=1.0, correlation_time_s=1.0, miss_probability=0.05, source="detector")
    boxes = harbour.boxes(times, noise=noise, of="all")
    boxes = boxes.with_columns(track_id=np.full(len(boxes), NO_TRACK))
    formats.write_boxes(
        boxes.with_columns(time_utc_s=boxes.time_utc_s + offset_s), folder / "seen.csv"
    )
    formats.write_fixes(harbour.fixes(ReceiverNoise()), folder / "fixes.csv")
    (folder / "scene.toml").write_text(
        f"""[camera]
latitude_deg = {harbour.plane.latitude_deg}
longitude_deg = {harbour.plane.longitude_deg}
image_size_px = [1280, 720]
[[recordings]]
name = "01"
detections = "seen.csv"
fixes = "fixes.csv"
""",
        encoding="utf-8",
    )
    return Scene.load(folder / "scene.toml")
