from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from scipy.stats import chi2

from sightline.camera.priors import PixelNoise
from sightline.formats.control_points import read_control_points
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.types import ControlPoints

pytestmark = pytest.mark.slow

SIZE = (800, 600)


def write_scene(path: Path, points: ControlPoints) -> Path:
    """A scene of control points alone: nobody says where the camera stands."""
    lines = [f"[camera]\nimage_size_px = [{SIZE[0]}, {SIZE[1]}]"]
    for (x, y), latitude, longitude in zip(
        points.pixel_px.tolist(),
        points.latitude_deg.tolist(),
        points.longitude_deg.tolist(),
        strict=True,
    ):
        lines.append(
            f"[[control_points]]\npixel_px = [{x}, {y}]\n"
            f"latitude_deg = {latitude!r}\nlongitude_deg = {longitude!r}"
        )
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def points(data_dir: Path) -> ControlPoints:
    return read_control_points(data_dir / "otvision" / "Cars-Truck.otrfpts")


@pytest.fixture(scope="module")
def left_out(
    points: ControlPoints, tmp_path_factory: pytest.TempPathFactory
) -> list[Georeferencer]:
    """For each point a camera that was fitted to the four others."""
    folder = tmp_path_factory.mktemp("road")
    return [
        fit(Scene.load(write_scene(folder / f"{i}.toml", points[np.arange(5) != i])), "camera")
        for i in range(len(points))
    ]


def test_each_point_left_out_is_found_from_the_others(
    points: ControlPoints, left_out: list[Georeferencer]
) -> None:
    held = 0
    for i, model in enumerate(left_out):
        assert model.camera is not None
        assert model.report.control_points == 4
        assert model.regressor.fit_.starts_agreeing >= 20
        x, y = points.pixel_px[i]
        place = model.locate([x - 0.5, y - 1.0, x + 0.5, y])
        east, north = model.plane.to_plane(
            points.latitude_deg[i : i + 1], points.longitude_deg[i : i + 1]
        )
        # A point has no hull, whose near side a box would end at: the bare camera places it.
        found = model.camera.locate([[x, y]])
        off = np.array([found[0][0] - east[0], found[1][0] - north[0]])
        assert np.hypot(*off) < 1.0
        held += off @ np.linalg.solve(place.covariance_m2[0], off) < chi2.ppf(0.95, 2)
    assert held >= 4


def test_the_plane_has_its_origin_where_the_camera_was_found(
    points: ControlPoints, left_out: list[Georeferencer]
) -> None:
    for model in left_out:
        assert model.camera is not None
        assert np.hypot(model.camera.east_m, model.camera.north_m) < 0.1
        assert model.camera.image_size_px == SIZE
        # The four points that it learned from are seen where they were drawn.
        east, north = model.plane.to_plane(points.latitude_deg, points.longitude_deg)
        apart = np.hypot(*(model.camera.project(east, north) - points.pixel_px).T)
        assert np.sort(apart)[:4].max() < 3.0 * PixelNoise().column_px


def test_vehicles_lie_where_another_solution_puts_them(
    data_dir: Path, points: ControlPoints, tmp_path: Path
) -> None:
    """OTVision's homography of the same five points takes the middle of a box for the road."""
    model = fit(Scene.load(write_scene(tmp_path / "road.toml", points)), "camera")
    assert model.camera is not None
    database = data_dir / "otvision" / "Cars-Truck.gpkg"
    with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro&immutable=1", uri=True)) as theirs:
        ((table,),) = theirs.execute("SELECT table_name FROM gpkg_contents")
        rows = theirs.execute(f'SELECT x, y, lon_utm, lat_utm FROM "{table}"').fetchall()
    x, y, utm_east, utm_north = np.array(rows).T
    to_degrees = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    longitude, latitude = to_degrees.transform(utm_east, utm_north)
    east, north = model.plane.to_plane(latitude, longitude)
    found_east, found_north = model.camera.locate(np.stack([x, y], axis=1))
    apart_m = np.hypot(found_east - east, found_north - north)
    range_m = np.hypot(found_east, found_north)
    # The points lie 20 to 35 m away; from there on a homography drifts.
    assert (range_m < 40.0).sum() > 100
    assert np.median(apart_m[range_m < 40.0]) < 0.3
    assert np.median(apart_m[range_m < 80.0]) < 0.8
