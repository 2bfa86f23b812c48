"""What a scene states of its camera, against simulated cameras of which it is true or is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline.camera.mixed_model import MixedModel
from sightline.camera.observations import NO_SOURCE, PointCorrespondences
from sightline.camera.parameters import HEADING
from sightline.camera.pinhole import Camera
from sightline.camera.priors import CameraPrior
from sightline.camera.stated import horizontal_fov_deg, stated_camera
from sightline.errors import FitError, InputError
from sightline.georeferencing.fit_report import FitReport
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.types import FloatArray

pytestmark = pytest.mark.slow

SIZE = (1280, 720)
LATITUDE, LONGITUDE = 54.0, 10.0
# Of WGS 84 at 54 degrees north.
LATITUDE_M, LONGITUDE_M = 111_305.0, 65_576.0
TRUE = Camera(
    height_m=9.0,
    pitch_deg=4.0,
    roll_deg=0.8,
    heading_deg=352.0,
    focal_px=1100.0,
    k1=-0.06,
    k2=0.0,
    east_m=0.0,
    north_m=0.0,
    image_size_px=SIZE,
    curvature=6.0 / 7.0,
)
LENGTH_M, BEAM_M = 7.0, 2.5
RANGES_M = (60.0, 90.0, 140.0, 200.0, 300.0)
STATED_TRULY = "focal_px = [1100, 20]\nheading_deg = 350\npitch_deg = [4.2, 0.3]\nroll_deg = 0.5"


def paths(camera: Camera, rng: np.random.Generator, ranges_m: FloatArray) -> list[FloatArray]:
    """Boats that cross the picture: east and north of each second, with its course."""
    out = []
    facing = np.radians(camera.heading_deg) - np.arctan2(camera.principal_dx_px, camera.focal_px)
    for number, range_m in enumerate(ranges_m):
        slant = rng.uniform(-0.7, 0.7) + np.pi * (number % 2)
        course = facing + 0.5 * np.pi + slant
        middle = range_m * np.array([np.sin(facing), np.cos(facing)])
        along = 4.0 * (np.arange(60) - 30.0)
        place = middle + along[:, None] * np.array([np.sin(course), np.cos(course)])
        out.append(np.column_stack([place, np.full(60, course)]))
    return out


def write_scene(
    folder: Path,
    camera: Camera = TRUE,
    stated: str = "",
    *,
    ranges_m: tuple[float, ...] = RANGES_M,
    seed: int = 0,
    points: str = "",
) -> Path:
    """A scene of boats that pass at some ranges, seen by a camera to a pixel."""
    rng = np.random.default_rng([seed, 17])
    lines = [
        "[camera]",
        f"latitude_deg = {LATITUDE}",
        f"longitude_deg = {LONGITUDE}",
        f"image_size_px = [{SIZE[0]}, {SIZE[1]}]",
        stated,
    ]
    for number, path in enumerate(paths(camera, rng, np.array(ranges_m))):
        east, north, course = path.T
        distance = np.hypot(east, north)
        bearing = np.arctan2(east, north)
        across = np.abs(np.sin(course - bearing))
        ahead = np.abs(np.cos(course - bearing))
        near = 1.0 - 0.5 * (LENGTH_M * ahead + BEAM_M * across) / distance
        foot = camera.project(east * near, north * near)
        width = (LENGTH_M * across + BEAM_M * ahead) * camera.focal_px / distance
        foot += rng.normal(0.0, (2.0, 1.0), foot.shape)
        seen = (foot > 0.0).all(axis=1) & (foot < SIZE).all(axis=1)
        start = 1_700_000_000.0 + 1000.0 * number
        boxes = ["frame,x1,y1,x2,y2,time_utc"]
        for i in np.flatnonzero(seen).tolist():
            (x, y), half = foot[i], 0.5 * width[i]
            boxes.append(
                f"{i},{x - half:.2f},{y - 0.4 * width[i]:.2f},{x + half:.2f},{y:.2f},{start + i}"
            )
        (folder / f"boxes{number}.csv").write_text("\n".join(boxes) + "\n")
        off = rng.normal(0.0, 0.5, 2)
        fixes = ["time_utc,latitude_deg,longitude_deg"]
        for i in range(len(path)):
            latitude = LATITUDE + (north[i] + off[1]) / LATITUDE_M
            longitude = LONGITUDE + (east[i] + off[0]) / LONGITUDE_M
            fixes.append(f"{start + i},{latitude:.8f},{longitude:.8f}")
        (folder / f"log{number}.csv").write_text("\n".join(fixes) + "\n")
        lines += [
            "[[recordings]]",
            f'name = "{number}"',
            f'boxes = "boxes{number}.csv"',
            f'fixes = "log{number}.csv"',
        ]
    out = folder / "scene.toml"
    out.write_text("\n".join([*lines, points]) + "\n")
    return out


def fitted(
    folder: Path,
    stated: str = "",
    *,
    camera: Camera = TRUE,
    ranges_m: tuple[float, ...] = RANGES_M,
    seed: int = 0,
    points: str = "",
) -> Georeferencer:
    folder.mkdir(exist_ok=True)
    path = write_scene(folder, camera, stated, ranges_m=ranges_m, seed=seed, points=points)
    return fit(Scene.load(path), "camera")


def value_of(report: FitReport, name: str) -> tuple[float, float]:
    (found,) = [one for one in report.parameters if one.name == name]
    return found.value, found.sigma


def contradictions(report: FitReport) -> list[str]:
    return [said for said in report.statements if "is stated as" in said]


# One passage at one range tells next to nothing of these together.
@pytest.mark.parametrize(
    ("stated", "name", "value", "within"),
    [
        ("height_m = [9.0, 0.05]", "height_m", 9.0, 0.05),
        ("focal_px = [1100, 5]", "focal_px", 1100.0, 5.0),
        ("pitch_deg = [4.0, 0.1]", "pitch_deg", 4.0, 0.1),
        ("heading_deg = [352.0, 0.1]", "heading_deg", 352.0, 0.1),
        ("principal_point_px = [640, 360, 0.5]", "principal_dx_px", 0.0, 0.5),
        # Of 7/5 of the earth's radius 5/7 of its curvature is left.
        ("effective_earth_radius_m = [8.92e6, 8.92e4]", "curvature", 5.0 / 7.0, 0.01),
    ],
)
def test_what_is_stated_narrows_the_camera(
    tmp_path: Path, stated: str, name: str, value: float, within: float
) -> None:
    without = fitted(tmp_path / "without", ranges_m=(90.0,)).report
    report = fitted(tmp_path / "stated", stated, ranges_m=(90.0,)).report
    found, sigma = value_of(report, name)
    assert sigma <= 1.05 * within < value_of(without, name)[1]
    assert abs(found - value) < 3.0 * within
    assert not contradictions(report)


def test_a_true_height_places_what_a_single_passage_leaves_open(tmp_path: Path) -> None:
    """Learned at one range and asked at another: the height decides."""
    pixel = TRUE.project([30.0, -80.0], [250.0, 280.0])
    errors = []
    for name, stated in (("without", ""), ("stated", STATED_TRULY + "\nheight_m = [9.2, 0.3]")):
        worst = []
        for seed in range(3):
            model = fitted(tmp_path / f"{name}{seed}", stated, ranges_m=(70.0,), seed=seed)
            assert model.camera is not None
            east, north = model.camera.locate(pixel)
            worst.append(np.hypot(east - [30.0, -80.0], north - [250.0, 280.0]).max())
        errors.append(np.nan_to_num(worst, nan=1e3).mean())
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize(
    ("stated", "key", "wanted"),
    [
        ("height_m = 14.0", "height_m is stated as 14.0 ± 1.4", 9.0),
        ("height_m = [14.0, 0.1]", "height_m is stated as 14.00 ± 0.10", 9.0),
        ("focal_px = 800", "focal_px is stated as 800 ± 40", 1100.0),
        # Without distortion 60.4 degrees; the lens's makes it 61.4.
        ("horizontal_fov_deg = 40", "horizontal_fov_deg is stated as 40.0 ± 2.0", 61.4),
        ("heading_deg = 300", "heading_deg is stated as 300.0 ± 5.0", 352.0),
        ("pitch_deg = 15", "pitch_deg is stated as 15.0 ± 2.0", 4.0),
        ("roll_deg = -8", "roll_deg is stated as -8.0 ± 1.0", 0.8),
        ("principal_point_px = [400, 360, 10]", "principal_point_px is stated as [400, 360]", 640),
    ],
)
def test_a_wrong_statement_is_told(tmp_path: Path, stated: str, key: str, wanted: float) -> None:
    (said,) = contradictions(fitted(tmp_path, stated).report)
    assert said.startswith(f"[camera] {key}")
    words = said.split(" want ")[1].split(": check")[0].replace("[", "").replace(",", " ").split()
    sigma = float(words[-1])
    assert abs(float(words[0]) - wanted) < 3.0 * sigma


def test_only_the_wrong_one_of_several_is_told(tmp_path: Path) -> None:
    (said,) = contradictions(fitted(tmp_path, STATED_TRULY + "\nheight_m = 14.0").report)
    assert said.startswith("[camera] height_m ")


@pytest.mark.parametrize("ranges_m", [(90.0,), (60.0, 140.0), (250.0, 300.0)])
def test_true_statements_are_not_told(tmp_path: Path, ranges_m: tuple[float, ...]) -> None:
    """What is stated is off by as much as it may be."""
    for seed in range(4):
        off = np.random.default_rng([seed, 5]).normal(0.0, 1.0, 4)
        stated = (
            f"height_m = {9.0 * (1.0 + 0.1 * off[0])}\nfocal_px = {1100.0 * (1.0 + 0.05 * off[1])}"
            f"\nheading_deg = {-8.0 + 5.0 * off[2]}\npitch_deg = {4.0 + 2.0 * off[3]}"
        )
        report = fitted(tmp_path / str(seed), stated, ranges_m=ranges_m, seed=seed).report
        assert not contradictions(report)


def test_a_refusal_says_what_is_stated_wrongly(tmp_path: Path) -> None:
    with pytest.raises(FitError, match=r"no camera explains .*; \[camera\] principal_point_px is "):
        fitted(tmp_path, "principal_point_px = [640, -9000, 1]")


def test_what_is_stated_is_not_said_to_be_assumed(tmp_path: Path) -> None:
    said = fitted(tmp_path, "effective_earth_radius_m = 7.4e6").report.statements
    assert "What is stated decides more than the data does: curvature." in said
    assert not [one for one in said if "does not determine" in one and "curvature" in one]


def test_a_picture_that_was_cut_out_of_another_larger_one(tmp_path: Path) -> None:
    """Its optical axis lies 260 px beyond its edge."""
    cut = replace(TRUE, principal_dx_px=900.0, heading_deg=30.0, k1=0.0)
    without = fitted(tmp_path / "without", camera=cut).report
    report = fitted(tmp_path / "stated", "principal_point_px = [1540, 360]", camera=cut).report
    assert not contradictions(report)
    off = []
    for one in (without, report):
        found, sigma = value_of(one, "focal_px")
        off.append(abs(found - 1100.0) / sigma)
    assert off[1] < 3.0 < off[0]
    assert report.rmse_m < 0.7 * without.rmse_m


@pytest.mark.parametrize("heading_deg", [352.0, -8.0, 358.0])
def test_a_heading_just_west_of_north(tmp_path: Path, heading_deg: float) -> None:
    """However the full turns are counted, it is the same."""
    report = fitted(tmp_path, f"heading_deg = {heading_deg}").report
    assert value_of(report, "heading_deg")[0] == pytest.approx(352.0, abs=0.5)
    assert value_of(report, "height_m")[0] == pytest.approx(9.0, abs=0.5)


def test_starts_look_where_the_picture_was_cut_out() -> None:
    cut = replace(TRUE, principal_dx_px=900.0, heading_deg=30.0, k1=0.0)
    pixel = np.array([(x, y) for x in (200.0, 640.0, 1100.0) for y in (450.0, 600.0)])
    east, north = cut.locate(pixel)
    sightings = PointCorrespondences(
        pixel_px=pixel,
        east_m=east,
        north_m=north,
        source=np.full(6, NO_SOURCE),
        group=np.arange(6),
        velocity_mps=np.zeros((6, 2)),
        sigma_m=np.full(6, 0.1),
    )
    stated = stated_camera({"principal_point_px": [1540.0, 360.0], "focal_px": 1100.0})
    prior = stated.prior(CameraPrior(), SIZE)
    model = MixedModel(sightings, SIZE, 0, prior, True, None)
    (start,) = model.starts(1, np.random.default_rng(0))
    assert np.degrees(start[HEADING]) == pytest.approx(30.0, abs=3.0)


def test_a_picture_that_was_cut_out_has_the_focal_length_of_the_whole() -> None:
    """The left half of a picture of 2560 px, of whose width a usual focal length is a share."""
    half = stated_camera({"principal_point_px": [1280.0, 360.0]}).prior(CameraPrior(), SIZE)
    usual = CameraPrior()
    assert half.focal_widths * 1280.0 == pytest.approx(usual.focal_widths * 2560.0)
    assert half.principal_sigma_widths * 1280.0 == pytest.approx(
        usual.principal_sigma_widths * 2560.0
    )


def test_control_points_beside_boxes_have_their_own_residuals(tmp_path: Path) -> None:
    """Five where the camera sees them, and one that the scene states 40 m too far north."""
    east, north = np.array([-40.0, -20.0, 5.0, -70.0, 15.0, -10.0]), np.full(6, 120.0)
    pixel = TRUE.project(east, north)
    north[4] += 40.0
    tables = [
        f"[[control_points]]\npixel_px = [{x:.2f}, {y:.2f}]\n"
        f"latitude_deg = {LATITUDE + n / LATITUDE_M:.9f}\n"
        f"longitude_deg = {LONGITUDE + e / LONGITUDE_M:.9f}"
        for (x, y), e, n in zip(pixel.tolist(), east.tolist(), north.tolist(), strict=True)
    ]
    report = fitted(tmp_path, points="\n".join(tables)).report
    assert report.n > 200
    assert report.control_points == len(report.points) == 6
    assert [point.number for point in report.points if point.outlier] == [5]
    for point, x, y in zip(report.points, *pixel.T.tolist(), strict=True):
        assert (point.x_px, point.y_px) == (pytest.approx(x, abs=0.01), pytest.approx(y, abs=0.01))
        if point.number != 5:
            assert point.residual_px < 8.0
            assert point.error_m < 8.0
    # It looks as far off as the two places lie apart in the picture.
    apart = np.hypot(*(pixel[4] - TRUE.project(east[4:5], north[4:5])[0]))
    assert report.points[4].residual_px == pytest.approx(apart, rel=0.2)
    assert report.points[4].error_m == pytest.approx(40.0, rel=0.2)
    told = [said for said in report.statements if "control points disagree" in said]
    assert len(told) == 1
    assert told[0].startswith("1 of 6 control points disagree with all others and count little (5")


def write_alike(folder: Path, text: str) -> Scene:
    (folder / "boxes.csv").write_text("frame,x1,y1,x2,y2,time_utc\n0,1,1,2,2,1e9\n")
    path = folder / "scene.toml"
    path.write_text(
        f'[camera]\nimage_size_px = [1280, 720]\n{text}\n[[recordings]]\nname = "a"\n'
        'boxes = "boxes.csv"\n'
    )
    return Scene.load(path)


def test_keys_of_a_scene(tmp_path: Path) -> None:
    scene = write_alike(tmp_path, "height_m = 12\nroll_deg = [0.5, 0.25]\nheading_deg = -30")
    stated = scene.camera.stated
    assert stated.keys == ("height_m", "heading_deg", "roll_deg")
    values = [stated.height_m, stated.roll_deg, stated.heading_deg]
    np.testing.assert_allclose(np.array(values), [(12.0, 1.2), (0.5, 0.25), (-30.0, 5.0)])


def test_a_field_of_view_is_that_of_the_whole_picture() -> None:
    for field in (20.0, 60.0, 90.0, 110.0):
        for column in (640.0, 500.0):
            stated = stated_camera(
                {"horizontal_fov_deg": [field, 0.1], "principal_point_px": [column, 360.0, 1.0]}
            )
            prior = stated.prior(CameraPrior(), SIZE)
            lens = replace(
                TRUE,
                focal_px=prior.focal_widths * SIZE[0],
                k1=0.0,
                principal_dx_px=column - 640.0,
            )
            assert horizontal_fov_deg(lens) == pytest.approx(field)
            left, right = lens.rays([[0.0, 360.0], [1280.0, 360.0]])
            assert np.degrees(np.arccos(left @ right)) == pytest.approx(field)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("height_m = -1", r"camera\.height_m: give metres .* between 0.01 and 9000; it is -1"),
        ("height_m = [1, 0]", r"camera\.height_m: give metres .*standard deviation, \[12\.0, 0\.5"),
        ("height_m = [1, 2, 3]", r"camera\.height_m: give metres .*; it is \[1"),
        ("height_m = []", r"camera\.height_m: give metres .*; it is \[\]"),
        ('height_m = "high"', r"camera\.height_m: "),
        ("horizontal_fov_deg = 180", r"camera\.horizontal_fov_deg: .* between 0.1 and 170"),
        ("horizontal_fov_deg = 1e-320", r"camera\.horizontal_fov_deg: .* between 0.1 and 170"),
        ("heading_deg = 400", r"camera\.heading_deg: .* between -360 and 360"),
        ("effective_earth_radius_m = 1.17", r"camera\.effective_earth_radius_m: .*7\.43e6"),
        ("principal_point_px = [1]", r"camera\.principal_point_px: give the column and the row"),
        ("principal_point_px = [1, 2, -3]", r"camera\.principal_point_px: give the column"),
        ("focal_px = 900\nhorizontal_fov_deg = 60", "horizontal_fov_deg or focal_px, not both"),
    ],
)
def test_refused_statements(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        write_alike(tmp_path, text)
    assert "\n" not in str(caught.value)
