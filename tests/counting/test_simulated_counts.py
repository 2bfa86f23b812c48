"""Counts of noisy tracks in the simulated harbour against where its boats truly were."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.area import Line
from sightline.counting import count
from sightline.simulation import Harbour, HarbourSettings
from sightline.types import FloatArray, Track

STEP_S = 0.5
CORRELATION_S = 60.0


def true_crossings(place: FloatArray, ends: FloatArray) -> tuple[list[int], float]:
    """Signs of a path's crossings, and how far it is from the line wherever it turns or ends.

    Where it begins or turns back beside the line, nobody can tell on which side it was; nor where
    it passes an end of the line closely.
    """
    (a, b), unit = ends, (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    off = place - a
    across, along = off[:, 0] * unit[1] - off[:, 1] * unit[0], off @ unit
    length = float(np.hypot(*(b - a)))
    changes = np.flatnonzero(np.sign(across[:-1]) != np.sign(across[1:]))
    signs: list[int] = []
    step = np.diff(across)
    turns = np.flatnonzero(step[:-1] * step[1:] < 0.0) + 1
    clear = float(np.abs(across[[0, *turns, -1]]).min())
    for k in changes:
        share = across[k] / (across[k] - across[k + 1])
        at = along[k] + share * (along[k + 1] - along[k])
        if 0.0 <= at <= length:
            signs.append(1 if across[k + 1] > 0.0 else -1)
        clear = min(clear, abs(at), abs(at - length))
    return signs, clear


def noisy(place: FloatArray, sigma: FloatArray, seed: int, i: int) -> FloatArray:
    rng = np.random.default_rng([seed, i])
    memory = np.exp(-STEP_S / CORRELATION_S)
    error = rng.standard_normal(place.shape)
    for k in range(1, len(error)):
        error[k] = memory * error[k - 1] + np.sqrt(1.0 - memory**2) * error[k]
    # A smoother's error has no jumps from point to point.
    kernel = np.hanning(41) / np.hanning(41).sum()
    padded = np.pad(error, ((20, 20), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(one, kernel, mode="valid") for one in padded.T], axis=1)
    return place + sigma * smooth


def harbour_tracks(seed: int) -> tuple[list[Track], list[FloatArray], FloatArray]:
    harbour = Harbour.random(seed, HarbourSettings(motorboats=10, sailboats=5, ferries=2))
    time = harbour.times(rate_hz=1.0 / STEP_S)
    sigma = np.array([1.0, 1.5])
    tracks, places = [], []
    for i, boat in enumerate(harbour.boats):
        place = boat.path.at(time - harbour.start_utc_s)
        velocity = boat.path.velocity(time - harbour.start_utc_s)
        seen = noisy(place, sigma, seed, i)
        n = len(time)
        tracks.append(
            Track(
                track_id=i,
                time_utc_s=time,
                east_m=seen[:, 0],
                north_m=seen[:, 1],
                velocity_east_mps=velocity[:, 0],
                velocity_north_mps=velocity[:, 1],
                covariance_m2=np.tile(np.diag(sigma**2), (n, 1, 1)),
                velocity_covariance_m2ps2=np.tile(0.04 * np.eye(2), (n, 1, 1)),
                kind=np.zeros(n, dtype=np.int8),
                plane=harbour.plane,
                label=boat.shape.kind,
                moored=np.full(n, not boat.path.moves),
            )
        )
        places.append(place)
    # Across the middle of where the boats are, along the view.
    angle = np.radians(harbour.camera.heading_deg)
    ahead = np.array([np.sin(angle), np.cos(angle)])
    return tracks, places, np.array([20.0 * ahead, 350.0 * ahead])


@pytest.mark.slow
def test_vessels_that_cross_clearly_are_counted_exactly_over_twenty_seeds() -> None:
    clear_crossings, expected, variance, truth = 0, 0.0, 0.0, 0
    for seed in range(20):
        tracks, places, ends = harbour_tracks(seed)
        latitude, longitude = tracks[0].plane.to_geographic(ends[:, 0], ends[:, 1])
        line = Line(np.column_stack([longitude, latitude]))
        exact: dict[tuple[str, str], int] = {}
        chosen = []
        for track, place in zip(tracks, places, strict=True):
            signs, clear = true_crossings(place, ends)
            truth += len(signs)
            if clear > 4.0 * 1.5:
                chosen.append(track)
                for sign in signs:
                    way = "left to right" if sign > 0 else "right to left"
                    key = (track.label, way)
                    exact[key] = exact.get(key, 0) + 1
        found: dict[tuple[str, str], int] = {}
        for row in count(chosen, lines={"gate": line}).lines:
            if row["count"]:
                key = (str(row["class"]), str(row["direction"]))
                found[key] = found.get(key, 0) + int(row["count"])
        assert found == exact, f"seed {seed}"
        clear_crossings += sum(exact.values())
        for row in count(tracks, lines={"gate": line}).lines:
            expected += float(row["expected"] or 0.0)
            variance += float(row["sigma"] or 0.0) ** 2
    assert clear_crossings > 400
    # All vessels, those on the line's edge as well.
    assert abs(expected - truth) < 3.0 * np.sqrt(variance)
