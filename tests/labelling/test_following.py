"""A box followed through a simulated video, against the exact boxes of its boat."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from sightline import Boxes, InputError
from sightline.labelling import Drawing
from sightline.labelling.following import follow_box
from sightline.simulation import SimulationSettings, simulate
from sightline.types import Frame

pytestmark = pytest.mark.slow

RATE_HZ = 10.0
CORNERS = ["x1", "y1", "x2", "y2"]


@pytest.fixture(scope="module")
def harbour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("followed")
    settings = SimulationSettings(
        seed=2, recordings=1, duration_s=16.0, rate_hz=RATE_HZ, annotation_interval_s=4.0
    )
    simulate(folder, settings)
    text = (folder / "scene.toml").read_text(encoding="utf-8")
    (folder / "scene.toml").write_text(text.replace('boxes = "boxes/01.csv"\n', ""))
    (folder / "boxes" / "01.csv").unlink()
    return folder


@pytest.fixture(scope="module")
def truth(harbour: Path) -> dict[int, np.ndarray]:
    table = pd.read_csv(harbour / "truth-boxes" / "01.csv")
    own = table[table["track_id"] == 1]
    rows = zip(own["frame"].tolist(), own[CORNERS].to_numpy(float), strict=True)
    return dict(rows)


@pytest.fixture
def drawing(harbour: Path) -> Iterator[Drawing]:
    drawing = Drawing(harbour / "scene.toml", annotator="ada")
    try:
        yield drawing
    finally:
        drawing.close()


def frames(drawing: Drawing, numbers: range) -> Iterator[Frame]:
    for number in numbers:
        yield Frame(number, number / RATE_HZ, drawing.picture(number))


@pytest.mark.parametrize("numbers", [range(60, 101), range(100, 59, -1)], ids=["later", "earlier"])
def test_a_box_is_followed(drawing: Drawing, truth: dict[int, np.ndarray], numbers: range) -> None:
    found = list(follow_box(frames(drawing, numbers), truth[numbers[0]]))
    assert [one.frame for one in found] == list(numbers[1:])
    for one in found:
        assert_allclose(one.xyxy_px, truth[one.frame], atol=3.0)
        assert abs(one.xyxy_px[3] - truth[one.frame][3]) < 2.0
        assert 0.0 < one.confidence <= 1.0


def test_it_ends_where_the_boat_is_hidden(drawing: Drawing, truth: dict[int, np.ndarray]) -> None:
    def hidden() -> Iterator[Frame]:
        for frame in frames(drawing, range(60, 101)):
            image = frame.image_bgr.copy()
            if frame.index >= 75:
                image[:] = np.random.default_rng(frame.index).integers(90, 130, image.shape)
            yield Frame(frame.index, frame.time_utc_s, image)

    found = list(follow_box(hidden(), truth[60]))
    assert [one.frame for one in found] == list(range(61, 75))


def test_it_ends_where_the_boat_leaves_the_picture(
    drawing: Drawing, truth: dict[int, np.ndarray]
) -> None:
    """The right part of the picture is cut off, at a column that the boat passes."""
    columns = {number: box[2] for number, box in truth.items() if 60 <= number <= 100}
    cut = int(np.median(list(columns.values())))
    numbers = range(60, 101) if columns[60] < columns[100] else range(100, 59, -1)

    def narrow() -> Iterator[Frame]:
        for frame in frames(drawing, numbers):
            image = np.ascontiguousarray(frame.image_bgr[:, :cut])
            yield Frame(frame.index, frame.time_utc_s, image)

    found = list(follow_box(narrow(), truth[numbers[0]]))
    assert 5 < len(found) < 40
    assert all(truth[one.frame][2] < cut + 3.0 for one in found)


def test_it_ends_where_frames_are_far_apart(drawing: Drawing, truth: dict[int, np.ndarray]) -> None:
    def late() -> Iterator[Frame]:
        for frame in frames(drawing, range(60, 101)):
            later_s = 5.0 if frame.index >= 70 else 0.0
            yield Frame(frame.index, frame.time_utc_s + later_s, frame.image_bgr)

    assert [one.frame for one in follow_box(late(), truth[60])] == list(range(61, 70))


class Blinking:
    """A detector that sees the boat until a frame, but for single ones."""

    def __init__(self, truth: dict[int, np.ndarray], until: int, blind: tuple[int, ...]) -> None:
        self.truth, self.until, self.blind = truth, until, blind
        self.resets = 0

    def detect(self, frame: Frame) -> Boxes:
        sees = frame.index < self.until and frame.index not in self.blind
        return Boxes.of([self.truth[frame.index]] if sees else [])

    def reset(self) -> None:
        self.resets += 1


def test_a_detector_has_its_say(drawing: Drawing, truth: dict[int, np.ndarray]) -> None:
    detector = Blinking(truth, 80, (64, 70))
    found = follow_box(frames(drawing, range(60, 101)), truth[60], detector=detector)
    assert [one.frame for one in found] == list(range(61, 80))
    assert detector.resets == 1
    # One that does not see what was drawn is not asked.
    blind = Blinking(truth, 0, ())
    found = follow_box(frames(drawing, range(60, 101)), truth[60], detector=blind)
    assert len(list(found)) == 40


def test_proposals_are_accepted_mended_and_thrown_away(
    drawing: Drawing, truth: dict[int, np.ndarray]
) -> None:
    corner = [float(value) for value in truth[80].round(2)]
    box = (corner[0], corner[1], corner[2], corner[3])
    try:
        with pytest.raises(InputError, match="has no box to follow; draw one first"):
            drawing.follow(80)
        drawing.accept(80, box)
        drawing.accept(85, box)
        proposed = drawing.follow(80, count=25)
        assert [one.frame for one in proposed] == [n for n in range(55, 106) if n not in (80, 85)]
        assert not any(one.accepted for one in proposed)
        close = sum(abs(one.y2 - truth[one.frame][3]) < 3.0 for one in proposed)
        assert close >= 40
        states = {one.frame: one.state for one in drawing.frames()}
        assert (states[80], states[81], states[54]) == ("drawn", "proposed", "none")
        first, second = proposed[:2]
        drawing.accept(first.frame, first.xyxy_px)
        drawing.remove(second.frame)
        left = {one.frame: one.accepted for one in drawing.boxes()}
        assert left[first.frame]
        assert second.frame not in left
        # The table holds what was accepted, and nothing else.
        drawn = {box.frame for box in drawing.boxes() if box.accepted}
        assert drawn == {80, 85, first.frame}
        for _ in range(3):
            assert drawing.undo()
        assert {box.frame for box in drawing.boxes()} == {80, 85}
        assert drawing.redo()
        assert len(drawing.boxes()) == 2 + len(proposed)
    finally:
        while drawing.undo():
            pass
