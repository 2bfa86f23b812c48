"""What became of an archive: a catalogue of its recordings, and a summary over all cameras."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd
from jinja2 import Environment, StrictUndefined

from sightline._optional import module
from sightline.atomic import atomic_path
from sightline.evaluation.report import write_json
from sightline.fleet.archive import finished
from sightline.fleet.tasks import Task
from sightline.text import encodable_text, xml_text
from sightline.types import rfc3339

CATALOGUE, SUMMARY, PAGE = "catalogue.parquet", "summary.json", "summary.html"
"""Files of a folder of results, beside its tracks."""

TRACKED, BROKEN_OFF, FAILED, MISSING = "tracked", "broken off", "failed", "not yet"
"""What became of a recording."""

_SCORES = ("rmse_m", "median_m", "coverage_p95")


def catalogue(output: Path, tasks: Iterable[Task], failed: Mapping[str, str]) -> pd.DataFrame:
    """A row a recording, in the order of the tasks.

    Args:
        output: The folder of results.
        tasks: Of the fleet.
        failed: Why recordings could not be tracked.
    """
    tasks = list(tasks)
    made = {task.name: result for task, result in finished(output, tasks)}
    rows = []
    for task in tasks:
        row: dict[str, object] = {
            "camera": task.camera.name,
            "recording": task.recording.name,
            "source": encodable_text(str(task.recording.source)),
            "status": FAILED if task.name in failed else MISSING,
            "line": encodable_text(failed.get(task.name, "")),
        }
        result = made.get(task.name)
        if result is not None and task.name not in failed:
            row |= {
                "status": TRACKED if result.complete else BROKEN_OFF,
                "line": encodable_text(result.line or ""),
                "first_utc": _stamp(result.first_utc_s),
                "last_utc": _stamp(result.last_utc_s),
                "tracked_s": result.tracked_s,
                **{name: getattr(result, name) for name in ("tracks", "moored", "points")},
                **{name: getattr(result, name) for name in (*_SCORES, "compared")},
                "files": list(result.files),
            }
        rows.append(row)
    return pd.DataFrame(rows, columns=list(_KINDS)).astype(_KINDS)


_KINDS = {
    **dict.fromkeys(("camera", "recording", "source", "status", "line"), "str"),
    **dict.fromkeys(("first_utc", "last_utc"), "datetime64[ms, UTC]"),
    "tracked_s": "float64",
    **dict.fromkeys(("tracks", "moored", "points"), "Int64"),
    **dict.fromkeys(_SCORES, "float64"),
    "compared": "Int64",
    "files": "object",
}


def _stamp(time_utc_s: float | None) -> pd.Timestamp | None:
    if time_utc_s is None:
        return None
    return pd.Timestamp(round(time_utc_s * 1000.0), unit="ms", tz="UTC")


def summary(table: pd.DataFrame) -> list[dict[str, object]]:
    """Sums over the recordings of each camera, and over all of them in the last row (``""``).

    The error is pooled over all moments that were compared with a log.
    """
    parts = [*table.groupby("camera", sort=True), ("", table)]
    return [_summed(str(name), part) for name, part in parts]


def _summed(camera: str, part: pd.DataFrame) -> dict[str, object]:
    scored = part[part["rmse_m"].notna()]
    weight = scored["compared"].to_numpy(np.float64, na_value=0.0)
    status = part["status"]

    def pooled(name: str, power: float) -> float | None:
        known = scored[name].to_numpy(np.float64)
        usable = np.isfinite(known) & (weight > 0.0)
        if not usable.any():
            return None
        mean = float(np.average(known[usable] ** power, weights=weight[usable]))
        return math.pow(mean, 1.0 / power)

    return {
        "camera": camera,
        "recordings": len(part),
        "tracked": int((status == TRACKED).sum()),
        "broken_off": int((status == BROKEN_OFF).sum()),
        "failed": int((status == FAILED).sum()),
        "not_yet": int((status == MISSING).sum()),
        "hours": float(part["tracked_s"].sum()) / 3600.0,
        "tracks": int(part["tracks"].sum()),
        "moored": int(part["moored"].sum()),
        "points": int(part["points"].sum()),
        "scored": len(scored),
        "compared": int(weight.sum()),
        "rmse_m": pooled("rmse_m", 2.0),
        "coverage_p95": pooled("coverage_p95", 1.0),
    }


def write_catalogue(output: Path, table: pd.DataFrame) -> list[Path]:
    """Write catalogue and summary into a folder of results; returns the files.

    Raises:
        InputError: A file cannot be written, or the extra ``parquet`` is missing.
    """
    module("pyarrow", "parquet")
    paths = [output / CATALOGUE, output / SUMMARY, output / PAGE]
    with atomic_path(paths[0]) as temporary:
        table.to_parquet(temporary, index=False)
    cameras = summary(table)
    troubles = table[table["line"] != ""]
    content = {
        "cameras": cameras[:-1],
        "all": cameras[-1],
        "lines": troubles[["camera", "recording", "status", "line"]].to_dict("records"),
    }
    write_json(paths[1], content)
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    template = environment.from_string(
        files("sightline.fleet").joinpath("summary.html.j2").read_text(encoding="utf-8")
    )
    with atomic_path(paths[2]) as temporary:
        known = table["first_utc"].dropna()
        begin = rfc3339(known.min().timestamp())[:10] if len(known) else ""
        end = rfc3339(table["last_utc"].dropna().max().timestamp())[:10] if len(known) else ""
        temporary.write_text(xml_text(template.render(begin=begin, end=end, **content)), "utf-8")
    return paths
