"""Figures of an evaluation: the map of the paper's Figure 3, and what the numbers do not show.

Every function returns a Matplotlib `Figure` of its own; nothing touches pyplot's global state.
The log is vermilion and the estimate blue throughout, two colours that all eyes tell apart.
"""

from __future__ import annotations

import base64
import io
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter
from numpy.typing import ArrayLike, NDArray

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.evaluation.calibration import Reliability
from sightline.evaluation.metrics import ScoredPairs, by_range, covered, line_of_sight_errors
from sightline.synchronisation import LARGEST_GAP_S
from sightline.text import figure_text
from sightline.types import BoolArray, FloatArray, IntArray, ellipses

TRUTH_COLOUR = "#d55e00"
ESTIMATE_COLOUR = "#0072b2"
SERIES_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#000000")
"""Okabe and Ito's palette, which the common kinds of colour blindness tell apart."""

FIGURE_SUFFIXES = (".png", ".svg", ".pdf")

_INK = "#333333"
_FAINT = "#8a8a8a"
_MOST_ELLIPSES = 150
_SERIES_STYLES = ("-", "--", "-.", ":")


@dataclass(frozen=True, eq=False)
class MapPanel:
    """One panel of a map figure.

    Attributes:
        title: Above the panel, for example a model's name.
        pairs: Estimate and truth.
        smooth: Draw the estimate as a line, as befits a track; else as points, one a box, each
            tied to where the log says that it should be.
    """

    title: str
    pairs: ScoredPairs
    smooth: bool = False


def map_figure(panels: Sequence[MapPanel], *, probability: float = 0.95) -> Figure:
    """Estimate and truth seen from above, one panel a model, as in the paper's Figure 3.

    Args:
        panels: What to draw, all to the same scale.
        probability: Of the stated ellipses.

    Raises:
        InputError: There is no panel.
    """
    if not panels:
        raise InputError("a map needs at least one panel")
    columns = min(len(panels), 3)
    rows = math.ceil(len(panels) / columns)
    low, high = _extent([panel.pairs for panel in panels])
    width = 8.0 if columns == 1 else 4.2 * columns
    aspect = float((high[1] - low[1]) / (high[0] - low[0]))
    height = min(max(width / columns * aspect, 2.4), 9.0) * rows + 0.9
    figure = new_figure(width, height)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    stated = False
    for axes, panel in zip(grid.flat, panels, strict=False):
        stated |= _draw_map(axes, panel, probability)
        title_panel(axes, panel.title, fontsize=11)
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        tidy(axes)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    for axes in grid.flat[max(len(panels) - columns, 0) : len(panels)]:
        axes.set_xlabel("east of the camera, m")
        axes.tick_params(labelbottom=True)
    for axes in grid[:, 0]:
        axes.set_ylabel("north of the camera, m")
    smooth, single = any(p.smooth for p in panels), any(not p.smooth for p in panels)
    handles: list[Line2D | Patch] = [Line2D([], [], color=TRUTH_COLOUR, lw=2.0, label="log")]
    if smooth:
        handles.append(Line2D([], [], color=ESTIMATE_COLOUR, lw=2.0, label="track"))
    if single:
        handles.append(_dot(ESTIMATE_COLOUR, "estimate"))
    if stated:
        label = f"{100.0 * probability:g} % ellipse"
        handles.append(Patch(fc=ESTIMATE_COLOUR, alpha=0.25, label=label))
    handles.append(Line2D([], [], color=_INK, marker="^", ms=8, ls="", mec="white", label="camera"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def _extent(tables: Sequence[ScoredPairs]) -> tuple[FloatArray, FloatArray]:
    """The corners of the map: all of the truth, the camera, and estimates that are not absurd."""
    true = [np.column_stack([pairs.true_east_m, pairs.true_north_m]) for pairs in tables]
    core = np.concatenate([np.zeros((1, 2)), *true])
    size = max(float(np.ptp(core, axis=0).max()), 10.0)
    low, high = core.min(axis=0), core.max(axis=0)
    estimates = np.concatenate([np.column_stack([p.east_m, p.north_m]) for p in tables])
    near = (estimates > low - 0.35 * size) & (estimates < high + 0.35 * size)
    shown = np.concatenate([core, estimates[near.all(axis=1)]])
    margin = 0.05 * size
    return shown.min(axis=0) - margin, shown.max(axis=0) + margin


def _draw_map(axes: Axes, panel: MapPanel, probability: float) -> bool:
    pairs = panel.pairs
    true = np.column_stack([pairs.true_east_m, pairs.true_north_m])
    estimate = np.column_stack([pairs.east_m, pairs.north_m])
    stretches = _stretches(pairs)
    chosen = np.arange(len(pairs))[:: max(len(pairs) // _MOST_ELLIPSES, 1)]
    chosen = chosen[np.isfinite(pairs.covariance_m2[chosen]).all(axis=(1, 2))]
    if chosen.size:
        shape = ellipses(pairs.covariance_m2[chosen], probability)
        # Many ellipses on one spot are not to hide what lies beneath.
        axes.add_collection(
            EllipseCollection(
                2.0 * shape.semi_major_m,
                2.0 * shape.semi_minor_m,
                90.0 - shape.bearing_deg,
                units="xy",
                offsets=estimate[chosen],
                offset_transform=axes.transData,
                facecolors=to_rgba(ESTIMATE_COLOUR, float(np.clip(8.0 / chosen.size, 0.03, 0.15))),
                edgecolors=to_rgba(ESTIMATE_COLOUR, 0.3),
                linewidths=0.5,
                zorder=1,
            )
        )
    axes.add_collection(
        LineCollection([true[rows] for rows in stretches], colors=TRUTH_COLOUR, lw=1.8, zorder=3)
    )
    lonely = [rows[0] for rows in stretches if rows.size == 1]
    axes.plot(*true[lonely].T, ".", color=TRUTH_COLOUR, ms=5, zorder=3)
    if panel.smooth:
        lines = [estimate[rows] for rows in stretches]
        axes.add_collection(LineCollection(lines, colors=ESTIMATE_COLOUR, lw=1.6, zorder=4))
    else:
        axes.add_collection(
            LineCollection(
                list(np.stack([true, estimate], axis=1)), colors=_FAINT, lw=0.6, zorder=2
            )
        )
        axes.plot(*estimate.T, "o", color=ESTIMATE_COLOUR, ms=4.5, mec="white", mew=0.5, zorder=5)
    axes.plot(0.0, 0.0, "^", color=_INK, ms=9, mec="white", mew=0.8, zorder=6)
    return bool(chosen.size)


def _stretches(pairs: ScoredPairs) -> list[IntArray]:
    """Rows in the order of time, cut where the segment changes or time leaps."""
    order = np.lexsort((pairs.time_utc_s, pairs.segment))
    leap = (np.diff(pairs.segment[order]) != 0) | (np.diff(pairs.time_utc_s[order]) > LARGEST_GAP_S)
    return [rows for rows in np.split(order, np.flatnonzero(leap) + 1) if rows.size]


def error_against_range(series: Mapping[str, ScoredPairs]) -> Figure:
    """The error against the true distance from the camera: each pair, and the median of each bin.

    Args:
        series: By name, for example the model's.
    """
    figure = new_figure(7.6, 4.4)
    axes = figure.subplots()
    floor = 0.1
    for k, (name, pairs) in enumerate(series.items()):
        colour = SERIES_COLOURS[k % len(SERIES_COLOURS)]
        chosen = slice(None, None, max(len(pairs) // 4000, 1))
        axes.plot(
            pairs.true_range_m[chosen],
            np.maximum(pairs.error_m[chosen], floor),
            "o",
            color=colour,
            ms=4.0,
            mew=0.0,
            alpha=0.35 if len(series) == 1 else 0.2,
            rasterized=True,
        )
        bins = by_range(pairs)
        middle = [
            float(np.median(pairs.true_range_m[_between(pairs, row.from_m, row.to_m)]))
            for row in bins
        ]
        axes.plot(
            middle,
            [max(row.median, floor) for row in bins],
            _SERIES_STYLES[k % len(_SERIES_STYLES)],
            marker="o",
            color=colour,
            lw=2.0,
            ms=6,
            mec="white",
            label=f"median of {figure_text(name)}",
        )
    low, high = axes.get_xlim()
    reach = np.linspace(max(low, 0.0), high, 200)
    for share, style in ((0.01, ":"), (0.1, ":")):
        axes.plot(reach, np.maximum(share * reach, floor), style, color=_FAINT, lw=1.0, zorder=0)
        axes.annotate(
            f"{100 * share:g} %",
            (high, share * high),
            xytext=(4, 0),
            textcoords="offset points",
            color=_FAINT,
            va="center",
            fontsize=9,
        )
    axes.set_xlim(max(low, 0.0), high)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("true distance from the camera, m")
    axes.set_ylabel("error, m")
    tidy(axes)
    if series:
        _plain(axes.legend(frameon=False, loc="upper left"))
    return figure


def _between(pairs: ScoredPairs, from_m: float, to_m: float) -> BoolArray:
    return (pairs.true_range_m >= from_m) & (pairs.true_range_m < to_m)


def calibration(series: Mapping[str, ScoredPairs]) -> Figure:
    """Stated probabilities of ellipses against the share of true positions that they hold.

    On the diagonal the stated uncertainty is honest; below it too small, above it too large.

    Args:
        series: By name; those that state no covariance are left out.
    """
    figure = new_figure(5.2, 4.9)
    axes = figure.subplots()
    stated = np.linspace(0.0, 0.99, 100)
    axes.fill_between([0.0, 1.0], [0.0, 1.0], 0.0, color=TRUTH_COLOUR, alpha=0.05, lw=0.0)
    axes.plot([0.0, 1.0], [0.0, 1.0], color=_FAINT, lw=1.0)
    for k, (name, pairs) in enumerate(series.items()):
        held = covered(pairs, stated)
        if np.isnan(held).all():
            continue
        colour = SERIES_COLOURS[k % len(SERIES_COLOURS)]
        style = _SERIES_STYLES[k % len(_SERIES_STYLES)]
        label = f"{figure_text(name)} (n = {len(pairs):,})"
        axes.plot(stated, held, style, color=colour, lw=2.0, label=label)
        marks = np.array([0.5, 0.95])
        axes.plot(marks, covered(pairs, marks), "o", color=colour, ms=7, mec="white")
    _compare_shares(axes, "stated probability of the ellipse", "share of true positions inside")
    if axes.get_legend_handles_labels()[0]:
        _plain(axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(0.0, 0.9)))
    return figure


def reliability_figure(measured: Reliability) -> Figure:
    """How often a detector's boxes are right, by their confidence; each dot is a tenth.

    Args:
        measured: The larger a dot, the more boxes it has.
    """
    figure = new_figure(5.2, 4.9)
    axes = figure.subplots()
    axes.plot([0.0, 1.0], [0.0, 1.0], color=_FAINT, lw=1.0)
    filled = measured.count > 0.0
    said, true = measured.confidence[filled], measured.right[filled]
    axes.plot(said, true, color=ESTIMATE_COLOUR, lw=1.5)
    share = measured.count[filled] / max(float(measured.count.sum()), 1.0)
    axes.scatter(said, true, s=20.0 + 400.0 * share, color=ESTIMATE_COLOUR, edgecolor="white")
    _compare_shares(axes, "confidence of the box", "share of boxes that are right")
    return figure


def _compare_shares(axes: Axes, stated: str, reached: str) -> None:
    """Set out axes of what was stated and of what came true, from none to all."""
    axes.text(0.97, 0.05, "overconfident", color=_FAINT, ha="right", fontsize=10)
    axes.text(0.03, 0.95, "too cautious", color=_FAINT, ha="left", va="top", fontsize=10)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.0)
    axes.set_aspect("equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.set_xlabel(stated)
    axes.set_ylabel(reached)
    tidy(axes)


def error_over_time(recordings: Mapping[str, ScoredPairs], *, probability: float = 0.95) -> Figure:
    """The error along and across the line of sight against time, one panel a recording.

    Args:
        recordings: By name; those without a pair are left out.
        probability: Of the stated band along the line of sight, which is shaded.
    """
    shown = {name: pairs for name, pairs in recordings.items() if len(pairs)}
    columns = min(max(len(shown), 1), 3)
    rows = max(math.ceil(len(shown) / columns), 1)
    figure = new_figure(4.0 * columns if columns > 1 else 7.6, 2.1 * rows + 0.9)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, (name, pairs) in zip(grid.flat, shown.items(), strict=False):
        _draw_over_time(axes, pairs, probability)
        title_panel(axes, name, fontsize=10)
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        tidy(axes)
    for axes in grid.flat[len(shown) :]:
        axes.set_axis_off()
    if shown:
        every = ScoredPairs.concatenate(shown.values())
        error = np.concatenate(
            [values[np.isfinite(values)] for values in line_of_sight_errors(every)]
        )
        reach = 1.3 * float(np.percentile(np.abs(error), 99.0)) if error.size else 1.0
        grid[0, 0].set_ylim(-max(reach, 1.0), max(reach, 1.0))
    for axes in grid.flat[max(len(shown) - columns, 0) : len(shown)]:
        axes.set_xlabel("time from the first position, s")
    for axes in grid[:, 0]:
        axes.set_ylabel("error, m")
    figure.legend(
        handles=[
            _dot(ESTIMATE_COLOUR, "along the line of sight (+ too far)"),
            _dot(SERIES_COLOURS[1], "across it (+ too far right)"),
            Patch(fc=ESTIMATE_COLOUR, alpha=0.18, label=f"stated {100.0 * probability:g} %, along"),
        ],
        loc="outside lower center",
        ncols=3 if columns > 1 else 2,
        frameon=False,
    )
    return figure


def _draw_over_time(axes: Axes, pairs: ScoredPairs, probability: float) -> None:
    order = np.argsort(pairs.time_utc_s, kind="stable")
    times = pairs.time_utc_s[order] - pairs.time_utc_s[order[0]]
    along, across = (values[order] for values in line_of_sight_errors(pairs))
    axes.axhline(0.0, color=_FAINT, lw=0.8)
    half = _stated_half_width_along(pairs, probability)[order]
    known = np.isfinite(half)
    if known.any():
        axes.fill_between(
            times[known], -half[known], half[known], color=ESTIMATE_COLOUR, alpha=0.18, lw=0.0
        )
    dense = times.size > 1 and float(np.median(np.diff(times))) < LARGEST_GAP_S / 8.0
    for values, colour in ((across, SERIES_COLOURS[1]), (along, ESTIMATE_COLOUR)):
        if dense:
            axes.plot(times, values, color=colour, lw=1.4)
        else:
            axes.plot(times, values, "o", color=colour, ms=4.0, mec="white", mew=0.4)


def _stated_half_width_along(pairs: ScoredPairs, probability: float) -> FloatArray:
    """Half the width of the interval along the line of sight that the covariance states."""
    distance = pairs.true_range_m
    unit = pairs.true_sight_m
    unit = unit / np.where(distance > 0.0, distance, np.nan)[:, None]
    variance = np.einsum("ni,nij,nj->n", unit, pairs.covariance_m2, unit)
    width: FloatArray = NormalDist().inv_cdf(0.5 + probability / 2.0) * np.sqrt(variance)
    return width


def image_residuals(
    pixel_px: ArrayLike,
    residual_px: ArrayLike,
    image_size_px: tuple[int, int],
    *,
    outlier: ArrayLike | None = None,
    image_rgb: NDArray[np.uint8] | None = None,
) -> Figure:
    """What a fit leaves over in the image: an arrow for each box, magnified.

    Args:
        pixel_px: (N, 2) pixels, where each box stands.
        residual_px: (N, 2) pixels, measured minus expected, x to the right and y down.
        image_size_px: Width and height.
        outlier: (N,) bool, boxes that the fit did not trust.
        image_rgb: (H, W, 3) a picture of the camera to draw on.

    Raises:
        InputError: The arrays are of different length.
    """
    pixel = np.asarray(pixel_px, dtype=np.float64).reshape(-1, 2)
    residual = np.asarray(residual_px, dtype=np.float64).reshape(-1, 2)
    if pixel.shape != residual.shape:
        raise InputError(f"{len(pixel)} pixels need as many residuals, not {len(residual)}")
    refused = (
        np.zeros(len(pixel), dtype=bool) if outlier is None else np.asarray(outlier, dtype=bool)
    )
    width, height = image_size_px
    figure = new_figure(9.0, 9.0 * height / width + 0.8)
    axes = figure.subplots()
    if image_rgb is not None:
        axes.imshow(image_rgb, extent=(0.0, width, height, 0.0), alpha=0.6)
    length = np.hypot(residual[:, 0], residual[:, 1])
    usual = float(np.nanmedian(length)) if length.size else 0.0
    magnified = _nice(0.03 * width / usual) if usual > 0.0 else 1.0
    for chosen, colour in ((~refused, ESTIMATE_COLOUR), (refused, TRUTH_COLOUR)):
        axes.quiver(
            *pixel[chosen].T,
            *(magnified * residual[chosen]).T,
            color=colour,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.0025,
            headwidth=4.0,
            headlength=5.0,
        )
        axes.plot(*pixel[chosen].T, "o", color=colour, ms=2.5)
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_aspect("equal")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")
    tidy(axes)
    axes.grid(image_rgb is None)
    handles: list[Line2D] = [
        _dot(ESTIMATE_COLOUR, f"residual, {magnified:g} times as long, median {usual:.1f} px")
    ]
    if refused.any():
        handles.append(_dot(TRUTH_COLOUR, "taken for an outlier"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _nice(value: float) -> float:
    """The 1, 2 or 5 times a power of ten at or below a number, and at least 1."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(max(step for step in (1.0, 2.0, 5.0) if step * power <= value) * power, 1.0)


def check_figure_ending(path: str | Path) -> None:
    """Raise InputError for a file whose ending no format of figures has."""
    if Path(path).suffix.lower() not in FIGURE_SUFFIXES:
        raise InputError(f"{path}: a figure ends in {', '.join(FIGURE_SUFFIXES)}")


def save_figure(figure: Figure, path: str | Path, *, dpi: int = 160) -> None:
    """Write a figure, whole or not at all; the ending says the format.

    Args:
        figure: The figure.
        path: Ends in .png, .svg or .pdf.
        dpi: Dots an inch of PNG.

    Raises:
        InputError: Another ending, or the file cannot be written.
    """
    check_figure_ending(path)
    suffix = Path(path).suffix.lower()
    with atomic_path(Path(path)) as temporary:
        # By which a later run knows that it may replace it.
        made_by = {"Software" if suffix == ".png" else "Creator": "sightline"}
        _save(figure, temporary, dpi, suffix[1:], made_by)


def data_uri(figure: Figure, *, dpi: int = 144) -> str:
    """A figure as a PNG inside a ``data:`` address, for pages that stand alone."""
    buffer = io.BytesIO()
    _save(figure, buffer, dpi, "png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _save(
    figure: Figure,
    to: Path | io.BytesIO,
    dpi: int,
    kind: str,
    metadata: dict[str, str] | None = None,
) -> None:
    with warnings.catch_warnings():
        # A name in a script that the font lacks shows as boxes; the file is good all the same.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(to, dpi=dpi, format=kind, metadata=metadata)


def new_figure(width_in: float, height_in: float) -> Figure:
    """A white figure that arranges what is in it."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    engine = figure.get_layout_engine()
    assert isinstance(engine, ConstrainedLayoutEngine)
    engine.set(w_pad=0.08, h_pad=0.08)
    return figure


def _dot(colour: str, label: str) -> Line2D:
    return Line2D([], [], color=colour, marker="o", ms=6, ls="", mec="white", label=label)


def title_panel(axes: Axes, name: str, fontsize: int) -> None:
    """A name of the user's as the title of a panel; a dollar sign in it is no formula."""
    title = axes.set_title(figure_text(name), loc="left", fontsize=fontsize, color=_INK)
    title.set_parse_math(False)
    title.set_usetex(False)


def _plain(legend: Legend) -> None:
    """Show the names in a legend as they are; Matplotlib reads formulas between dollar signs."""
    for text in legend.get_texts():
        text.set_parse_math(False)
        text.set_usetex(False)


def tidy(axes: Axes) -> None:
    """Leave out what of a frame says nothing."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(_FAINT)
    axes.grid(color="#e6e6e6", lw=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_FAINT, labelcolor=_INK, labelsize=9)
    axes.xaxis.label.set_color(_INK)
    axes.yaxis.label.set_color(_INK)
