"""The focal length that pictures carry."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from sightline.scene import Scene
from sightline.tally import Tally
from sightline.video import focal_length_px


def write_picture(path: Path, size: tuple[int, int], on_film_mm: int | None) -> Path:
    path.parent.mkdir(exist_ok=True)
    picture = Image.new("RGB", size)
    exif = Image.Exif()
    if on_film_mm is not None:
        exif.get_ifd(0x8769)[0xA405] = on_film_mm
    picture.save(path, exif=exif)
    return path


@pytest.mark.parametrize("ending", ["jpg", "webp"])
def test_a_picture_of_the_shape_of_film(tmp_path: Path, ending: str) -> None:
    """On 36 mm of film 28 mm are 28/36 of the width."""
    path = write_picture(tmp_path / f"1.{ending}", (1800, 1200), 28)
    tally = Tally(path)
    assert focal_length_px(path, tally=tally) == pytest.approx(1400.0)
    assert "28 mm on 35-mm film, 1400 px" in tally.notes[0]


def test_an_upright_picture_has_the_same_lens(tmp_path: Path) -> None:
    assert focal_length_px(write_picture(tmp_path / "1.jpg", (1200, 1800), 28)) == pytest.approx(
        1400.0
    )


@pytest.mark.parametrize("on_film_mm", [None, 0, 65_000])
def test_a_picture_that_does_not_know(tmp_path: Path, on_film_mm: int | None) -> None:
    assert focal_length_px(write_picture(tmp_path / "1.jpg", (90, 60), on_film_mm)) is None


def test_what_is_no_picture(tmp_path: Path) -> None:
    path = tmp_path / "1.jpg"
    path.write_bytes(b"\xff\xd8\xff\xe1\x00\x20Exif\0\0" + bytes(range(40)))
    assert focal_length_px(path) is None
    assert focal_length_px(tmp_path / "2.jpg") is None


def scene_of(folder: Path, camera: str) -> Scene:
    path = folder / "scene.toml"
    path.write_text(f'[camera]\n{camera}\n[[recordings]]\nname = "a"\nframes = "frames"\n')
    return Scene.load(path)


def test_a_scene_of_pictures_states_their_focal_length(tmp_path: Path) -> None:
    write_picture(tmp_path / "frames" / "7.jpg", (1800, 1200), 28)
    stated = scene_of(tmp_path, "height_m = 5.0").stated
    assert stated.keys == ("height_m", "focal_px")
    assert stated.focal_in_pictures
    assert stated.focal_px == pytest.approx((1400.0, 112.0))


@pytest.mark.parametrize(
    "camera", ["focal_px = 900", "horizontal_fov_deg = 60", "principal_point_px = [900, 600]"]
)
def test_what_the_scene_states_goes_before_what_pictures_carry(tmp_path: Path, camera: str) -> None:
    write_picture(tmp_path / "frames" / "7.jpg", (1800, 1200), 28)
    assert not scene_of(tmp_path, camera).stated.focal_in_pictures
