"""Areas against closed forms and another way of counting."""

from __future__ import annotations

import matplotlib.path
import numpy as np
import pytest

from sightline.area import Area, Polygon
from sightline.errors import InputError


def polygon(*rings: list[tuple[float, float]]) -> Polygon:
    return Polygon(tuple(np.array(ring, dtype=float) for ring in rings))


def box(west: float, south: float, east: float, north: float) -> list[tuple[float, float]]:
    return [(west, south), (east, south), (east, north), (west, north), (west, south)]


def inside(area: Polygon | Area, *places: tuple[float, float]) -> list[bool]:
    """Of places as longitude and latitude."""
    longitude, latitude = np.array(places, dtype=float).T
    return area.contains(latitude, longitude).tolist()


def test_a_box_holds_what_lies_between_its_sides() -> None:
    one = polygon(box(10.0, 54.0, 10.2, 54.1))
    assert inside(one, (10.1, 54.05)) == [True]
    beside = [(9.99, 54.05), (10.21, 54.05), (10.1, 53.99), (10.1, 54.11)]
    assert inside(one, *beside) == [False] * 4


def test_a_hole_is_not_in_it_and_an_island_of_another_polygon_is() -> None:
    water = polygon(box(0, 0, 10, 10), box(2, 2, 8, 8))
    pond = polygon(box(4, 4, 6, 6))
    assert inside(water, (1, 1), (3, 3), (5, 5)) == [True, False, False]
    assert inside(Area((water, pond)), (1, 1), (3, 3), (5, 5)) == [True, False, True]


def test_places_that_are_not_known_are_not_in_it() -> None:
    area = Area((polygon(box(0, 0, 10, 10)),))
    assert area.contains([5.0, np.nan, 5.0], [5.0, 5.0, np.nan]).tolist() == [True, False, False]
    assert area.contains([], []).tolist() == []


@pytest.mark.parametrize("shift", [0.0, 179.0, -179.0])
@pytest.mark.parametrize("seed", range(3))
def test_any_outline_is_the_same_as_in_the_plane(seed: int, shift: float) -> None:
    """A star of random corners, also across 180 degrees, against matplotlib's counting."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    reach = rng.uniform(0.5, 4.0, 60)
    flat = np.column_stack([reach * np.cos(angle), reach * np.sin(angle)])
    wrapped = flat + np.array([shift, 0.0])
    wrapped[:, 0] = (wrapped[:, 0] + 180.0) % 360.0 - 180.0
    places = rng.uniform(-4.5, 4.5, (2000, 2))
    expected = matplotlib.path.Path(flat).contains_points(places)
    longitude = (places[:, 0] + shift + 180.0) % 360.0 - 180.0
    found = Polygon((wrapped,)).contains(places[:, 1], longitude)
    np.testing.assert_array_equal(found, expected)


def test_a_hole_across_180_degrees_is_cut_out_wherever_it_is_written() -> None:
    strait = polygon(box(178, 50, -178, 52), box(-179.5, 50.5, -179.0, 51.5))
    assert inside(strait, (179, 51), (-178.5, 51), (-179.2, 51), (0, 51), (177, 51)) == [
        True, True, False, False, False,
    ]  # fmt: skip


def test_a_box_of_all_the_earth_holds_all() -> None:
    earth = polygon(box(-180, -90, 180, 90))
    assert inside(earth, (0, 0), (179.9, 80), (-179.9, -80), (10.1, 54.3)) == [True] * 4


@pytest.mark.parametrize(
    ("rings", "message"),
    [
        (([(0, 0), (10, 10), (10, 0), (0, 10)],), "edges cross at longitude 5.0+, latitude 5.0+"),
        ((box(0, 0, 10, 10), box(5, 5, 15, 8)), "edges cross at longitude 10.0+, latitude 5.0+"),
        (([(179, 0), (-179, 2), (-179, 0), (179, 2)],), "edges cross at longitude -?180.0+"),
        (([(0, 0), (190, 0), (10, 10)],), "longitude 190, latitude 0, which is not on the earth"),
        (([(0, 0), (1, 91), (10, 10)],), "longitude 1, latitude 91, which is not on the earth"),
        ((box(0, 0, 10, 10), box(1, 1, 2, 95)), "its hole 1 has a corner at longitude 2, lat.* 95"),
        (([(477_000.0, 3_618_000.0)] * 4,), "not on the earth; give degrees, WGS 84, longitude"),
        (([(0, 0), (1, 1)],), "its outline has fewer than three corners"),
        (([(0, 0), (1, 1), (2, 2)],), "its outline has no area"),
        (([(0, 80), (120, 80), (-120, 80)],), "its outline goes around a pole; cut it in two"),
        (([(0, 0), (1, float("nan")), (2, 2)],), "a corner that is no longitude and latitude"),
        ((), "has no outline"),
    ],
)  # fmt: skip
def test_polygons_that_cannot_be_used_say_why(rings: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        polygon(*rings)


def test_to_touch_is_not_to_cross() -> None:
    """Two bays that meet in a point, and a pier of no width."""
    bays = polygon([(0, 0), (4, 0), (2, 2), (4, 4), (0, 4), (2, 2)])
    assert inside(bays, (2, 1), (2, 3), (1, 2), (3, 2)) == [True, True, False, False]
    pier = polygon([(0, 0), (2, 0), (2, 1), (2, 0), (4, 0), (4, 4), (0, 4)])
    assert inside(pier, (1, 1), (3, 1)) == [True, True]


def test_a_coast_of_many_corners_is_looked_at_at_once() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 20_000, endpoint=False)
    reach = 1.0 + 0.2 * np.sin(700.0 * angle)
    coast = Polygon((np.column_stack([reach * np.cos(angle), reach * np.sin(angle)]),))
    assert inside(coast, (0.0, 0.0), (0.79, 0.0), (1.3, 0.0)) == [True, True, False]
