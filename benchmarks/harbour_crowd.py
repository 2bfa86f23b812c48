"""Eight vessels before one camera, with occlusions, a detector's faults, and clutter: boxes alone.

What is hidden behind posts, moored barges and other boats has no box; a vessel that is partly
hidden has one of low confidence; now and then the detector sees nothing of a vessel for seconds.
Clutter flickers for a frame, or drifts along for a while, as a gull or a breaking wave does.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sightline.formats import write_boxes, write_fixes
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise
from sightline.simulation.harbour import Pile
from sightline.types import NO_TRACK, Boxes, FloatArray

RATE_HZ = 10.0
DURATION_S = 180.0


@dataclass(frozen=True, eq=False)
class Crowd:
    """One recording.

    Attributes:
        harbour: The world.
        time_utc_s: (F,) of the frames, irregular.
        truth: The true box of each vessel that is seen.
        detections: What a detector makes of it, without track ids.
    """

    harbour: Harbour
    time_utc_s: FloatArray
    truth: Boxes
    detections: Boxes


def frame_times(rng: np.random.Generator, start_utc_s: float) -> FloatArray:
    """Intervals that vary by a fifth, one frame in fifty lost, and twice a second without any."""
    count = int(1.3 * DURATION_S * RATE_HZ)
    times = np.cumsum((1.0 + 0.2 * rng.uniform(-1.0, 1.0, count)) / RATE_HZ)
    kept = (times < DURATION_S) & (rng.random(count) > 0.02)
    for start in rng.uniform(10.0, DURATION_S - 10.0, 2):
        kept &= (times < start) | (times > start + 1.0)
    return np.asarray(start_utc_s + times[kept])


def crowd(seed: int) -> Crowd:
    """A recording of eight vessels under way; another seed, another harbour and camera."""
    rng = np.random.default_rng([seed, 77])
    harbour = Harbour.random(
        seed,
        HarbourSettings(
            duration_s=DURATION_S, motorboats=4, sailboats=2, ferries=1, anchored=0, gulls=0
        ),
    )
    harbour = replace(harbour, piles=harbour.piles + _barges(rng, harbour))
    times = frame_times(rng, harbour.start_utc_s)
    truth = harbour.boxes(times, of="all")
    noise = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.05, source="detector")
    seen = harbour.boxes(times, noise=noise, of="all", seed=1)
    covered = _covered(harbour, seen)
    height = seen.xyxy_px[:, 3] - seen.xyxy_px[:, 1]
    sure = rng.beta(9.0, 2.0, len(seen)) - 0.9 * covered - 0.8 * np.exp(-height / 6.0)
    seen = seen.with_columns(confidence=np.clip(sure, 0.02, 1.0))
    seen = seen[~_lapses(rng, seen, harbour) & (seen.confidence > 0.1)]
    boxes = Boxes.concatenate([seen, _clutter(rng, harbour, times)])
    boxes = boxes.with_columns(track_id=np.full(len(boxes), NO_TRACK))
    boxes = boxes[rng.permutation(len(boxes))]
    return Crowd(harbour, times, truth, boxes[np.argsort(boxes.frame, kind="stable")])


def _barges(rng: np.random.Generator, harbour: Harbour) -> tuple[Pile, ...]:
    """Round things of some metres, that hide what passes behind them for seconds."""
    camera = harbour.camera
    half = 0.5 * camera.field_of_view_deg
    piles = []
    for side in (-0.5, 0.05, 0.6):
        bearing = np.radians(camera.heading_deg + half * (side + rng.uniform(-0.15, 0.15)))
        distance = rng.uniform(1.5, 2.5) * max(26.0, 1.8 * camera.nearest_water_m) / 1.8
        piles.append(
            Pile(
                east_m=float(distance * np.sin(bearing)),
                north_m=float(distance * np.cos(bearing)),
                radius_m=float(0.035 * distance),
                top_m=camera.height_m + 0.5,
            )
        )
    return tuple(piles)


def _covered(harbour: Harbour, boxes: Boxes) -> FloatArray:
    """(N,) share of each box that a nearer boat or a pile covers."""
    times, row = np.unique(boxes.time_utc_s, return_inverse=True)
    since = times - harbour.start_utc_s
    own_range = np.empty(len(boxes))
    for boat in harbour.boats:
        of = boxes.track_id == boat.identity
        own_range[of] = np.hypot(*boat.path.at(boxes.time_utc_s[of] - harbour.start_utc_s).T)
    area = (boxes.xyxy_px[:, 2:] - boxes.xyxy_px[:, :2]).prod(axis=1)
    most = np.zeros(len(boxes))
    for boat in harbour.boats:
        outline = np.nan_to_num(harbour.outlines_px(boat, times))[row]
        nearer = np.hypot(*boat.path.at(since).T)[row] < own_range - 1.0
        other = (boxes.track_id != boat.identity) & nearer
        most = np.maximum(most, np.where(other, _shared(boxes.xyxy_px, outline) / area, 0.0))
    for pile in harbour.piles:
        corners = harbour.camera.project(pile.outline_enu_m())
        if np.isfinite(corners).any():
            outline = np.concatenate([np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)])
            nearer = np.hypot(pile.east_m, pile.north_m) < own_range
            share = _shared(boxes.xyxy_px, outline[None, :]) / area
            most = np.maximum(most, np.where(nearer, share, 0.0))
    return most


def _shared(first: FloatArray, second: FloatArray) -> FloatArray:
    low = np.maximum(first[:, :2], second[:, :2])
    high = np.minimum(first[:, 2:], second[:, 2:])
    return np.asarray(np.maximum(high - low, 0.0).prod(axis=1))


def _lapses(rng: np.random.Generator, boxes: Boxes, harbour: Harbour) -> np.ndarray:
    """Half a second to three seconds in which the detector sees nothing of a vessel."""
    lost = np.zeros(len(boxes), dtype=bool)
    for boat in harbour.boats:
        for _ in range(rng.poisson(DURATION_S / 40.0)):
            start = harbour.start_utc_s + rng.uniform(0.0, DURATION_S)
            end = start + rng.uniform(0.5, 3.0)
            lost |= (
                (boxes.track_id == boat.identity)
                & (boxes.time_utc_s > start)
                & (boxes.time_utc_s < end)
            )
    return lost


def _clutter(rng: np.random.Generator, harbour: Harbour, times: FloatArray) -> Boxes:
    """One and a half flickering boxes a frame, and things that drift for up to four seconds."""
    width, height = harbour.camera.image_size_px
    horizon = float(np.mean(harbour.camera.horizon_px([0.0, width])))

    def places(n: int) -> FloatArray:
        foot = horizon + 4.0 + (height - horizon - 8.0) * rng.random(n) ** 2
        size = 6.0 + 0.12 * (foot - horizon) * rng.uniform(0.3, 1.5, n)
        shape = size[:, None] * rng.uniform(0.5, 1.6, (n, 2))
        x = rng.uniform(0.0, width, n)
        return np.column_stack(
            [x - 0.5 * shape[:, 0], foot - shape[:, 1], x + 0.5 * shape[:, 0], foot]
        )

    count = rng.poisson(1.5, times.size)
    frame = [np.repeat(np.arange(times.size), count)]
    xyxy = [places(int(count.sum()))]
    sure = [rng.beta(2.0, 4.0, int(count.sum()))]
    for _ in range(rng.poisson(DURATION_S / 3.0)):
        start = rng.uniform(times[0], times[-1])
        rows = np.flatnonzero((times >= start) & (times < start + rng.uniform(0.3, 4.0)))
        rows = rows[rng.random(rows.size) < 0.8]
        if not rows.size:
            continue
        base = places(1)
        speed = rng.normal(0.0, 0.5, 2) * np.sqrt((base[0, 2:] - base[0, :2]).prod())
        moved = (times[rows] - start)[:, None] * speed
        frame.append(rows)
        xyxy.append(base + np.tile(moved, 2) + rng.normal(0.0, 1.5, (rows.size, 4)))
        sure.append(rng.beta(3.0, 3.0, rows.size))
    rows, boxes = np.concatenate(frame), np.concatenate(xyxy)
    boxes[:, [0, 2]] = np.clip(boxes[:, [0, 2]], 0.0, width)
    boxes[:, [1, 3]] = np.clip(boxes[:, [1, 3]], 0.0, height)
    good = (boxes[:, 2] - boxes[:, 0] > 2.0) & (boxes[:, 3] - boxes[:, 1] > 2.0)
    out = Boxes.of(
        boxes[good],
        frame=rows[good],
        time_utc_s=times[rows[good]],
        confidence=np.concatenate(sure)[good],
        source="detector",
    )
    return out[out.confidence > 0.1]


def learned(crowd: Crowd, seed: int) -> Georeferencer:
    """A model that learned the camera from one boat's log on another day."""
    harbour = Harbour.random(
        seed + 5000,
        HarbourSettings(
            duration_s=240.0,
            camera=crowd.harbour.camera,
            start_utc_s=crowd.harbour.start_utc_s - 86400.0,
            gulls=0,
        ),
    )
    noise = BoxNoise(std_px=1.5, correlation_time_s=0.8, source="detector")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        write_boxes(harbour.boxes(harbour.times(0.5), noise=noise), path / "boxes.csv")
        write_fixes(harbour.fixes(ReceiverNoise()), path / "fixes.csv")
        width, height = harbour.camera.image_size_px
        scene = (
            f"[camera]\nlatitude_deg = {harbour.plane.latitude_deg}\n"
            f"longitude_deg = {harbour.plane.longitude_deg}\nimage_size_px = [{width}, {height}]\n"
            '[[recordings]]\nname = "a"\nboxes = "boxes.csv"\nfixes = "fixes.csv"\n'
        )
        (path / "scene.toml").write_text(scene, encoding="utf-8")
        return fit(Scene.load(path / "scene.toml"), "camera")
