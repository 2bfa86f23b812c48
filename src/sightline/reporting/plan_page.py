"""A plan as a map and as one HTML file that stands alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sightline.atomic import atomic_path
from sightline.pipeline.plan import Plan
from sightline.planning import Contour, Row, WaterMap
from sightline.planning.water_map import LEVELS_M
from sightline.reporting.page import _asset, _environment, _integrity
from sightline.reporting.plots import _figure, _tidy, data_uri
from sightline.text import xml_text

_INK = "#333333"
_SIZE_COLOUR = "#0072b2"
_DRIVE_COLOUR = "#00724f"
_CMAP = "YlOrBr"
_WIDTH_IN = 9.0
_LEAST_IN, _MOST_IN = 4.5, 11.0
_MARGIN = 0.05
_ARROW_SHARE = 0.08
_LABEL_SHARE = 0.15
_DASHES = ("-", "--", ":")


@dataclass(frozen=True)
class _Water:
    """A table of places along the heading, at one level of the water."""

    title: str
    rows: tuple[Row, ...]


def plan_figure(plan: Plan) -> Figure:
    """The map of a plan: 95 % ellipses over the water, where boats are just found, and the drive.

    Args:
        plan: The plan.
    """
    water = plan.maps[0.0]
    low, high = _extent(plan, water)
    aspect = float((high[1] - low[1]) / (high[0] - low[0]))
    figure = _figure(_WIDTH_IN, min(max(_WIDTH_IN * 0.8 * aspect, _LEAST_IN), _MOST_IN))
    axes = figure.subplots()
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    least, most = float(np.nanmin(water.axis_m)), float(np.nanmax(water.axis_m))
    levels = [level for level in LEVELS_M if 0.5 * least <= level <= 2.0 * most]
    norm = LogNorm(levels[0], levels[-1])
    mesh = axes.pcolormesh(
        water.east_m, water.north_m, water.axis_m, norm=norm, cmap=_CMAP, shading="gouraud"
    )
    mesh.set_rasterized(True)
    bar = figure.colorbar(mesh, ax=axes, shrink=0.8, pad=0.02)
    bar.set_label("semi-major axis of the 95 % ellipse, m", color=_INK)
    bar.set_ticks(levels, labels=[f"{level:g}" for level in levels])
    bar.minorticks_off()
    for contour in water.contours:
        _draw_contour(axes, contour, "-")
    for dash, (level, other) in zip(_DASHES[1:], list(plan.maps.items())[1:], strict=False):
        del level
        for contour in other.contours:
            if contour.kind == "axis":
                axes.plot(*contour.east_north_m.T, dash, color=_INK, lw=0.8, alpha=0.7)
    if len(plan.places_m):
        axes.plot(*plan.places_m.T, ".", color=_DRIVE_COLOUR, ms=2.5, zorder=4)
    _draw_camera(axes, plan, float(max(high - low)))
    _tidy(axes)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    figure.legend(
        handles=_legend(plan), loc="outside lower center", ncols=3, frameon=False, fontsize=9
    )
    return figure


def _extent(
    plan: Plan, water: WaterMap
) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], ...]:
    parts = [contour.east_north_m for contour in water.contours]
    known = np.isfinite(water.axis_m)
    parts.append(np.stack([water.east_m[known], water.north_m[known]], axis=1))
    parts.append(np.array([[plan.camera.east_m, plan.camera.north_m]]))
    if len(plan.places_m):
        parts.append(plan.places_m)
    every = np.concatenate(parts)
    low, high = every.min(axis=0), every.max(axis=0)
    # A narrow view is drawn with some water beside it.
    size = float(max(high - low))
    middle = 0.5 * (low + high)
    half = np.maximum(0.5 * (high - low), 0.2 * size) + _MARGIN * size
    return middle - half, middle + half


def _draw_contour(axes: Axes, contour: Contour, dash: str) -> None:
    points = contour.east_north_m
    if contour.kind == "axis":
        axes.plot(*points.T, dash, color=_INK, lw=1.2)
        label = f"{contour.value:g} m"
        colour = _INK
    elif contour.kind == "size":
        axes.plot(*points.T, dash, color=_SIZE_COLOUR, lw=2.0)
        label = f"{contour.value:g} m boat"
        colour = _SIZE_COLOUR
    else:
        axes.plot(*points.T, ":", color="#777777", lw=1.5)
        return
    # Labels of short lines would hide one another.
    if np.ptp(points, axis=0).max() < _LABEL_SHARE * float(np.ptp(axes.get_xlim())):
        return
    at = points[len(points) // 2]
    axes.annotate(
        label,
        at,
        fontsize=8,
        color=colour,
        ha="center",
        va="center",
        clip_on=True,
        bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
        zorder=5,
    )


def _draw_camera(axes: Axes, plan: Plan, size: float) -> None:
    camera = plan.camera
    angle = math.radians(camera.heading_deg)
    reach = _ARROW_SHARE * size
    axes.annotate(
        "",
        (camera.east_m + reach * math.sin(angle), camera.north_m + reach * math.cos(angle)),
        (camera.east_m, camera.north_m),
        arrowprops={"arrowstyle": "->", "color": _INK, "lw": 1.5},
        zorder=6,
    )
    axes.plot(camera.east_m, camera.north_m, "^", color=_INK, ms=9, mec="white", zorder=7)


def _legend(plan: Plan) -> list[Line2D]:
    least_px = plan.settings.least_px
    handles = [
        Line2D([], [], color=_INK, marker="^", ls="", ms=8, label="camera, and its heading"),
        Line2D([], [], color=_INK, lw=1.2, label="95 % ellipse as long"),
        Line2D([], [], color=_SIZE_COLOUR, lw=2.0, label=f"boat {least_px:g} px wide"),
        Line2D([], [], color="#777777", ls=":", lw=1.5, label="no position beyond"),
    ]
    if len(plan.places_m):
        handles.append(
            Line2D([], [], color=_DRIVE_COLOUR, marker=".", ls="", label=f"drive: {_name(plan)}")
        )
    for dash, level in zip(_DASHES[1:], list(plan.maps)[1:], strict=False):
        label = f"the same, water {level:+g} m"
        handles.append(Line2D([], [], color=_INK, ls=dash, lw=0.8, label=label))
    return handles


def _name(plan: Plan) -> str:
    return Path(plan.drive).name.replace("$", r"\$")


def render_plan(plan: Plan) -> str:
    """The plan as HTML text that needs no other file.

    Args:
        plan: The plan.
    """
    style = _asset("report.css")
    latitude, longitude = plan.place_deg
    tables = [_Water(_title(level), rows) for level, rows in plan.rows.items()]
    return xml_text(
        _environment()
        .from_string(_asset("plan.html.j2"))
        .render(
            plan=plan,
            latitude_deg=latitude,
            longitude_deg=longitude,
            tables=tables,
            sizes=list(plan.sizes_m.items()),
            undetermined=[p.name for p in plan.parameters if not p.determined],
            map=data_uri(plan_figure(plan)),
            style=Markup(style),  # noqa: S704 - the package's own file
            style_hash=_integrity(style),
            version=version("sightline"),
        )
    )


def _title(level: float) -> str:
    if level == 0.0:
        return "Along the heading"
    return f"Along the heading, the water {abs(level):g} m {'higher' if level > 0.0 else 'lower'}"


def write_plan(plan: Plan, path: str | Path) -> None:
    """Write the page, whole or not at all.

    Args:
        plan: What it shows.
        path: The HTML file.

    Raises:
        InputError: The file cannot be written.
    """
    text = render_plan(plan)
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def table_lines(rows: Sequence[Row], lengths_m: Sequence[float]) -> list[str]:
    """Rows along the heading as lines of text, with a heading.

    Args:
        rows: Of a plan.
        lengths_m: Of its boats.
    """
    boats = "".join(f"{f'boat {length:g} m':>12s}" for length in lengths_m)
    out = [f"{'range':>8s}{'95 % axis':>12s}{'box alone':>12s}{'1 px':>10s}{boats}"]
    for row in rows:
        widths = "".join(f"{f'{width:.0f} px':>12s}" for width in row.widths_px)
        out.append(
            f"{_metres(row.range_m):>8s}{_metres(row.axis_m):>12s}{_metres(row.known_m):>12s}"
            f"{_metres(row.metres_per_px):>10s}{widths}"
        )
    return out


def _metres(value: float) -> str:
    if not math.isfinite(value):
        return "none"
    return f"{value:.1f} m" if value < 10.0 else f"{value:.0f} m"
