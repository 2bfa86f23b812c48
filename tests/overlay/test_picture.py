"""Pixels of pictures: boxes, ellipses, trails and the map are where the numbers say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scene import SEA, SIGMA_M, SIZE_PX, START_S, box_at, model, pixel, sea, track
from sightline.errors import InputError
from sightline.overlay import Found, Overlay, OverlaySettings
from sightline.overlay.style import WHITE, colour_of, drawable
from sightline.overlay.targets import Targets, box_of_each
from sightline.types import Boxes, Fixes, Frame
from sightline.video.mask import GREY, Mask

BARE = OverlaySettings(trail_s=0.0, horizon=False, inset=False, labels=False)
CHI = np.sqrt(5.991464547)


def draw(found: Found, settings: OverlaySettings = BARE, at_s: float = 5.0) -> np.ndarray:
    frame = Frame(0, START_S + at_s, sea())
    return Overlay(model(), found, settings).drawn(frame)


def has(image: np.ndarray, colour: tuple[int, int, int], within: int = 40) -> np.ndarray:
    """(H, W) whether a pixel is of a colour."""
    return np.abs(image.astype(int) - colour).max(axis=2) <= within


def test_a_box_is_drawn_on_its_edges_and_nowhere_else() -> None:
    here = pixel(0.0, 105.0)
    # With edges on the middles of pixels, which are then painted in full.
    boxes = box_at(np.floor(here) + 0.5, (60.0, 50.0))
    one = replace(track(), covariance_m2=np.full((11, 2, 2), np.nan))
    image = draw(Found([one], boxes))
    x1, y1, x2, y2 = boxes.xyxy_px[0]
    painted = has(image, colour_of(3))
    rows, columns = np.nonzero(painted)
    # A pixel's middle lies half a pixel behind its number. The dot lies on the lower edge.
    near = np.hypot(columns + 0.5 - here[0], rows + 0.5 - here[1]) > 5.0
    rows, columns = rows[near] + 0.5, columns[near] + 0.5
    off = np.min(np.abs([columns - x1, columns - x2, rows - y1, rows - y2]), axis=0)
    assert off.max() <= 1.5
    assert columns.min() == pytest.approx(x1, abs=1.5)
    assert columns.max() == pytest.approx(x2, abs=1.5)
    assert rows.min() == pytest.approx(y1, abs=1.5)
    assert rows.max() == pytest.approx(y2, abs=1.5)
    assert (image[:, : int(x1) - 4] == SEA).all()
    assert (image[int(y2) + 8 :] == SEA).all()


def test_an_ellipse_is_drawn_where_it_lies_on_the_water() -> None:
    image = draw(Found([track()]))
    rows, columns = np.nonzero(has(image, colour_of(3)))
    foot = pixel(0.0, 105.0)
    outline = np.hypot(columns + 0.5 - foot[0], rows + 0.5 - foot[1]) > 5.0
    columns, rows = columns[outline] + 0.5, rows[outline] + 0.5
    # Each painted pixel lies within two of the closed form.
    angles = np.linspace(0.0, 2.0 * np.pi, 2000)
    true = np.stack(
        pixel(
            CHI * SIGMA_M[0] * np.cos(angles),  # type: ignore[arg-type]
            105.0 + CHI * SIGMA_M[1] * np.sin(angles),  # type: ignore[arg-type]
        ),
        axis=1,
    )
    apart = np.hypot(columns[:, None] - true[:, 0], rows[:, None] - true[:, 1])
    assert apart.min(axis=1).max() < 2.0
    # And all of the closed form is painted.
    assert apart.min(axis=0).max() < 2.0


def test_a_place_between_two_points_is_on_the_way_between_them() -> None:
    (target,) = Targets([track(apart_s=5.0)]).at(START_S + 2.5)
    np.testing.assert_allclose(target.east_north_m, [-5.0, 102.5], atol=1e-9)
    assert Targets([track()]).at(START_S + 10.5) == []
    assert Targets([track()]).at(START_S - 0.5) == []
    # A file keeps milliseconds, a frame more.
    assert len(Targets([track()]).at(START_S - 0.001)) == 1


def test_a_target_that_turns_stays_on_its_circle_between_two_points() -> None:
    lags = np.array([0.0, 6.0])
    angle, radius = 0.1 * lags, 40.0
    one = replace(
        track()[:2],
        time_utc_s=START_S + lags,
        east_m=radius * np.sin(angle),
        north_m=200.0 + radius * np.cos(angle),
        velocity_east_mps=0.1 * radius * np.cos(angle),
        velocity_north_mps=-0.1 * radius * np.sin(angle),
    )
    (target,) = Targets([one]).at(START_S + 3.0)
    assert np.hypot(target.east_north_m[0], target.east_north_m[1] - 200.0) == pytest.approx(
        radius, abs=0.05
    )


def test_each_box_is_of_the_target_whose_place_is_at_its_foot() -> None:
    feet = np.array([[100.0, 200.0], [140.0, 205.0], [400.0, 300.0], [np.nan, np.nan]])
    boxes = Boxes.concatenate(
        [box_at(np.array(foot)) for foot in ([138.0, 206.0], [101.0, 199.0], [300.0, 200.0])]
    )
    rows, free = box_of_each(feet, boxes, [1, 2, 3, 4], 1.0)
    assert rows == [1, 0, None, None]
    assert free.tolist() == [False, False, True]


def test_a_trail_is_drawn_for_as_long_as_is_asked_for() -> None:
    settings = replace(BARE, trail_s=3.0)
    one = replace(track(), covariance_m2=np.full((11, 2, 2), np.nan))
    painted = has(draw(Found([one]), settings), colour_of(3))
    columns = np.nonzero(painted)[1]
    assert columns.min() == pytest.approx(pixel(-6.0, 102.0)[0], abs=2.0)
    assert columns.max() == pytest.approx(pixel(0.0, 105.0)[0], abs=5.0)


def test_the_log_is_drawn_at_its_place_with_the_error_that_is_stated() -> None:
    plane = model().plane
    north = np.array([100.0, 120.0])
    latitude, longitude = plane.to_geographic(np.zeros(2), north)
    fixes = Fixes(np.array([START_S, START_S + 8.0]), latitude, longitude)
    settings = replace(BARE, fixes_sigma_m=4.0, clock_offset_s=1.0)
    # By the log's clock it is four seconds: half of the way.
    painted = has(draw(Found(fixes=fixes), settings, at_s=5.0), WHITE, 110)
    rows, columns = np.nonzero(painted)
    right = pixel(CHI * 4.0, 110.0)[0]
    assert columns.max() + 0.5 == pytest.approx(right, abs=3.0)
    assert np.median(columns) == pytest.approx(320.0, abs=3.0)
    assert painted[int(pixel(0.0, 110.0)[1]) - 1 : int(pixel(0.0, 110.0)[1]) + 2, 318:322].any()
    assert rows.min() >= int(pixel(0.0, 110.0 + CHI * 4.0)[1]) - 7


def test_the_horizon_is_drawn_on_its_row() -> None:
    image = draw(Found(), replace(BARE, horizon=True))
    paint = np.abs(image.astype(float) - SEA).sum(axis=(1, 2))
    rows = np.arange(SIZE_PX[1]) + 0.5
    assert paint @ rows / paint.sum() == pytest.approx(180.0, abs=0.3)
    assert set(np.flatnonzero(paint).tolist()) <= {178, 179, 180, 181}


def test_the_map_has_north_up_and_the_target_at_its_place() -> None:
    settings = replace(BARE, inset=True)
    overlay = Overlay(model(), Found([track()]), settings)
    image = overlay.drawn(Frame(0, START_S + 5.0, sea()))
    inset = overlay.inset
    assert inset is not None
    places = np.array([[0.0, 0.0], [0.0, 100.0], [50.0, 100.0]])
    camera, ahead, aside = inset.to_picture_px(places)
    assert ahead[1] < camera[1]
    assert ahead[0] == pytest.approx(camera[0])
    assert aside[0] > ahead[0]
    # The same metres east and north are the same pixels.
    assert aside[0] - ahead[0] == pytest.approx((camera[1] - ahead[1]) / 2.0)
    x, y = inset.to_picture_px(np.array([[0.0, 105.0]]))[0]
    assert has(image, colour_of(3), 70)[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2].any()
    left, top, right, bottom = (int(edge) for edge in inset.bounds_px)
    assert 0 < left < right < SIZE_PX[0]
    assert (image[bottom + 2 :, :left] != SEA).any()
    assert top > 0


def test_what_is_masked_is_painted_over() -> None:
    hidden = np.zeros((SIZE_PX[1], SIZE_PX[0]), dtype=bool)
    hidden[:50, 300:] = True
    image = draw(Found(mask=Mask(hidden)))
    assert (image[:50, 300:] == GREY).all()
    assert (image[60:] == SEA).all()


def test_the_frame_that_is_given_stays_as_it_is() -> None:
    frame = Frame(0, START_S + 5.0, sea())
    Overlay(model(), Found([track()])).drawn(frame)
    assert (frame.image_bgr == SEA).all()


def test_a_picture_with_everything_is_drawn_for_labels_of_any_kind() -> None:
    tracks = [
        track(1, label="Fähre \x1b[31m\n\u202e"),
        track(2, start=(-12.0, 100.0), moored=True),
        track(4, label="船" * 400),
        track(5, start=(-10.0, -300.0)),
        track(6, start=(-1e7, 1e7)),
    ]
    settings = OverlaySettings(rings=True, grid=True)
    assert (draw(Found(tracks), settings) != SEA).any()


def test_texts_are_drawn_in_letters_that_there_are() -> None:
    assert drawable("Fähre Ålesund ß") == "Fahre Alesund ss"
    assert drawable("a\x1b[31mb\nc\u202ed") == "a?[31mb c?d"
    assert drawable("船") == "?"
    assert len(drawable("x" * 100)) <= 30


def test_colours_of_tracks_can_be_told_apart() -> None:
    colours = [colour_of(number) for number in range(6)]
    assert len(set(colours)) == 6
    assert colour_of(7) == colours[1]


def test_models_without_a_camera_that_stands_still_are_refused() -> None:
    with pytest.raises(InputError, match="knows no camera"):
        Overlay(model(camera=None), Found())
    with pytest.raises(InputError, match="moves"):
        Overlay(model(moving=True), Found())
