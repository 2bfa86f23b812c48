"""Control points of a fit: their residuals, and what is said of those that cannot be right."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline.camera.pinhole import Camera
from sightline.georeferencing.fit_report import FitReport
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.types import FloatArray

SIZE = (1280, 720)
LATITUDE, LONGITUDE = 54.0, 10.0
# Of WGS 84 at 54 degrees north.
LATITUDE_M, LONGITUDE_M = 111_305.0, 65_576.0
TRUE = Camera(
    height_m=9.0,
    pitch_deg=6.0,
    roll_deg=0.8,
    heading_deg=120.0,
    focal_px=1100.0,
    k1=0.0,
    k2=0.0,
    east_m=0.0,
    north_m=0.0,
    image_size_px=SIZE,
)


def write_scene(
    folder: Path,
    camera: Camera = TRUE,
    stated: str = "",
    *,
    moved: tuple[int, float, float] | None = None,
    seed: int = 0,
) -> tuple[Path, FloatArray]:
    """Twelve points that a camera sees to a pixel, of which one may lie elsewhere than stated."""
    rng = np.random.default_rng([seed, 23])
    pixel = rng.uniform((60.0, 330.0), (1220.0, 690.0), (12, 2))
    east, north = camera.locate(pixel)
    place = np.stack([east, north], axis=1)
    assert np.hypot(*place.T).max() < 900.0
    pixel += rng.normal(0.0, 1.0, pixel.shape)
    if moved is not None:
        place[moved[0]] += moved[1:]
    lines = [
        f"[camera]\nlatitude_deg = {LATITUDE}\nlongitude_deg = {LONGITUDE}",
        f"image_size_px = [{SIZE[0]}, {SIZE[1]}]\n{stated}",
    ]
    for (x, y), (e, n) in zip(pixel.tolist(), place.tolist(), strict=True):
        latitude, longitude = LATITUDE + n / LATITUDE_M, LONGITUDE + e / LONGITUDE_M
        lines.append(
            f"[[control_points]]\npixel_px = [{x:.2f}, {y:.2f}]\n"
            f"latitude_deg = {latitude:.9f}\nlongitude_deg = {longitude:.9f}"
        )
    path = folder / "scene.toml"
    path.write_text("\n".join(lines) + "\n")
    return path, place


def report_of(folder: Path, *args: object, **kwargs: object) -> FitReport:
    path, _ = write_scene(folder, *args, **kwargs)  # type: ignore[arg-type]
    return fit(Scene.load(path), "camera").report


def on_points(report: FitReport) -> list[str]:
    about = ("control points disagree", "Control points lie")
    return [said for said in report.statements if any(words in said for words in about)]


def test_residuals_of_control_points_are_those_of_their_pixels(tmp_path: Path) -> None:
    path, place = write_scene(tmp_path)
    model = fit(Scene.load(path), "camera")
    report = model.report
    assert model.camera is not None
    assert [point.number for point in report.points] == list(range(1, 13))
    pixel = np.array([(point.x_px, point.y_px) for point in report.points])
    found = np.stack(model.camera.locate(pixel), axis=1)
    error = np.array([point.error_m for point in report.points])
    # The planes of the two differ by less than a centimetre in a hundred metres.
    apart = np.abs(error - np.hypot(*(found - place).T))
    assert (apart < 1e-4 * np.hypot(*place.T)).all()
    residual = np.array([point.residual_px for point in report.points])
    seen = model.camera.project(*place.T)
    np.testing.assert_allclose(residual, np.hypot(*(seen - pixel).T), atol=0.7)
    assert report.rmse_m == pytest.approx(np.sqrt(np.mean(error**2)))
    assert report.median_m == pytest.approx(np.median(error))
    again = FitReport.from_dict(json.loads(json.dumps(report.to_dict())))
    assert again.points == report.points


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_said_of_points_that_are_right(tmp_path: Path, seed: int) -> None:
    report = report_of(tmp_path, seed=seed)
    assert not on_points(report)
    assert not any(point.outlier for point in report.points)


@pytest.mark.parametrize("row", [2, 7])
def test_a_point_in_the_wrong_place_is_named(tmp_path: Path, row: int) -> None:
    right = report_of(tmp_path)
    report = report_of(tmp_path, moved=(row, 25.0, -25.0))
    assert [point.number for point in report.points if point.outlier] == [row + 1]
    (said,) = on_points(report)
    assert said.startswith(
        f"1 of 12 control points disagree with all others and count little ({row + 1} at"
    )
    # It counts in the error, and hardly in the camera.
    assert report.points[row].error_m > 0.6 * np.hypot(25.0, 25.0)
    assert report.rmse_m > 5.0 > right.rmse_m


def test_a_picture_that_was_cut_out_says_so(tmp_path: Path) -> None:
    cut = replace(TRUE, principal_dx_px=1100.0, heading_deg=80.0)
    said = " ".join(on_points(report_of(tmp_path, cut)))
    assert "Control points lie " in said
    assert "cut out of a larger one (state [camera] principal_point_px)" in said
    assert not on_points(report_of(tmp_path, cut, "principal_point_px = [1740, 360]"))
