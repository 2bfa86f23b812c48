from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.detection.letterbox import Letterbox

SIDES = st.integers(1, 2000)


@given(
    st.tuples(SIDES, SIDES),
    st.tuples(st.integers(8, 900), st.integers(8, 900)),
    st.booleans(),
)
def test_the_corners_of_the_canvas_lie_about_the_picture(
    size: tuple[int, int], canvas: tuple[int, int], centred: bool
) -> None:
    fitted = Letterbox.fit(size, canvas_px=canvas, centred=centred)
    whole = fitted.to_picture(np.array([[0.0, 0.0, *canvas]]))[0]
    assert whole[:2].max() <= 1e-9
    assert (whole[2:] >= np.array(size) - 1e-6).all()
    # Nothing larger would have fitted.
    assert (size / (whole[2:] - whole[:2])).max() > 0.9


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("canvas", [(320, 320), (352, 160), (1000, 1000)])
def test_a_square_lies_on_the_canvas_where_its_box_says(
    canvas: tuple[int, int], centred: bool
) -> None:
    image = np.zeros((360, 640, 3), np.uint8)
    image[120:240, 200:440] = 255
    fitted = Letterbox.fit((640, 360), canvas_px=canvas, centred=centred)
    shown = fitted.apply(image, pad=0)
    assert shown.shape == (canvas[1], canvas[0], 3)
    rows, columns = np.nonzero(shown[..., 0] >= 128)
    seen = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    found = fitted.to_picture(np.array([seen], dtype=float))[0]
    # Half a pixel of the canvas, in pixels of the picture.
    half_px = 0.51 / min(canvas[0] / 640, canvas[1] / 360)
    np.testing.assert_allclose(found, [200.0, 120.0, 440.0, 240.0], atol=half_px)


def test_a_free_canvas_is_a_multiple_of_the_stride_and_padded_with_grey() -> None:
    fitted = Letterbox.fit((1280, 361), scale=0.25, stride_px=32)
    assert fitted.inner_px == (320, 90)
    assert fitted.canvas_px == (320, 96)
    shown = fitted.apply(np.zeros((361, 1280, 3), np.uint8), pad=114)
    assert (shown[:90] == 0).all()
    assert (shown[90:] == 114).all()


def test_what_fits_already_is_not_touched() -> None:
    image = np.arange(64 * 96 * 3, dtype=np.uint8).reshape(64, 96, 3)
    assert Letterbox.fit((96, 64), scale=1.0).apply(image) is image
