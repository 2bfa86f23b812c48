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


def test_larger_frames_are_looked_at_as_they_are() -> None:
    """The strip reaches as far up and down the picture as in a smaller one."""
    strip, near = plan_tiles((3840, 2160), TilingSettings(), horizon_px=(1230.0, 1242.0))
    assert (strip.width, strip.scale, near.scale) == (3840, 1.0, 0.25)
    assert strip.y == 1230 - 3 * 40
    assert 1242 + 3 * 180 <= strip.y + strip.height < 1242 + 3 * 180 + 32
    assert (near.y, near.y + near.height) == (strip.y, 2160)


@pytest.mark.parametrize("kind", ["strip", "tiles"])
def test_larger_frames_may_be_looked_at_as_if_they_were_scaled_down(kind: str) -> None:
    settings = TilingSettings(kind=kind, frame_width_px=1280)
    small = plan_tiles(FRAME, settings, horizon_px=LEVEL)
    large = plan_tiles((3840, 2160), settings, horizon_px=(1230.0, 1242.0))
    for one, other in zip(small, large, strict=True):
        assert other.scale == pytest.approx(one.scale / 3)
        assert other.searched_px == pytest.approx(one.searched_px, rel=0.01)


@pytest.mark.parametrize("width", [640, 1280])
def test_frames_that_are_not_larger_are_looked_at_as_ever(width: int) -> None:
    frame_px = (width, 720)
    for kind in ("strip", "tiles", "whole"):
        for size in (None, (352, 352)):
            now, then = (
                plan_tiles(frame_px, settings, horizon_px=LEVEL, input_px=size)
                for settings in (
                    TilingSettings(kind=kind),
                    TilingSettings(kind=kind, frame_width_px=1280, overlap=0.1, enlarge=1.0),
                )
            )
            assert now == then


@pytest.mark.parametrize("size", [None, (416, 416), (640, 352)])
@pytest.mark.parametrize("frame_px", [(1920, 1080), (1280, 720), (448, 300), (5000, 3000)])
def test_everywhere_is_looked_enlarged_and_what_no_tile_has_whole_is_in_a_coarser_one(
    size: tuple[int, int] | None, frame_px: tuple[int, int]
) -> None:
    views = plan_tiles(frame_px, TilingSettings(kind="everywhere"), horizon_px=LEVEL, input_px=size)
    # Whole in a tile of the next coarser scale is what is smaller than the overlap of two there.
    least_px = 0.2 * min(size or (2048, 2048)) / (3.0 * 1.4)
    rng = np.random.default_rng(0)
    for _ in range(300):
        side = float(np.exp(rng.uniform(np.log(8.0), np.log(min(frame_px)))))
        x, y = rng.uniform(0.0, np.array(frame_px) - side)
        whole = [
            view.scale * side
            for view in views
            if view.x <= x
            and view.y <= y
            and view.x + view.width >= x + side
            and view.y + view.height >= y + side
        ]
        assert max(whole) >= min(1.5 * side, least_px)
    assert max(view.scale for view in views) == 1.5
    for view in views:
        assert view.x >= 0
        assert view.y >= 0
        assert view.x + view.width <= frame_px[0]
        assert view.y + view.height <= frame_px[1]


def test_a_frame_may_be_enlarged_by_any_factor() -> None:
    strip, near = plan_tiles(FRAME, TilingSettings(enlarge=2.0), horizon_px=LEVEL)
    assert (strip.y, strip.scale, near.scale) == (370, 2.0, 0.5)
    assert 414 + 180 <= strip.y + strip.height < 414 + 180 + 32
    views = plan_tiles(FRAME, TilingSettings("everywhere", enlarge=3.0), input_px=(416, 416))
    assert views[0].scale == 3.0


def test_what_would_not_fit_into_memory_comes_in_parts() -> None:
    views = plan_tiles((3840, 2160), TilingSettings(enlarge=4.0))
    assert max(view.searched_px for view in views) <= 2048**2
    assert sum(view.searched_px for view in views) >= 16 * 3840 * 2160


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
        (
            {"kind": "bands"},
            "unknown kind of views 'bands'; known are strip, tiles, whole, everywhere",
        ),
        ({"near_scale": 2.0}, "near_scale between 0 and 1"),
        ({"frame_width_px": 0}, "sizes must be positive"),
        ({"above_px": -300.0}, "sizes must be positive"),
        ({"overlap": 0.95}, "overlap between 0 and 0.9"),
        ({"enlarge": 0.0}, "enlarge is 0; it must be more than 0 and at most 8"),
        ({"enlarge": float("nan")}, "enlarge is nan"),
        ({"enlarge": 9.0}, "enlarge is 9; it must be"),
    ],
)
def test_settings_that_make_no_sense_are_refused(values: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        TilingSettings(**values)
