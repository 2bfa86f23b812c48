"""Counts as a table: CSV for a spreadsheet, Parquet, or JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from sightline._optional import module
from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.text import cell_text

Cells = Mapping[str, str | int | float | None]

ENDINGS = (".csv", ".json", ".parquet")
"""Of the files that counts are written to."""

COLUMNS = (
    *("what", "begin_utc", "end_utc", "name", "class", "direction", "bound"),
    *(
        "count",
        "expected",
        "sigma",
        "maybe_twice",
        "speed_mean_mps",
        "speed_se_mps",
        "speed_std_mps",
    ),
    *("entries_count", "entries_expected", "entries_sigma"),
    *("exits_count", "exits_expected", "exits_sigma"),
    *("stays", "dwell_mean_s", "dwell_se_s", "dwell_std_s"),
    *("occupancy_mean", "occupancy_sigma", "occupancy_moored"),
    *("occupancy_most", "occupancy_most_sigma"),
    *("occupancy_most_of_all", "occupancy_most_of_all_sigma"),
    *("origin", "destination", "travel_mean_s", "travel_se_s"),
    *("time_utc", "track_id", "other_track_id", "other_class"),
    *("distance_m", "distance_sigma_m", "probability", "latitude_deg", "longitude_deg"),
)
"""The columns of a table of counts, in their order."""

_TEXTS = (
    *("what", "begin_utc", "end_utc", "name", "class", "direction", "bound"),
    *("origin", "destination", "time_utc", "other_class"),
)
_WHOLE = (
    *("count", "maybe_twice", "entries_count", "exits_count", "stays"),
    *("occupancy_most", "occupancy_most_of_all", "track_id", "other_track_id"),
)


def check_counts_ending(path: Path) -> None:
    """Raise InputError for a file whose ending no format of counts has."""
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"{path}: unknown format of counts; known are {', '.join(ENDINGS)}")


def write_counts(
    rows: Sequence[Cells], content: Mapping[str, object], path: str | os.PathLike[str]
) -> None:
    """Write counts in the format that the file's ending names.

    Args:
        rows: For a table; what a row has no cell for stays empty.
        content: For JSON.
        path: Where to.

    Raises:
        InputError: The ending is unknown, an extra is missing, or it cannot be written.
    """
    goal = Path(path)
    check_counts_ending(goal)
    suffix = goal.suffix.lower()
    if suffix == ".parquet":
        module("pyarrow", "parquet")
    with atomic_path(goal) as temporary:
        if suffix == ".json":
            text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
            temporary.write_text(text + "\n", encoding="utf-8")
        elif suffix == ".parquet":
            _table(rows).to_parquet(temporary, engine="pyarrow", index=False)
        else:
            table = _table(rows)
            for name in _TEXTS:
                table[name] = table[name].map(cell_text, na_action="ignore")
            table.to_csv(temporary, index=False, lineterminator=os.linesep)


def _table(rows: Sequence[Cells]) -> pd.DataFrame:
    table = pd.DataFrame({name: [row.get(name) for row in rows] for name in COLUMNS})
    kinds = {name: "string" if name in _TEXTS else "Float64" for name in COLUMNS}
    return table.astype(kinds | dict.fromkeys(_WHOLE, "Int64"))
