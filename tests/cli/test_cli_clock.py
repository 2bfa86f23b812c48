"""Clocks that are off, at the command line."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from _support.clocks import drawn_scene

from sightline import fit

Command = Callable[..., "object"]
LATE_S = 40.0


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene whose camera's clock is ahead, and the model of it."""
    folder = tmp_path_factory.mktemp("late")
    scene = drawn_scene(folder, {"01": LATE_S, "02": LATE_S}, duration_s=60.0)
    fit(scene, "camera").save(folder / "late.safetensors")
    return folder


def times_s(path: Path) -> np.ndarray:
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return (
        np.array([row["time_utc"].rstrip("Z") for row in rows], dtype="datetime64[ms]").astype(
            float
        )
        / 1e3
    )


@pytest.mark.slow
def test_track_takes_off_the_clock_that_it_is_told(
    sightline: Command, late: Path, tmp_path: Path
) -> None:
    command = ["track", late / "boxes-01.csv", "--model", late / "late.safetensors", "-o"]
    plain = sightline(*command, tmp_path / "plain.csv")
    assert plain.status == 0, plain.err
    assert "the tracks are in the camera's time" in plain.err + plain.out
    told = sightline(
        *command, tmp_path / "told.csv", "--clock-offset", LATE_S, "--json", tmp_path / "t.json"
    )
    assert told.status == 0, told.err
    assert "40 s were taken off" in told.err + told.out
    assert json.loads((tmp_path / "t.json").read_text())["clock_offset_s"] == LATE_S
    before, after = times_s(tmp_path / "plain.csv"), times_s(tmp_path / "told.csv")
    np.testing.assert_allclose(before - after, LATE_S, atol=2e-3)


@pytest.mark.slow
def test_a_report_says_the_clock_and_its_sigma(
    sightline: Command, late: Path, tmp_path: Path
) -> None:
    got = sightline(
        "run", late / "scene.toml", "-o", tmp_path / "out", "--json", tmp_path / "r.json"
    )
    assert got.status == 0, got.err
    result = json.loads((tmp_path / "r.json").read_text())
    for name in ("01", "02"):
        clock = result["clocks"][name]
        assert abs(clock["offset_s"] - LATE_S) < 3.0 * clock["sigma_s"]
        assert clock["used_s"] == clock["offset_s"]
        assert result["recordings"][name]["ape"]["median"] < 15.0
    assert "s ahead of the log; its tracks and scores are in the log's time" in got.out + got.err
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "clock of recording 01 ahead of the log" in page
    got = sightline("evaluate", late / "scene.toml", "--model", late / "late.safetensors")
    assert got.status == 0, got.err
    assert "it is scored in the log's time" in got.out + got.err
