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
    st.lists(st.floats(-50.0, 2050.0), min_size=4, max_size=4),
)
def test_boxes_come_back_to_where_they_were(
    size: tuple[int, int], canvas: tuple[int, int], centred: bool, box: list[float]
) -> None:
    fitted = Letterbox.fit(size, canvas_px=canvas, centred=centred)
    there = fitted.to_canvas(np.array([box]))
    np.testing.assert_allclose(fitted.to_picture(there), [box], atol=1e-6)
    whole = fitted.to_canvas(np.array([[0.0, 0.0, *size]]))[0]
    assert whole[0] >= 0.0
    assert whole[1] >= 0.0
    assert whole[2] <= canvas[0] + 1e-9
    assert whole[3] <= canvas[1] + 1e-9
    # Nothing larger would have fitted.
    assert max((whole[2] - whole[0]) / canvas[0], (whole[3] - whole[1]) / canvas[1]) > 0.9


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
    wanted = fitted.to_canvas(np.array([[200.0, 120.0, 440.0, 240.0]]))[0]
    np.testing.assert_allclose(seen, wanted, atol=0.51)


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
