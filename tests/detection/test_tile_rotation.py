"""Tiles in turn: what is known of a frame of which only a part was looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from sightline.detection import DetectorOptions, OnnxDetector, Tile, TilingSettings
from sightline.detection.rotation import Found, TileRotation
from sightline.detection.tiling import plan_tiles
from sightline.errors import InputError
from sightline.types import Frame

MakeFile = Callable[..., Path]
Square = tuple[int, int]

FRAME = (1920, 1080)
WIDTH, HEIGHT = 24, 14
TILES = plan_tiles(FRAME, TilingSettings(kind="everywhere"), input_px=(416, 416))
STILL: list[Square] = [(100, 520), (900, 560), (1700, 900), (400, 120)]


def picture(squares: list[Square], seed: int, light: int = 0) -> np.ndarray:
    """White squares on a grey sea that is never the same."""
    rng = np.random.default_rng(seed)
    rough = rng.normal(90.0, 12.0, (FRAME[1] // 4, FRAME[0] // 4)).astype(np.float32)
    image = cv2.resize(rough, FRAME, interpolation=cv2.INTER_LINEAR)
    for x, y in squares:
        image[y : y + HEIGHT, x : x + WIDTH] = 230.0
    return np.repeat(np.clip(image + light, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def seen_in(tile: Tile, squares: list[Square]) -> Found:
    """What a perfect network finds: all that is whole in a tile, and large enough."""
    boxes = [
        (x, y, x + WIDTH, y + HEIGHT)
        for x, y in squares
        if tile.x <= x
        and tile.y <= y
        and x + WIDTH <= tile.x + tile.width
        and y + HEIGHT <= tile.y + tile.height
        and HEIGHT * tile.scale >= 8
    ]
    count = len(boxes)
    return Found(
        np.array(boxes, float).reshape(-1, 4), np.full(count, 0.5), np.zeros(count, np.int64)
    )


def walk(
    frames: list[list[Square]], most: int, band: tuple[float, float] | None = None, light: int = 0
) -> Iterator[tuple[list[int], set[Square]]]:
    """Tiles that were looked at in each frame, and the squares that are known after it."""
    rotation = TileRotation(TILES, FRAME)
    rotation.set_band(band)
    for number, squares in enumerate(frames):
        image = picture(squares, number, light * (number > len(frames) // 2))
        chosen = rotation.choose(image, 1e9 + number / 25.0, most)
        known = rotation.merge({i: seen_in(TILES[i], squares) for i in chosen})
        places = np.concatenate([one.xyxy_px[:, :2] for one in known.values()])
        yield chosen, {(int(x), int(y)) for x, y in places}


def test_what_stands_still_is_known_in_every_frame_and_what_moves_is_where_it_is() -> None:
    """Of 47 tiles three a frame; a boat of 24 px goes 5 px a frame, across all of the picture."""
    frames = [[*STILL, (40 + 5 * i, 640)] for i in range(60)]
    for number, (chosen, known) in enumerate(walk(frames, 3)):
        assert len(chosen) == (len(TILES) if number == 0 else 3)
        assert set(STILL) <= known, number
        moving = known - set(STILL)
        # At its start it is part of what is taken for the sea.
        if number > 2:
            assert moving <= {(40 + 5 * i, 640) for i in (number - 1, number)}, number
            assert (40 + 5 * number, 640) in moving, number


def test_all_tiles_are_looked_at_in_turn_and_the_band_more_often() -> None:
    times = np.zeros(len(TILES), int)
    for chosen, _ in list(walk([STILL] * 60, 3, band=(500.0, 640.0)))[1:]:
        times[chosen] += 1
    assert times.min() >= 1
    inside = np.array([tile.y < 640 and tile.y + tile.height > 500 for tile in TILES])
    fine = np.array([tile.scale == 1.5 for tile in TILES])
    assert times[fine & inside].min() > times[fine & ~inside].max()


@pytest.mark.parametrize("most", [1, 2, 5])
def test_what_appears_is_seen_and_what_has_gone_is_forgotten(most: int) -> None:
    here, there = (1000, 300), (1300, 800)
    frames = [[*STILL, here]] * 12 + [[*STILL, there]] * 12
    known = [squares for _, squares in walk(frames, most)]
    assert here in known[11]
    assert here not in known[12]
    # With one tile a frame every other one is for what does not move.
    assert there in known[14 if most > 1 else 18]
    assert known[-1] == {*STILL, there}


def test_a_cloud_before_the_sun_makes_nothing_forgotten() -> None:
    for _, known in walk([STILL] * 20, 2, light=30):
        assert known == set(STILL)


def test_where_everything_moves_everything_is_looked_at_all_the_same() -> None:
    """A camera that shakes: more moves than there is time for."""
    rng = np.random.default_rng(3)
    rotation = TileRotation(TILES, FRAME)
    times = np.zeros(len(TILES), int)
    for _ in range(120):
        image = rng.integers(0, 255, (54, 96, 3), dtype=np.uint8)
        image = cv2.resize(image, FRAME, interpolation=cv2.INTER_NEAREST)
        chosen = rotation.choose(image, float("nan"), 2)
        times[chosen] += 1
        rotation.merge({i: seen_in(TILES[i], STILL) for i in chosen})
    assert times.min() >= 2


def test_with_time_for_all_tiles_all_are_looked_at() -> None:
    for chosen, known in walk([STILL] * 3, len(TILES)):
        assert chosen == list(range(len(TILES)))
        assert known == set(STILL)


def own_metadata() -> dict[str, str]:
    return {
        "sightline": '{"format": 1, "decoder": "yolov8", "classes": ["light"], '
        '"input": {"scale": 0.00392156862745098, "pad": 0, "stride": 8}}'
    }


def still_frames(count: int) -> Iterator[Frame]:
    for number in range(count):
        yield Frame(number, 1e9 + number / 25.0, picture(STILL, seed=0))


def test_a_detector_knows_of_a_still_picture_what_it_knows_of_all_its_tiles(
    bright_cells_file: MakeFile,
) -> None:
    file = bright_cells_file(shape=("batch", 3, 416, 416), metadata=own_metadata())
    views = TilingSettings(kind="everywhere")
    whole = OnnxDetector(file, options=DetectorOptions(threshold=0.8, views=views))
    turns = OnnxDetector(file, options=DetectorOptions(threshold=0.8, tiles_per_frame=2))
    assert turns.remembers
    assert not whole.remembers
    for frame in still_frames(4):
        expected, boxes = whole.detect(frame), turns.detect(frame)
        assert len(expected) >= len(STILL)
        np.testing.assert_allclose(boxes.xyxy_px, expected.xyxy_px)
        np.testing.assert_allclose(boxes.confidence, expected.confidence, atol=1e-6)
        assert boxes.frame.tolist() == [frame.index] * len(boxes)
    assert turns.tiles_per_frame == 2


def test_a_budget_is_measured_once_and_bounds_the_tiles(bright_cells_file: MakeFile) -> None:
    file = bright_cells_file(metadata=own_metadata())
    little = OnnxDetector(file, options=DetectorOptions(threshold=0.8, budget_ms=0.001))
    much = OnnxDetector(file, options=DetectorOptions(threshold=0.8, budget_ms=1e6))
    for detector in (little, much):
        assert detector.tiles_per_frame is None
        found = [detector.detect(frame) for frame in still_frames(3)]
        assert all(len(boxes) for boxes in found)
        detector.reset()
        detector.detect(next(still_frames(1)))
    assert little.tiles_per_frame == 1
    (frame,) = still_frames(1)
    assert much.tiles_per_frame == len(much.views(frame))
    # Of a network that takes any size as well, or there would be nothing to choose from.
    assert len(much.views(frame)) > 20


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"budget_ms": 0.0}, "budget is 0 ms; give the milliseconds that a frame may take"),
        ({"budget_ms": float("nan")}, "budget is nan ms"),
        ({"tiles_per_frame": 0}, "tiles_per_frame is 0; give 1 or more"),
        ({"enlarge": -1.0}, "enlarge is -1; it must be more than 0"),
    ],
)
def test_budgets_that_make_no_sense_are_refused(values: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        DetectorOptions(**values)
