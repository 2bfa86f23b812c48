"""How low a detector's boxes end, measured on rendered boats whose waterline is known.

No real scene tells it: there the camera's pitch is unknown as well, and the two look alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sightline.detection import Detector, LowerEdge
from sightline.errors import FitError
from sightline.overlap import iou
from sightline.simulation.harbour import Harbour, HarbourSettings
from sightline.simulation.render import Renderer
from sightline.types import BoolArray, FloatArray, Frame, IntArray

DURATION_S = 240.0

_FIRST_SEED = 900_000
_PICTURES = 5
_LEAST_OVERLAP = 0.2
_BORDER_PX = 1.0
_FEWEST = 20
_FEWEST_OF_HARBOUR = 5
# Huber's weights: wakes that are taken for the boat, and pairs of two boats.
_HUBER = 1.5
_ROUNDS = 30


@dataclass(frozen=True, eq=False)
class Overhang:
    """Boxes of a detector beside the exact boxes of rendered boats.

    Attributes:
        height_px: (N,) float64, of the exact boxes.
        below_px: (N,) float64, by how much the detector's end lower.
        harbour: (N,) int64, which harbour each is in.
    """

    height_px: FloatArray
    below_px: FloatArray
    harbour: IntArray

    def __len__(self) -> int:
        return int(self.height_px.size)


def overhang(
    detector: Detector,
    harbours: int = 24,
    *,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Overhang:
    """Let a detector look at rendered harbours.

    Args:
        detector: Whose boxes are looked at.
        harbours: How many; each has another camera, other boats and another light.
        seed: The same seed gives the same pictures.
        progress: Told the share done.
    """
    heights, below, of = [np.empty(0)], [np.empty(0)], [np.empty(0, dtype=np.int64)]
    for number in range(harbours):
        harbour = Harbour.random(
            _FIRST_SEED + 1000 * seed + number,
            HarbourSettings(
                duration_s=DURATION_S, motorboats=6, sailboats=0, ferries=0, gulls=3, piles=False
            ),
        )
        renderer = Renderer(harbour)
        detector.reset()
        for time_utc_s in harbour.start_utc_s + np.linspace(5.0, DURATION_S - 5.0, _PICTURES):
            frame = Frame(0, float(time_utc_s), renderer.image(float(time_utc_s)))
            exact = harbour.boxes([time_utc_s], of="all").xyxy_px
            found = detector.detect(frame).xyxy_px
            if not len(found) or not len(exact):
                continue
            overlap = iou(exact[:, None], found)
            nearest = np.argmax(overlap, axis=1)
            taken = overlap[np.arange(len(exact)), nearest] > _LEAST_OVERLAP
            taken &= _whole(exact, harbour.camera.image_size_px)
            heights.append(exact[taken, 3] - exact[taken, 1])
            below.append(found[nearest[taken], 3] - exact[taken, 3])
            of.append(np.full(int(taken.sum()), number))
        if progress is not None:
            progress((number + 1) / harbours)
    return Overhang(np.concatenate(heights), np.concatenate(below), np.concatenate(of))


def lower_edge(seen: Overhang) -> LowerEdge:
    """The bias that the boxes show: a line over the height of the boats, by Huber's estimator.

    Args:
        seen: Of a detector.

    Raises:
        FitError: Too few boats were found.
    """
    if len(seen) < _FEWEST:
        raise FitError(
            f"the detector found {len(seen)} rendered boats, and {_FEWEST} are needed to tell how "
            "low its boxes end"
        )
    design = np.stack([np.ones(len(seen)), seen.height_px], axis=1)
    weight = np.ones(len(seen))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        line = np.linalg.lstsq(design * root[:, None], seen.below_px * root, rcond=None)[0]
        off = seen.below_px - design @ line
        scale = max(float(np.median(np.abs(off))) / 0.6745, 1e-6)
        weight = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(off), 1e-9))
    medians = [
        float(np.median(off[seen.harbour == number]))
        for number in np.unique(seen.harbour)
        if np.sum(seen.harbour == number) >= _FEWEST_OF_HARBOUR
    ]
    spread = float(np.std(medians)) if len(medians) > 1 else scale
    return LowerEdge(px=float(line[0]), share=float(line[1]), spread_px=max(spread, 0.1))


def _whole(boxes: FloatArray, image_size_px: tuple[int, int]) -> BoolArray:
    """(N,) bool, whether the border of the picture cuts nothing off."""
    width, height = image_size_px
    return np.asarray(
        (boxes[:, 0] > _BORDER_PX)
        & (boxes[:, 2] < width - _BORDER_PX)
        & (boxes[:, 3] < height - _BORDER_PX)
    )
