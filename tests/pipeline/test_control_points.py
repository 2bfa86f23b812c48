from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from sightline.errors import FitError, InputError
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.types import ControlPoints

PIXELS = [(0.0, 259.5), (652.0, 136.0), (641.0, 297.0), (305.0, 129.0), (353.0, 192.0)]
LATITUDES = [51.106634507, 51.106733424, 51.106747299, 51.059288594, 51.106672417]
# The fourth easting lost a digit: the point lies in another country.
LONGITUDES = [13.916364759, 13.916095379, 13.916334154, 3.067527885, 13.916263864]
CAMERA = "[camera]\nimage_size_px = [800, 600]\nlatitude_deg = 51.1489\nlongitude_deg = 13.918\n"


def written(folder: Path, longitudes: list[float]) -> Path:
    points = "".join(
        f"[[control_points]]\npixel_px = [{x}, {y}]\n"
        f"latitude_deg = {north}\nlongitude_deg = {east}\n"
        for (x, y), north, east in zip(PIXELS, LATITUDES, longitudes, strict=True)
    )
    path = folder / "scene.toml"
    path.write_text(CAMERA + points)
    return path


def test_a_control_point_in_another_country_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"control point 4 lies 7\d\d km from the others"):
        Scene.load(written(tmp_path, LONGITUDES))


def test_points_that_no_camera_explains_end_in_a_line_or_a_model(tmp_path: Path) -> None:
    scene = Scene.load(written(tmp_path, [*LONGITUDES[:3], 13.9162, LONGITUDES[4]]))
    wild = replace(scene, control_points=ControlPoints(PIXELS, LATITUDES, LONGITUDES))
    # One of its starts ends where nothing holds a parameter; another may end well.
    with suppress(FitError):
        assert fit(wild, "camera+gpr").image_size_px == (800, 600)
