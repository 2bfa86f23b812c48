import numpy as np
import pytest

from sightline.simulation import Harbour, HarbourSettings, Look, Renderer, SimulatedCamera

SIZE = (640, 360)
PLAIN = Look(wakes=False, reflections=False, sensor_noise=False)
CAMERA = SimulatedCamera(4.5, 1.0, 1.2, 70.0, 470.0, k1=-0.2, k2=0.03, image_size_px=SIZE)


@pytest.fixture(scope="module")
def harbour() -> Harbour:
    return Harbour.random(8, HarbourSettings(duration_s=60.0, camera=CAMERA, gulls=0, piles=False))


@pytest.fixture(scope="module")
def renderer(harbour: Harbour) -> Renderer:
    return Renderer(harbour, PLAIN)


@pytest.fixture(scope="module")
def empty(harbour: Harbour) -> Renderer:
    nobody = Harbour(harbour.camera, harbour.plane, (), duration_s=60.0, seed=harbour.seed)
    return Renderer(nobody, PLAIN)


@pytest.mark.slow
def test_the_pixels_of_boats_fill_their_projected_boxes_and_no_more(
    harbour: Harbour, renderer: Renderer, empty: Renderer
) -> None:
    filled = 0
    for time_s in (5.0, 20.0, 35.0, 50.0):
        now = harbour.start_utc_s + time_s
        changed = (renderer.image(now) != empty.image(now)).any(axis=2)
        outlines = np.concatenate([harbour.outlines_px(boat, [now]) for boat in harbour.boats])
        allowed = np.zeros_like(changed)
        for x1, y1, x2, y2 in outlines[np.isfinite(outlines).all(axis=1)]:
            left, top = max(int(np.floor(x1)) - 1, 0), max(int(np.floor(y1)) - 1, 0)
            allowed[top : max(int(np.ceil(y2)) + 1, 0), left : max(int(np.ceil(x2)) + 1, 0)] = True
        assert not (changed & ~allowed).any()
        for box in harbour.boxes([now], of="all").xyxy_px:
            x1, y1, x2, y2 = np.round(box).astype(int)
            inside = changed[y1:y2, x1:x2]
            if inside.size < 60 or x1 == 0 or x2 >= SIZE[0]:
                continue
            rows, columns = np.nonzero(inside)
            # Within a pixel of each edge something is drawn.
            assert rows.min() <= 1
            assert rows.max() >= inside.shape[0] - 2
            assert columns.min() <= 1
            assert columns.max() >= inside.shape[1] - 2
            filled += 1
    assert filled >= 10


def test_the_horizon_divides_sky_and_water(harbour: Harbour, empty: Renderer) -> None:
    one = empty.image(harbour.start_utc_s + 1.0).astype(int)
    later = empty.image(harbour.start_utc_s + 2.5).astype(int)
    columns = np.arange(20, 620, 40)
    rows = harbour.camera.horizon_px(columns)
    assert np.isfinite(rows).all()
    moved = np.abs(one - later).max(axis=2) > 0
    for column, row in zip(columns, rows, strict=True):
        assert not moved[: int(row) - 1, column].any()
        assert moved[int(row) + 15 :, column].mean() > 0.5
        # The sky is bluer and brighter than the water before the camera.
        assert one[5, column, 0] > one[-5, column, 0]


@pytest.mark.slow
def test_the_same_time_gives_the_same_picture_and_water_moves(harbour: Harbour) -> None:
    first, second = Renderer(harbour), Renderer(harbour)
    now = harbour.start_utc_s + 12.3
    np.testing.assert_array_equal(first.image(now), second.image(now))
    assert first.image(now).shape == (360, 640, 3)
    assert (first.image(now) != first.image(now + 0.5)).mean() > 0.3


def test_a_post_stands_before_everything(harbour: Harbour) -> None:
    posted = Harbour.random(8, HarbourSettings(duration_s=60.0, camera=CAMERA, gulls=0))
    post = posted.piles[1]
    pixels = posted.camera.project([post.east_m, post.north_m, 0.5 * post.top_m])
    x, y = pixels.astype(int)
    renderer = Renderer(posted, PLAIN)
    seen = {tuple(renderer.image(posted.start_utc_s + t)[y, x].tolist()) for t in range(0, 60, 4)}
    assert len(seen) == 1


def test_wakes_trail_behind_moving_boats(harbour: Harbour, renderer: Renderer) -> None:
    foaming = Renderer(harbour, Look(wakes=True, reflections=False, sensor_noise=False))
    brighter = []
    for time_s in (15.0, 30.0, 45.0):
        now = harbour.start_utc_s + time_s
        change = foaming.image(now).astype(int) - renderer.image(now).astype(int)
        truth = harbour.truth([now - 2.0])
        x, y = harbour.camera.project([truth.east_m[0], truth.north_m[0], 0.0])
        if 5 < x < SIZE[0] - 5:
            brighter.append(change[int(y) - 3 : int(y) + 4, int(x) - 4 : int(x) + 5].max())
    assert len(brighter) >= 2
    assert max(brighter) > 15
