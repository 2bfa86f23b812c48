from __future__ import annotations

import json
import math
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from sightline.evaluation.comparison import (
    Comparison,
    number,
    overview_table,
    paper_rows,
    paper_table,
    percent,
    smallest,
)
from sightline.evaluation.metrics import ScoredPairs
from sightline.evaluation.report import Report, summarise


def report_off(**error_m: float) -> Report:
    """A report on recordings whose estimates are all off by so many metres, in turn left and right.

    The relative error over a second is then twice the absolute one.
    """
    n = 11
    sign = (-1.0) ** np.arange(n)
    return summarise(
        {
            recording: ScoredPairs(
                time_utc_s=1_601_494_584.0 + np.arange(n),
                east_m=error * sign,
                north_m=np.full(n, 80.0),
                covariance_m2=np.full((n, 2, 2), np.nan),
                true_east_m=np.zeros(n),
                true_north_m=np.full(n, 80.0),
                segment=np.zeros(n, np.int64),
                asked=n,
            )
            for recording, error in error_m.items()
        }
    )


def rendered(table) -> str:
    console = Console(width=160, record=True, file=StringIO())
    console.print(table)
    return console.export_text()


def test_rows_are_those_of_the_papers_table() -> None:
    rows = paper_rows({"nn": report_off(v1=4.0, v2=2.0), "qkr": report_off(v1=1.0, v2=3.0)})
    assert [(row.recording, row.metric) for row in rows] == [
        (recording, metric)
        for recording in ("v1", "v2", "all")
        for metric in ("MSE", "RMSE", "Relative MSE", "Relative RMSE")
    ]
    values = {(row.recording, row.metric): dict(row.values) for row in rows}
    assert values["v1", "MSE"] == pytest.approx({"nn": 16.0, "qkr": 1.0})
    assert values["v2", "RMSE"] == pytest.approx({"nn": 2.0, "qkr": 3.0})
    assert values["v1", "Relative RMSE"] == pytest.approx({"nn": 8.0, "qkr": 2.0})
    assert values["v2", "Relative MSE"] == pytest.approx({"nn": 16.0, "qkr": 36.0})
    assert values["all", "MSE"] == pytest.approx({"nn": 10.0, "qkr": 5.0})


def test_one_recording_is_not_pooled_with_itself() -> None:
    one = paper_rows({"nn": report_off(v1=4.0), "qkr": report_off(v1=1.0)})
    assert [row.recording for row in one] == ["v1"] * 4
    # A report that knows no recordings has all that there is.
    whole = report_off(v1=4.0).recordings["v1"]
    rows = paper_rows({"nn": whole})
    assert [row.recording for row in rows] == ["all"] * 4
    assert rows[1].values == pytest.approx({"nn": 4.0})


def test_a_recording_that_a_model_lacks_has_no_number() -> None:
    rows = paper_rows({"nn": report_off(v1=4.0), "qkr": report_off(v1=1.0, v2=3.0)})
    missing = next(row for row in rows if (row.recording, row.metric) == ("v2", "RMSE"))
    assert math.isnan(missing.values["nn"])
    assert missing.values["qkr"] == pytest.approx(3.0)


def test_the_printed_table_has_every_number() -> None:
    text = rendered(
        paper_table({"nn": report_off(v1=4.0, v2=2.0), "qkr": report_off(v1=1.0, v2=3.0)}, "boxes")
    )
    line = next(line for line in text.splitlines() if "v1" in line)
    assert [cell.strip() for cell in line.split("│")[1:-1]] == ["v1", "MSE", "16.0", "1.00"]
    assert "boxes" in text


def test_names_with_brackets_are_printed_as_they_are() -> None:
    reports = {"nn [old]": report_off(**{"[b]v1": 4.0})}
    assert "[b]v1" in rendered(paper_table(reports))
    assert "nn [old]" in rendered(overview_table(Comparison(reports)))


def test_names_in_a_table_send_nothing_to_a_terminal() -> None:
    name = "\x1b[2Jv1[/b]\\"
    reports = {name: report_off(**{name: 4.0})}
    for table in (paper_table(reports), overview_table(Comparison(reports))):
        text = rendered(table)
        assert "\x1b" not in text
        assert r"\x1b[2Jv1[/b]" in text


def test_the_overview_has_a_row_for_each_model() -> None:
    comparison = Comparison(
        {"nn": report_off(v1=4.0), "qkr": report_off(v1=2.0)}, {"qkr": report_off(v1=1.0)}
    )
    lines = rendered(overview_table(comparison, "all recordings")).splitlines()
    assert lines[0].strip() == "all recordings"
    cells = {
        parts[0]: parts[1:]
        for parts in ([cell.strip() for cell in line.split("│")[1:-1]] for line in lines)
        if parts
    }
    assert cells["nn"] == ["11", "4.00", "4.00", "4.00", "5.0 %", "–", "–", "–"]
    assert cells["qkr"] == ["11", "2.00", "2.00", "2.00", "2.5 %", "–", "–", "1.00"]


def test_the_json_has_models_and_smoothed(tmp_path) -> None:
    comparison = Comparison({"qkr": report_off(v1=2.0)}, {"qkr": report_off(v1=1.0)})
    comparison.write(tmp_path / "compare.json")
    written = json.loads((tmp_path / "compare.json").read_text())
    assert written["models"]["qkr"]["ape"]["rmse"] == pytest.approx(2.0)
    assert written["smoothed"]["qkr"]["recordings"]["v1"]["ape"]["rmse"] == pytest.approx(1.0)
    assert set(Comparison({"qkr": report_off(v1=2.0)}).to_dict()) == {"models"}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0341, "0.034"),
        (0.1, "0.10"),
        (4.666, "4.67"),
        (10.0, "10.0"),
        (28.44, "28.4"),
        (1000.0, "1000"),
        (12734.71, "12735"),
        (-28.44, "-28.4"),
        (-0.0341, "-0.034"),
        (math.nan, "–"),
    ],
)
def test_numbers_have_the_digits_that_they_deserve(value: float, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0678, "6.8 %"), (0.0995, "10 %"), (0.941, "94 %"), (-0.25, "-25 %"), (math.nan, "–")],
)
def test_shares_are_percentages(value: float, text: str) -> None:
    assert percent(value) == text


def test_the_smallest_is_named_only_among_several() -> None:
    assert smallest({"a": 2.0, "b": 1.0, "c": math.nan}) == {"b"}
    assert smallest({"a": 1.001, "b": 1.0}) == {"a", "b"}
    assert smallest({"a": 1.0, "b": math.nan}) == set()
