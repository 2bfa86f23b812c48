"""Advice to whoever draws boxes: what a fit to those so far makes of them."""

from __future__ import annotations

from dataclasses import dataclass

from sightline.georeferencing.fit_report import Parameter
from sightline.georeferencing.georeferencer import Georeferencer


@dataclass(frozen=True)
class OddBox:
    """A box that disagrees with the others.

    Attributes:
        recording: Its recording.
        frame: Its frame.
        annotator: Who drew it.
        sigmas: How many standard deviations it is off, by a fit without it.
        error_m: How far off its place is by that fit, metres.
        why: A sentence.
    """

    recording: str
    frame: int
    annotator: str
    sigmas: float
    error_m: float
    why: str


@dataclass(frozen=True)
class ThinCell:
    """A part of the picture in which the log passes, and hardly a box is drawn.

    Attributes:
        x1: Left, pixels.
        y1: Top.
        x2: Right.
        y2: Bottom.
        boxes: How many boxes end there.
        passes: How many frames the log says that the vessel is there.
        frames: Some of them, to be drawn next.
    """

    x1: float
    y1: float
    x2: float
    y2: float
    boxes: int
    passes: int
    frames: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Advice:
    """What the newest fit that is finished says; of no fit at first.

    Attributes:
        running: Whether a newer fit is on its way.
        boxes: Boxes that it learned from, of all recordings of the scene.
        rmse_m: Root mean square error of their places, metres; NaN without a fit.
        left_out: Whether that is of each box by a fit without it.
        parameters: Of the camera, each with its standard deviation and whether the data
            determines it.
        odd: Boxes that disagree with the others, the oddest first.
        thin: Parts of the picture that want boxes.
        enough: Whether more boxes will not help.
        reason: Why it is enough, or why not.
        axis_m: Larger semi-axis of the 95 % ellipse where the log passes, median, metres.
        gain: By what share of itself that is expected to shrink with `MORE_BOXES` boxes more in
            the frames that teach most, 0 to 1; NaN where it is not known.
        statements: Sentences of the fit's report.
        error: Why there is no fit, in one line, or ``""``.
        georeferencer: The fitted model, or None.
    """

    running: bool = False
    boxes: int = 0
    rmse_m: float = float("nan")
    left_out: bool = False
    parameters: tuple[Parameter, ...] = ()
    odd: tuple[OddBox, ...] = ()
    thin: tuple[ThinCell, ...] = ()
    enough: bool = False
    reason: str = ""
    axis_m: float = float("nan")
    gain: float = float("nan")
    statements: tuple[str, ...] = ()
    error: str = ""
    georeferencer: Georeferencer | None = None
