"""Water levels at the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from sightline import Scene, fit, load

Command = Callable[..., "object"]
LEVEL_M = 12.5


@pytest.fixture
def tidal(harbour: Path) -> Path:
    """The scene of the harbour with a water level in each recording."""
    written = (harbour / "scene.toml").read_text(encoding="utf-8")
    path = harbour / "tidal.toml"
    told = f"[[recordings]]\nwater_level_m = {LEVEL_M}\n"
    path.write_text(written.replace("[[recordings]]\n", told), encoding="utf-8")
    return path


@pytest.mark.slow
def test_a_model_that_knows_levels_needs_one_to_track(
    sightline: Command, harbour: Path, tidal: Path, tmp_path: Path
) -> None:
    model = tmp_path / "tidal.model"
    got = sightline("fit", tidal, "--model", "camera", "-o", model)
    assert got.status == 0, got.err
    assert f"over a water level of {LEVEL_M:.2f} m" in got.out
    assert load(model).water_level_m == LEVEL_M
    source = [harbour / "boxes" / "01.csv", "--clock", harbour / "clock" / "01.csv"]
    table = tmp_path / "tide.csv"
    table.write_text(
        f"time_utc,water_level_m\n2000-01-01,{LEVEL_M}\n2000-01-02,{LEVEL_M}\n", encoding="utf-8"
    )
    for options, told in (
        ([], "say how high the water stands"),
        (["--water-level", "nan"], "--water-level nan: is no level"),
        (["--water-level", LEVEL_M + 100.0], "is not below the camera"),
        (["--water-level", table], "water levels: they say nothing of"),
        (["--water-level", tmp_path / "none.csv"], "none.csv"),
    ):
        got = sightline("track", *source, "--model", model, "-o", tmp_path / "t.csv", *options)
        assert got.status == 2
        assert told in got.err
        assert len(got.err.strip().splitlines()) == 1
        assert not (tmp_path / "t.csv").exists()
    plain = sightline(
        "track", *source, "--model", model, "-o", tmp_path / "t.csv", "--water-level", LEVEL_M
    )
    assert plain.status == 0, plain.err
    still = sightline(
        "track",
        *source,
        "--model",
        harbour / "camera.safetensors",
        "-o",
        tmp_path / "s.csv",
        "--water-level",
        LEVEL_M,
    )
    assert still.status == 2
    assert "fitted without water levels" in still.err


def test_a_scene_with_levels_runs_and_is_evaluated(
    sightline: Command, harbour: Path, tidal: Path, tmp_path: Path
) -> None:
    model = fit(Scene.load(tidal), "camera").save(tmp_path / "tidal.model")
    told = tmp_path / "report.json"
    got = sightline("evaluate", tidal, "--model", model, "--json", told)
    assert got.status == 0, got.err
    plain = tmp_path / "plain.json"
    still = fit(Scene.load(harbour / "scene.toml"), "camera").save(tmp_path / "still.model")
    assert (
        sightline("evaluate", harbour / "scene.toml", "--model", still, "--json", plain).status == 0
    )
    tidal_rmse, plain_rmse = (json.loads(p.read_text())["ape"]["rmse"] for p in (told, plain))
    # The same level everywhere is as good as none.
    assert tidal_rmse == pytest.approx(plain_rmse, rel=1e-3)
    refused = sightline("evaluate", tidal, "--model", still)
    assert refused.status == 2
    assert "was fitted without water levels" in refused.err


@pytest.mark.parametrize(
    ("written", "told"),
    [
        ('water_level_m = "high"', "water_level_m"),
        ("water_level_m = nan", "water_level_m"),
        ('water_levels = "none.csv"', "recordings[1].water_levels names"),
        ('water_level_m = 1.0\nwater_levels = "scene.toml"', "give water_level_m or water_levels"),
        ('water_level_m = 1.0\nplatform = "scene.toml"', "a platform floats with the water"),
        ('water_levels = "scene.toml"', "scene.toml"),
    ],
)
def test_levels_that_cannot_be_are_refused_in_one_line(
    sightline: Command, harbour: Path, tmp_path: Path, written: str, told: str
) -> None:
    scene = (harbour / "scene.toml").read_text(encoding="utf-8")
    path = harbour / "bad.toml"
    path.write_text(
        scene.replace("[[recordings]]\n", f"[[recordings]]\n{written}\n"), encoding="utf-8"
    )
    got = sightline("fit", path, "-o", tmp_path / "m.model")
    assert got.status == 2
    assert told in got.err
    assert len(got.err.strip().splitlines()) == 1
    assert not (tmp_path / "m.model").exists()
