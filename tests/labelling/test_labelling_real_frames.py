"""Proposed boxes on the real frames, against boxes that were drawn by eye."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline import Scene, fit
from sightline.formats.labels import read_labels
from sightline.labelling import SOURCE, contact_sheets, learn_size, propose
from sightline.overlap import iou

pytestmark = pytest.mark.slow

DRAWN = Path(__file__).parents[2] / "benchmarks" / "tracks-at-sea" / "boxes"


@pytest.fixture(scope="module")
def scene(data_dir: Path) -> Scene:
    return Scene.load(data_dir / "tracks-at-sea" / "scene.toml")


@pytest.mark.parametrize(
    ("name", "least_found", "least_right"), [("09", 0.9, 0.9), ("13", 0.8, 0.9)]
)
def test_boxes_from_the_log_agree_with_those_drawn_by_eye(
    scene: Scene, name: str, least_found: float, least_right: float
) -> None:
    model = fit(scene.without([name]), "camera")
    proposals = propose(scene[name], model, learn_size(scene.without([name]), model))
    drawn = read_labels(DRAWN / f"{name}.csv")
    truth = {
        int(frame): box
        for frame, box in zip(
            drawn.boxes.frame[drawn.target], drawn.boxes.xyxy_px[drawn.target], strict=True
        )
    }
    boxes = proposals.boxes()
    assert set(boxes.source.tolist()) == {SOURCE}
    overlap = np.array(
        [
            iou(box, truth[int(frame)]) if int(frame) in truth else 0.0
            for frame, box in zip(boxes.frame, boxes.xyxy_px, strict=True)
        ]
    )
    assert len(boxes) >= least_found * len(truth)
    assert np.mean(overlap >= 0.5) >= least_right
    assert np.median(overlap) >= 0.65


def test_each_drawn_frame_is_a_frame_of_the_recording(data_dir: Path) -> None:
    for path in sorted(DRAWN.glob("*.csv")):
        frames = {
            int(one.stem) for one in (data_dir / "tracks-at-sea" / "frames" / path.stem).iterdir()
        }
        if path.stem == "20":
            continue
        labels = read_labels(path)
        known = set(labels.boxes.frame.tolist())
        assert known <= frames, path
        # The logged boat has one box in a frame, and lies within the picture.
        mine = labels.boxes.frame[labels.target]
        assert len(set(mine.tolist())) == len(mine), path
        corners = labels.boxes.xyxy_px
        assert corners.min() >= 0.0
        assert corners[:, 2].max() <= 1280.0
        assert corners[:, 3].max() <= 720.0


def test_contact_sheets_show_every_frame_with_a_place(scene: Scene, tmp_path: Path) -> None:
    model = fit(scene, "camera")
    proposals = propose(scene["10"], model, learn_size(scene, model))
    pages = contact_sheets(proposals, scene["10"], tmp_path)
    assert [page.name for page in pages] == ["10-1.png", "10-2.png"]
    assert all(page.read_bytes().startswith(b"\x89PNG") for page in pages)
