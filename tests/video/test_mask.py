"""Masks: black is neither looked at nor kept."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sightline.errors import InputError
from sightline.types import Boxes, Frame
from sightline.video.mask import GREY, Mask, read_mask

SIZE = (80, 60)


def painted(left: int = 40) -> np.ndarray:
    """The left half is masked."""
    image = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    image[:, :left] = 0
    return image


def write(path: Path, image: np.ndarray) -> Path:
    cv2.imwrite(str(path), image)
    return path


def alpha(grey: np.ndarray, opaque: np.ndarray) -> np.ndarray:
    return np.dstack([grey, grey, grey, opaque])


MASKS = {
    "grey.png": painted(),
    "colour.png": np.dstack([painted()] * 3),
    "lossy.jpg": painted(),
    # Painted black on nothing, as a layer of its own.
    "layer.png": alpha(np.zeros_like(painted()), 255 - painted()),
    # White, and a hole... that shows white as well, and black beside it.
    "holes.png": alpha(painted(), np.where(np.arange(80) > 60, 0, 255)[None].repeat(60, 0)),
}


@pytest.mark.parametrize("name", MASKS)
def test_black_is_masked_and_white_and_nothing_are_not(tmp_path: Path, name: str) -> None:
    mask = read_mask(write(tmp_path / name, MASKS[name].astype(np.uint8)))
    assert mask.size_px == SIZE
    np.testing.assert_array_equal(mask.hidden, painted() == 0)


def test_what_is_masked_is_grey_in_the_frames_and_the_given_ones_stay() -> None:
    mask = Mask(painted() == 0)
    image = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    before = image.copy()
    (frame,) = mask.painted([Frame(4, 1e9, image)], "recording 01")
    assert (frame.index, frame.time_utc_s) == (4, 1e9)
    assert (frame.image_bgr[:, :40] == GREY).all()
    np.testing.assert_array_equal(frame.image_bgr[:, 40:], before[:, 40:])
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize(
    ("box", "hidden"),
    [
        ([0, 0, 10, 10], True),
        ([50, 20, 70, 40], False),
        ([30, 20, 50, 40], True),
        ([31, 20, 51, 40], False),
        # Of what lies in the picture, a quarter.
        ([35, -500, 55, 40], False),
        ([-50, 20, -40, 30], True),
        ([90, 70, 95, 80], False),
    ],
)
def test_a_box_is_masked_where_half_of_what_is_seen_of_it_is(
    box: list[float], hidden: bool
) -> None:
    assert Mask(painted() == 0).hides(Boxes.of([box])).tolist() == [hidden]


def test_no_boxes_are_no_boxes() -> None:
    assert Mask(painted() == 0).hides(Boxes.of(np.empty((0, 4)))).shape == (0,)


def test_frames_of_another_size_are_refused() -> None:
    mask = Mask(painted() == 0, "m.png")
    frame = Frame(0, 0.0, np.zeros((30, 40, 3), np.uint8))
    message = r"m.png: has 80 x 60 px, and the pictures of recording 01 40 x 30 px; a mask is as"
    with pytest.raises(InputError, match=message):
        next(mask.painted([frame], "recording 01"))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((60, 80), np.uint8), "masks all of the picture; paint black what is masked"),
        # 0 and 1, as some programs write truth values.
        ((painted() > 0).astype(np.uint8), "masks all of the picture"),
        (np.full((60, 80), 128, np.uint8), "is no mask: 100 % of it is neither black nor white"),
        (np.tile(np.arange(80, dtype=np.uint8) * 3, (60, 1)), "is no mask: 5. % of it"),
    ],
)
def test_pictures_that_are_no_masks_are_refused(
    tmp_path: Path, image: np.ndarray, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        read_mask(write(tmp_path / "mask.png", image))


def test_files_that_are_no_pictures_are_refused(tmp_path: Path) -> None:
    whole = cv2.imencode(".png", painted())[1].tobytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut.png: is no picture that can be read, or is damaged"):
        read_mask(tmp_path / "cut.png")
    (tmp_path / "empty.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty.png: "):
        read_mask(tmp_path / "empty.png")
