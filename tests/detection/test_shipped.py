"""The detector that ships: at its place one network counts, elsewhere the other."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sightline.detection import detector_by_name
from sightline.detection.onnx import OnnxDetector
from sightline.simulation.harbour import Harbour, HarbourSettings
from sightline.simulation.render import Renderer
from sightline.types import Frame


@pytest.fixture(scope="module")
def detector() -> OnnxDetector:
    made = detector_by_name("harbour")
    assert isinstance(made, OnnxDetector)
    return made


def test_boats_of_the_synthetic_harbour_are_those_of_the_network_that_knows_it(
    detector: OnnxDetector,
) -> None:
    harbour = Harbour.random(3, HarbourSettings(duration_s=60.0, motorboats=4))
    image = np.ascontiguousarray(Renderer(harbour).image(harbour.start_utc_s + 20.0))
    detector.reset()
    found = detector.detect(Frame(0, 0.0, image))
    assert len(found)
    assert set(found.label.tolist()) == {"boat"}
    assert set(found.source.tolist()) == {"harbour"}


def test_of_pictures_of_anything_else_it_says_nothing(detector: OnnxDetector) -> None:
    rng = np.random.default_rng(0)
    for size in ((16, 9), (48, 27), (160, 90)):
        small = rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        image = cv2.resize(small, (1280, 720), interpolation=cv2.INTER_NEAREST)
        detector.reset()
        assert "boat" not in detector.detect(Frame(0, 0.0, image)).label.tolist()


def test_where_its_boxes_end_is_known_of_each_of_its_sources(detector: OnnxDetector) -> None:
    assert detector.wanted == ("boat", "vessel")
    assert set(detector.lower_edges) == {"harbour", "harbour/vessel"}
    low, tight = detector.lower_edges["harbour"], detector.lower_edges["harbour/vessel"]
    assert low is not None
    assert tight is not None
    # The one leaves water around a boat, the other was taught boxes that end at its outline.
    assert low.px > 1.0 > abs(tight.px)
