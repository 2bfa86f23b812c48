"""Several cameras before one simulated harbour: models, tracks, and what became of the targets."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from _support.tracking import TrackingScore, score_identities
from sightline import track
from sightline.formats import write_boxes, write_fixes, write_tracks
from sightline.fusion import CameraTracks
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.pipeline.fit_unlabelled import fit_scene
from sightline.pipeline.track import TrackSettings
from sightline.scene import Scene
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise
from sightline.simulation.harbour import DOCK
from sightline.types import NO_TRACK, Boxes, FloatArray, Track

DETECTOR = BoxNoise(
    std_px=1.5,
    correlation_time_s=0.8,
    lower_edge_bias_px=-1.5,
    miss_probability=0.08,
    source="detector",
    least_px=4.0,
)
MATCH_M = 15.0
"""A track that is further off than this is of no target."""


def learned(harbour: Harbour, seed: int) -> Georeferencer:
    """A model that learned the camera from one boat's log on another day."""
    other = Harbour.random(
        seed + 5000,
        HarbourSettings(
            duration_s=240.0,
            camera=harbour.camera,
            plane=harbour.plane,
            start_utc_s=harbour.start_utc_s - 86400.0,
            gulls=0,
        ),
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_boxes(other.boxes(other.times(0.5), noise=DETECTOR), folder / "boxes.csv")
        write_fixes(other.fixes(ReceiverNoise()), folder / "fixes.csv")
        write_scene(harbour, folder / "scene.toml", 'boxes = "boxes.csv"\nfixes = "fixes.csv"\n')
        return fit(Scene.load(folder / "scene.toml"), "camera")


def write_scene(harbour: Harbour, path: Path, recording: str) -> None:
    """A scene file of one recording."""
    width, height = harbour.camera.image_size_px
    path.write_text(
        f"[camera]\nlatitude_deg = {harbour.plane.latitude_deg}\n"
        f"longitude_deg = {harbour.plane.longitude_deg}\nimage_size_px = [{width}, {height}]\n"
        f'[[recordings]]\nname = "a"\n{recording}',
        encoding="utf-8",
    )


def detections(harbour: Harbour, seed: int, rate_hz: float = 5.0) -> Boxes:
    """What a detector finds of all boats: with misses, lapses of seconds, and without track ids."""
    rng = np.random.default_rng([seed, 31])
    boxes = harbour.boxes(harbour.times(rate_hz), noise=DETECTOR, of="all", seed=seed)
    lost = np.zeros(len(boxes), dtype=bool)
    for boat in harbour.boats:
        for _ in range(rng.poisson(harbour.duration_s / 60.0)):
            start = harbour.start_utc_s + rng.uniform(0.0, harbour.duration_s)
            end = start + rng.uniform(0.5, 4.0)
            times = boxes.time_utc_s
            lost |= (boxes.track_id == boat.identity) & (times > start) & (times < end)
    boxes = boxes[~lost]
    return boxes.with_columns(track_id=np.full(len(boxes), NO_TRACK))


def camera_tracks(harbour: Harbour, model: Georeferencer, seed: int) -> tuple[Track, ...]:
    """Tracks of a camera, a point a second."""
    made = track(detections(harbour, seed), model, settings=TrackSettings(interval_s=1.0))
    return tuple(made)


@dataclass(frozen=True, eq=False)
class TruePlaces:
    """Where vessels are while at least one camera sees them.

    Attributes:
        time_utc_s: (T,) float64, the moments.
        place_m: (T, B, 2) float64, in the plane of the harbour.
        seen: (T, B, K) bool, by each camera.
    """

    time_utc_s: FloatArray
    place_m: FloatArray
    seen: np.ndarray


def true_places(views: Sequence[Harbour]) -> TruePlaces:
    """The truth once a second; a camera sees a vessel that it has a box of within two seconds."""
    times = np.floor(views[0].start_utc_s) + np.arange(int(views[0].duration_s))
    boats = views[0].boats
    seen = np.zeros((times.size, len(boats), len(views)), dtype=bool)
    for k, view in enumerate(views):
        exact = view.boxes(times, of="all")
        rows = np.round(exact.time_utc_s - times[0]).astype(int)
        big = (exact.xyxy_px[:, 2:] - exact.xyxy_px[:, :2] > DETECTOR.least_px).all(axis=1)
        seen[rows[big], exact.track_id[big] - 1, k] = True
    place = np.empty((times.size, len(boats), 2))
    for j, boat in enumerate(boats):
        truth = views[0].truth(times, [boat])
        place[:, j] = np.stack(DOCK.to_plane(truth.latitude_deg, truth.longitude_deg), axis=1)
    return TruePlaces(times, place, seen)


def score(truth: TruePlaces, tracks: Sequence[Track]) -> TrackingScore:
    """Identities by how near tracks are to the vessels that some camera sees."""
    true_ids, found_ids, similarity = [], [], []
    somewhere = truth.seen.any(axis=2)
    by_time = _by_time(truth.time_utc_s, tracks)
    for t in range(truth.time_utc_s.size):
        own = np.flatnonzero(somewhere[t])
        ids, places = by_time[t]
        apart = np.hypot(*(truth.place_m[t, own][:, None] - places[None]).transpose(2, 0, 1))
        true_ids.append(own)
        found_ids.append(ids)
        # Half at the limit, as boxes that share a half.
        similarity.append(np.clip(1.0 - 0.5 * apart / MATCH_M, 0.0, 1.0))
    return score_identities(true_ids, found_ids, similarity)


def _by_time(times: FloatArray, tracks: Sequence[Track]) -> list[tuple[np.ndarray, FloatArray]]:
    rows: list[list[tuple[int, float, float]]] = [[] for _ in times]
    for number, one in enumerate(tracks):
        index = np.round(one.time_utc_s - times[0]).astype(int)
        on = (np.abs(one.time_utc_s - times[0] - index) < 0.02) & (index >= 0)
        for i, east, north in zip(index[on], one.east_m[on], one.north_m[on], strict=True):
            if i < len(rows):
                rows[i].append((number, east, north))
    return [
        (
            np.array([r[0] for r in row], dtype=np.int64),
            np.array([r[1:] for r in row]).reshape(-1, 2),
        )
        for row in rows
    ]


def as_cameras(views: Sequence[Harbour], tracks: Sequence[Sequence[Track]]) -> list[CameraTracks]:
    """Tracks of several cameras in the plane of the harbour."""
    out = []
    for k, (view, own) in enumerate(zip(views, tracks, strict=True)):
        east, north = DOCK.to_plane([view.plane.latitude_deg], [view.plane.longitude_deg])
        out.append(
            CameraTracks(
                f"camera-{k + 1}",
                tuple(one.in_plane(DOCK) for one in own),
                np.array([east[0], north[0]]),
            )
        )
    return out


def place_errors(harbour: Harbour, model: Georeferencer, seed: int) -> FloatArray:
    """(N,) metres, of single boxes of a detector that are right but for its bias, within 450 m."""
    exact = BoxNoise(
        std_px=0.0,
        lower_edge_bias_px=DETECTOR.lower_edge_bias_px,
        source=DETECTOR.source,
        least_px=DETECTOR.least_px,
    )
    boxes = harbour.boxes(harbour.times(0.5), noise=exact, of="all", seed=seed)
    found = model.locate(boxes.xyxy_px, source=boxes.source)
    errors = []
    for boat in harbour.boats:
        rows = boxes.track_id == boat.identity
        truth = harbour.truth(boxes.time_utc_s[rows], [boat])
        east, north = found.plane.to_plane(truth.latitude_deg, truth.longitude_deg)
        off = np.hypot(found.east_m[rows] - east, found.north_m[rows] - north)
        errors.append(off[(truth.range_m < 450.0) & np.isfinite(off)])
    return np.concatenate(errors)


def taught(harbour: Harbour, tracks: Sequence[Track], seed: int) -> Georeferencer:
    """A model of a camera without a log, taught by the fused tracks of its neighbours."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_boxes(detections(harbour, seed), folder / "detections.csv")
        write_tracks(tracks, folder / "fused.csv", fused=True)
        write_scene(
            harbour,
            folder / "scene.toml",
            'detections = "detections.csv"\nfixes = "fused.csv"\n',
        )
        return fit_scene(Scene.load(folder / "scene.toml"), "camera", detector=None)


def logged(harbour: Harbour, seed: int) -> Georeferencer:
    """The same camera with the log of one vessel in place of its neighbours' tracks."""
    moving = [boat for boat in harbour.boats if boat.path.moves]
    seen = harbour.boxes(harbour.times(1.0), of="all").track_id
    most = max(moving, key=lambda boat: int((seen == boat.identity).sum()))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_boxes(detections(harbour, seed), folder / "detections.csv")
        write_fixes(harbour.fixes(ReceiverNoise(), boat=most), folder / "fixes.csv")
        write_scene(
            harbour,
            folder / "scene.toml",
            'detections = "detections.csv"\nfixes = "fixes.csv"\n',
        )
        return fit_scene(Scene.load(folder / "scene.toml"), "camera", detector=None)
