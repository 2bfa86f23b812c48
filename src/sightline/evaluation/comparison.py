"""Comparison of models: the paper's Table 2, and a shorter overview table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rich.table import Table
from rich.text import Text

from sightline.evaluation.report import Report, write_json
from sightline.text import terminal_text

ALL_RECORDINGS = "all"
"""The name of the rows that pool all recordings."""


@dataclass(frozen=True)
class TableRow:
    """A row of the paper's Table 2.

    Attributes:
        recording: The recording's name, or `ALL_RECORDINGS`.
        metric: ``"MSE"``, ``"RMSE"``, ``"Relative MSE"`` or ``"Relative RMSE"``.
        values: Square metres or metres, by the model's name; NaN where nothing was compared.
    """

    recording: str
    metric: str
    values: Mapping[str, float]


@dataclass(frozen=True)
class Comparison:
    """The reports of several models on the same boxes.

    Attributes:
        models: By the model's name: single boxes.
        smoothed: By the model's name: the same boxes' times after the trajectory stage; may be
            empty.
    """

    models: Mapping[str, Report]
    smoothed: Mapping[str, Report] = field(default_factory=dict)

    def to_dict(self) -> dict[str, object]:
        """The comparison as JSON has it."""
        out: dict[str, object] = {
            "models": {name: report.to_dict() for name, report in self.models.items()}
        }
        if self.smoothed:
            out["smoothed"] = {name: report.to_dict() for name, report in self.smoothed.items()}
        return out

    def write(self, path: str | Path) -> None:
        """Write the comparison as JSON.

        Raises:
            InputError: The file cannot be written.
        """
        write_json(path, self.to_dict())


def paper_rows(reports: Mapping[str, Report]) -> list[TableRow]:
    """The rows of the paper's Table 2: four errors for each recording, then for all together.

    Args:
        reports: By the model's name; the recordings are those that any of them has.
    """
    recordings = dict.fromkeys(name for report in reports.values() for name in report.recordings)
    parts: dict[str, dict[str, Report]] = {
        recording: {
            model: report.recordings[recording]
            for model, report in reports.items()
            if recording in report.recordings
        }
        for recording in recordings
    }
    if len(recordings) != 1:
        parts[ALL_RECORDINGS] = dict(reports)
    return [
        TableRow(
            recording,
            metric,
            {
                model: getattr(getattr(own[model], kind), statistic) if model in own else math.nan
                for model in reports
            },
        )
        for recording, own in parts.items()
        for metric, kind, statistic in (
            ("MSE", "ape", "mse"),
            ("RMSE", "ape", "rmse"),
            ("Relative MSE", "rpe", "mse"),
            ("Relative RMSE", "rpe", "rmse"),
        )
    ]


def paper_table(reports: Mapping[str, Report], title: str = "") -> Table:
    """The paper's Table 2 for a terminal; the smallest error of a row is bold.

    Args:
        reports: By the model's name.
        title: Above the table.
    """
    table = Table(title=title or None)
    table.add_column("recording")
    table.add_column("metric", no_wrap=True)
    for model in reports:
        table.add_column(Text(terminal_text(model)), justify="right", no_wrap=True)
    last = ""
    for row in paper_rows(reports):
        if last and row.recording != last:
            table.add_section()
        best = smallest(row.values)
        table.add_row(
            "" if row.recording == last else Text(terminal_text(row.recording)),
            row.metric,
            *(
                f"[bold]{number(value)}[/bold]" if model in best else number(value)
                for model, value in row.values.items()
            ),
        )
        last = row.recording
    return table


def overview_table(comparison: Comparison, title: str = "") -> Table:
    """One row a model, pooled over recordings, for a terminal.

    Args:
        comparison: The reports.
        title: Above the table.
    """
    table = Table(title=title or None)
    table.add_column("model", no_wrap=True)
    headings = ["n", "RMSE, m", "median, m", "90 %, m", "of range", "in 50 %", "in 95 %"]
    for heading in (*headings, *(["smoothed RMSE, m"] if comparison.smoothed else [])):
        table.add_column(heading, justify="right")
    for model, report in comparison.models.items():
        ape = report.ape
        cells = [
            str(ape.n),
            number(ape.rmse),
            number(ape.median),
            number(ape.p90),
            percent(ape.per_range),
            percent(report.coverage.p50),
            percent(report.coverage.p95),
        ]
        if comparison.smoothed:
            smoothed = comparison.smoothed.get(model)
            cells.append(number(smoothed.ape.rmse) if smoothed else number(math.nan))
        table.add_row(Text(terminal_text(model)), *cells)
    return table


def smallest(values: Mapping[str, float]) -> set[str]:
    """Names of the smallest number and of those printed alike; none of those without one."""
    known = [value for value in values.values() if math.isfinite(value)]
    if len(known) < 2:
        return set()
    least = number(min(known))
    return {name for name, value in values.items() if number(value) == least}


def number(value: float) -> str:
    """Format a number with a sensible count of digits: ``0.034``, ``4.67``, ``28.4``, ``12735``."""
    if not math.isfinite(value):
        return "–"
    size = abs(value)
    digits = 3 if size < 0.1 else 2 if size < 10.0 else 1 if size < 1000.0 else 0
    return f"{value:.{digits}f}"


def percent(value: float) -> str:
    """Format a share as a percentage: ``6.8 %``, ``94 %``."""
    if not math.isfinite(value):
        return "–"
    return f"{100.0 * value:.1f} %" if abs(value) < 0.0995 else f"{100.0 * value:.0f} %"
