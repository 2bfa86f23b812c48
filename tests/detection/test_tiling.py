from __future__ import annotations

import numpy as np
import pytest

from sightline.detection.tiling import Tile, TilingSettings, merge, plan_tiles
from sightline.errors import InputError

FRAME = (1280, 720)
LEVEL = (410.0, 414.0)


def covered(views: tuple[Tile, ...], scale: float) -> np.ndarray:
    """(H, W) how many views of this scale or finer show a pixel."""
    count = np.zeros(FRAME[::-1], int)
    for view in views:
        if view.scale >= scale:
            count[view.y : view.y + view.height, view.x : view.x + view.width] += 1
    return count


def test_a_strip_is_native_at_the_horizon_and_scaled_below() -> None:
    strip, near = plan_tiles(FRAME, TilingSettings(), horizon_px=LEVEL)
    assert (strip.x, strip.width, strip.scale) == (0, 1280, 1.0)
    assert strip.y == 370
    assert strip.height % 32 == 0
    assert strip.y + strip.height >= 414 + 180
    assert (near.x, near.width, near.scale) == (0, 1280, 0.25)
    assert (near.y, near.y + near.height) == (370, 720)
    assert strip.searched_px + near.searched_px < 0.35e6


def test_larger_frames_are_looked_at_as_if_they_were_scaled_down() -> None:
    small = plan_tiles(FRAME, TilingSettings(), horizon_px=LEVEL)
    large = plan_tiles((3840, 2160), TilingSettings(), horizon_px=(1230.0, 1242.0))
    for one, other in zip(small, large, strict=True):
        assert other.scale == pytest.approx(one.scale / 3)
        assert other.searched_px == pytest.approx(one.searched_px, rel=0.01)


def test_a_network_of_one_size_gets_tiles_that_cover_the_strip_and_the_whole_frame() -> None:
    views = plan_tiles(FRAME, TilingSettings(), horizon_px=LEVEL, input_px=(352, 352))
    tiles, whole = views[:-1], views[-1]
    assert len(tiles) == 4
    assert all((tile.width, tile.height, tile.scale) == (352, 352, 1.0) for tile in tiles)
    assert (covered(views, 1.0)[370:594] >= 1).all()
    assert whole == Tile(0, 0, 1280, 720, 352 / 1280)


@pytest.mark.parametrize("side", [320, 352, 416, 640, 1024, 2000])
def test_tiles_cover_every_pixel_and_stay_inside(side: int) -> None:
    views = plan_tiles(FRAME, TilingSettings(kind="tiles"), input_px=(side, side))
    assert (covered(views, 0.999) >= 1).all()
    for view in views:
        assert view.x >= 0
        assert view.y >= 0
        assert view.x + view.width <= 1280
        assert view.y + view.height <= 720


@pytest.mark.parametrize("rows", [(-500.0, -480.0), (0.0, 30.0), (700.0, 719.0), (900.0, 950.0)])
@pytest.mark.parametrize("size", [None, (352, 352)])
def test_a_horizon_outside_the_frame_leaves_something_to_look_at(
    rows: tuple[float, float], size: tuple[int, int] | None
) -> None:
    for view in plan_tiles(FRAME, TilingSettings(), horizon_px=rows, input_px=size):
        assert view.width > 0
        assert view.height > 0
        assert 0 <= view.y < view.y + view.height <= 720


def test_without_a_horizon_all_of_the_frame_is_looked_at_as_it_is() -> None:
    assert plan_tiles(FRAME, TilingSettings()) == (Tile(0, 0, 1280, 720, 1.0),)


def test_the_whole_frame_alone() -> None:
    settings = TilingSettings(kind="whole")
    assert plan_tiles(FRAME, settings) == (Tile(0, 0, 1280, 720, 0.5),)
    assert plan_tiles(FRAME, settings, input_px=(320, 320)) == (Tile(0, 0, 1280, 720, 0.25),)


LEFT, RIGHT = Tile(0, 0, 700, 720, 1.0), Tile(580, 0, 700, 720, 1.0)


def kept(rows: list[tuple[list[float], float, int, int]], views: tuple[Tile, ...]) -> list[int]:
    """Which of (box, score, view, label) stay."""
    boxes, score, view, label = zip(*rows, strict=True)
    stays = merge(
        views, FRAME, np.array(boxes, float), np.array(score), np.array(view), np.array(label)
    )
    return np.flatnonzero(stays).tolist()


def test_a_box_cut_off_at_an_inner_edge_goes_where_another_view_has_the_whole() -> None:
    half, whole = [660.0, 400, 700, 430], [660.0, 400, 740, 430]
    assert kept([(half, 0.9, 0, 0), (whole, 0.5, 1, 0)], (LEFT, RIGHT)) == [1]
    # Nobody else has it, it is of another class, or of something else.
    assert kept([(half, 0.9, 0, 0)], (LEFT, RIGHT)) == [0]
    assert kept([(half, 0.9, 0, 0), (whole, 0.5, 1, 1)], (LEFT, RIGHT)) == [0, 1]
    assert kept([(half, 0.9, 0, 0), ([800.0, 400, 840, 430], 0.5, 1, 0)], (LEFT, RIGHT)) == [0, 1]


def test_the_edge_of_the_frame_cuts_nothing_off() -> None:
    at_edge, longer = [1240.0, 400, 1280, 430], [1180.0, 400, 1279, 440]
    assert kept([(at_edge, 0.9, 1, 0), (longer, 0.5, 0, 0)], (LEFT, Tile(0, 0, *FRAME, 0.5))) == [
        0,
        1,
    ]


def test_of_a_box_in_two_views_the_best_stays_and_neighbours_do_too() -> None:
    rows = [
        ([600.0, 400, 640, 430], 0.6, 0, 0),
        ([602.0, 401, 642, 431], 0.8, 1, 0),
        ([640.0, 400, 680, 430], 0.5, 1, 0),
        # Overlaps, but of the same view: that view's own suppression has let it be.
        ([622.0, 401, 662, 431], 0.4, 1, 0),
    ]
    assert kept(rows, (LEFT, RIGHT)) == [1, 2, 3]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "bands"}, "unknown kind of views 'bands'; known are strip, tiles, whole"),
        ({"near_scale": 2.0}, "near_scale between 0 and 1"),
        ({"frame_width_px": 0}, "sizes must be positive"),
        ({"above_px": -300.0}, "sizes must be positive"),
    ],
)
def test_settings_that_make_no_sense_are_refused(values: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        TilingSettings(**values)
