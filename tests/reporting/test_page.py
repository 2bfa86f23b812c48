from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import shutil
import socket
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.evaluation.comparison import Comparison
from sightline.evaluation.metrics import Coverage, ScoredPairs, pair_positions
from sightline.evaluation.report import Report, TracksUsed, evaluate_tracks, summarise
from sightline.geodesy import LocalPlane
from sightline.reporting.page import (
    ModelRow,
    OutlierRow,
    PageFigure,
    ReportPage,
    SourceRow,
    _to_sigma,
    clock_time,
    plain_statements,
    render_page,
    write_page,
)
from sightline.reporting.plots import calibration
from sightline.types import Fixes, Positions, Track

PLANE = LocalPlane(32.70297, -117.234631)
START = 1_601_494_584.0
HOSTILE = """</script><script>alert(1)</script>"><img src=http://x.example/ onerror='a'>&"""


class Page(HTMLParser):
    """What a browser would make of the page: tags with attributes, and the text of scripts."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.inside: dict[str, list[str]] = {}
        self.text: list[str] = []
        self._open: list[str] = []
        self.unbalanced: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in {"meta", "img", "input"}:
            self._open.append(tag)
            if tag in {"script", "style"}:
                self.inside.setdefault(tag, []).append("")

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if not self._open or self._open.pop() != tag:
            self.unbalanced.append(tag)

    def handle_data(self, data):
        if self._open and self._open[-1] in self.inside:
            self.inside[self._open[-1]][-1] += data
        else:
            self.text.append(data)

    def all(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == name]

    @property
    def map_data(self) -> dict:
        return json.loads(self.inside["script"][0])

    @property
    def words(self) -> str:
        return re.sub(r"\s+", " ", "".join(self.text))


def log() -> Fixes:
    times = START + np.arange(60.0)
    return Fixes(times, *PLANE.to_geographic(2.0 * np.arange(60.0), np.full(60, 100.0)))


def track(track_id: int = 1, *, error_m: float = 3.0, n: int = 100, label: str = "boat") -> Track:
    times = START + np.linspace(0.0, 59.0, n)
    return Track(
        track_id=track_id,
        time_utc_s=times,
        east_m=2.0 * (times - START),
        north_m=np.full(n, 100.0 + error_m),
        velocity_east_mps=np.full(n, 2.0),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(np.diag([1.0, 4.0]), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.arange(n) % 3,
        plane=PLANE,
        label=label,
    )


def boxes(times=None) -> ScoredPairs:
    times = START + np.arange(0.0, 59.0, 4.0) if times is None else times
    n = times.size
    positions = Positions(
        east_m=2.0 * (times - START),
        north_m=np.full(n, 104.0),
        covariance_m2=np.tile(4.0 * np.eye(2), (n, 1, 1)),
        extrapolated=np.zeros(n, bool),
        plane=PLANE,
    )
    return pair_positions(times, positions, log())


def full_page(name: str = "07", **more) -> ReportPage:
    report = evaluate_tracks({name: [track()]}, log())
    single = summarise({name: boxes()})
    return ReportPage(
        **{
            "title": "Harbour",
            "scene_name": "dock",
            "plane": PLANE,
            "reports": {"single boxes": single, "smoothed tracks": report},
            "tracks": {name: [track(), track(2, error_m=40.0)]},
            "fixes": {name: log()},
            "positions": {name: boxes()},
            "model_name": "camera",
            "model": [
                ModelRow("height", 3.5, "m", 0.08),
                ModelRow("shift east", 0.0, "m", 2.0, determined=False),
                ModelRow("roll", float("nan")),
            ],
            "sources": [SourceRow("manual", 60, -1.8, 0.4)],
            "outliers": [OutlierRow(name, 1200, START, "voc", 14.2)],
            "statements": ["A sentence."],
            "warnings": ["A warning."],
            "figures": [PageFigure("Calibration", calibration({"a": boxes()}), "A curve", "Look.")],
            "comparison": Comparison({"qkr": single, "camera": single}, {"camera": report}),
            "made_utc_s": START,
            **more,
        }
    )


def test_the_page_loads_nothing() -> None:
    page = Page(render_page(full_page()))
    assert {tag for tag, _ in page.tags} & {"link", "iframe", "object", "embed", "base"} == set()
    for tag, attributes in page.tags:
        for name, value in attributes.items():
            assert not name.startswith("on"), (tag, name)
            assert name != "style", tag
            if name in {"src", "href", "xlink:href", "srcset", "poster", "action", "data"}:
                assert value is not None
                assert value.startswith("data:image/png;base64,"), (tag, name)
    for text in (*page.inside["style"], *page.inside["script"]):
        assert not re.search(r"https?:|//[a-z]|url\(|@import|fetch\(|XMLHttp|innerHTML", text)


def test_the_browser_is_told_to_run_only_this_script_and_style() -> None:
    page = Page(render_page(full_page()))
    (policy,) = [
        attributes["content"]
        for attributes in page.all("meta")
        if attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    assert policy is not None
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"

    def integrity(text: str) -> str:
        digest = hashlib.sha256(text.encode()).digest()
        return f"'sha256-{base64.b64encode(digest).decode()}'"

    _, script = page.inside["script"]
    (style,) = page.inside["style"]
    assert rules["script-src"] == integrity(script)
    assert rules["style-src"] == integrity(style)


def test_hostile_names_stay_text() -> None:
    page = full_page(
        HOSTILE,
        title=HOSTILE,
        scene_name=HOSTILE,
        model_name=HOSTILE,
        reports={HOSTILE: summarise({HOSTILE: boxes()})},
        tracks={HOSTILE: [track(label=HOSTILE)]},
        model=[ModelRow(HOSTILE, 1.0, HOSTILE, 1.0)],
        sources=[SourceRow(HOSTILE, 1, 0.0, 0.0)],
        outliers=[OutlierRow(HOSTILE, None, float("nan"), HOSTILE, 1.0)],
        statements=[HOSTILE],
        warnings=[HOSTILE],
        figures=[PageFigure(HOSTILE, calibration({}), HOSTILE, HOSTILE)],
        comparison=Comparison({HOSTILE: summarise({HOSTILE: boxes()})}),
    )
    harmless = Page(render_page(full_page(comparison=page.comparison)))
    found = Page(render_page(page))
    assert len(found.all("script")) == len(harmless.all("script")) == 2
    assert [attributes["alt"] for attributes in found.all("img")] == [HOSTILE]
    assert found.unbalanced == []
    assert found.words.count(re.sub(r"\s+", " ", HOSTILE)) >= 12
    assert {series["recording"] for series in found.map_data["series"]} == {HOSTILE}
    assert found.map_data["series"][0]["name"] == f"track 1, {HOSTILE}"


def test_the_page_is_well_formed_and_every_picture_is_told_in_words() -> None:
    page = Page(render_page(full_page()))
    assert page.unbalanced == []
    assert page.all("html")[0]["lang"] == "en"
    assert len(page.all("h1")) == 1
    assert all(attributes.get("alt") for attributes in page.all("img"))
    for attributes in page.all("button"):
        assert attributes.get("aria-label")
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    named = next(a for a in page.all("svg") if a.get("role") == "img")["aria-labelledby"]
    assert named is not None
    assert set(named.split()) <= set(ids)


def test_the_page_says_what_it_was_given() -> None:
    words = Page(render_page(full_page())).words
    for expected in (
        "Harbour",
        "32.70297° N, 117.23463° W",
        "made 2020-09-30 19:36:24 UTC",
        "A warning.",
        "A sentence.",
        "no: it is what was assumed",
        "−1.80",
        "2020-09-30 19:36:24 UTC",
    ):
        assert expected in words, expected
    assert "nan" not in words.lower().split()


def coordinates(path: str) -> np.ndarray:
    return np.array([[float(v) for v in pair.split()] for pair in re.split("[ML]", path)[1:]])


def test_the_map_draws_tracks_log_and_ellipses_where_they_are() -> None:
    page = Page(render_page(full_page(positions={})))
    paths = {}
    for attributes in page.all("path"):
        paths.setdefault(attributes.get("class"), []).append(attributes["d"])
    drawn = coordinates(paths["track"][0])
    own = track()
    np.testing.assert_allclose(drawn, np.column_stack([own.east_m, -own.north_m]), atol=0.006)
    truth = coordinates(paths["log"][0])
    np.testing.assert_allclose(truth[:, 0], 2.0 * np.arange(60.0), atol=0.01)
    np.testing.assert_allclose(truth[:, 1], -100.0, atol=0.01)
    shapes = [a for a in page.all("ellipse") if "cx" in a]
    # Standard deviations of 1 m east and 2 m north: the long axis points north, which is up.
    assert float(shapes[0]["rx"]) == pytest.approx(2.0 * 2.4477, abs=0.01)
    assert float(shapes[0]["ry"]) == pytest.approx(1.0 * 2.4477, abs=0.01)
    turn = float(re.match(r"rotate\((\S+) ", shapes[0]["transform"]).group(1))
    assert turn % 180.0 == pytest.approx(90.0)
    x, y, width, height = (float(v) for v in page.all("svg")[0]["viewbox"].split())
    for east, south in (*drawn[[0, -1]], (0.0, 0.0)):
        assert x < east < x + width
        assert y < south < y + height


def test_a_target_that_lies_still_has_one_ellipse_and_one_that_moves_has_many() -> None:
    """A standard deviation of 1 m east; one target makes 1.2 m a point, one a tenth in all."""
    under_way = track(2)
    still = replace(track(1), east_m=np.linspace(-50.0, -49.9, len(under_way)))
    page = Page(render_page(full_page(positions={}, tracks={"07": [still, under_way]})))
    east_m = [float(a["cx"]) for a in page.all("ellipse") if "cx" in a]
    assert sum(east < -40.0 for east in east_m) == 1
    assert sum(east > -40.0 for east in east_m) == len(under_way)


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (3.90042, 0.166, "3.90"),
        (-1.1e-9, 0.46, "0.00"),
        (622.355, 19.8, "622"),
        (-0.04889, 0.071, "−0.049"),
        (0.0045, 0.097, "0.004"),
        (958.52, None, "958.5"),
        (5.5, 0.0, "5.5"),
        (-2.0, math.nan, "−2"),
        (math.nan, 1.0, "–"),
    ],
)
def test_a_value_is_written_to_the_digit_at_which_it_is_unsure(
    value: float, sigma: float | None, shown: str
) -> None:
    assert _to_sigma(value, sigma) == shown


def test_what_the_pointer_shows_is_in_the_page() -> None:
    series = Page(render_page(full_page())).map_data["series"]
    first = next(one for one in series if one["track"])
    assert first["name"] == "track 1, boat"
    np.testing.assert_allclose(first["time"], track().time_utc_s, atol=0.006)
    assert set(first["speed"]) == {2.0}
    assert set(first["course"]) == {90.0}
    np.testing.assert_allclose(first["error"], 3.0, atol=0.01)
    assert [one["name"] for one in series] == ["track 1, boat", "track 2, boat", "single box"]


def test_only_the_logged_targets_track_has_an_error() -> None:
    """How far another vessel's track is from the log says nothing of the track."""
    page = Page(render_page(full_page()))
    mine, other = (one for one in page.map_data["series"] if one["track"])
    np.testing.assert_allclose(mine["error"], 3.0, atol=0.01)
    assert all(value is None for value in other["error"])
    cells = table_cells(render_page(full_page()), "Tracks")
    assert [row[-1] for row in cells[1:]] == ["3.00", ""]


def test_tracks_without_a_log_have_no_column_of_errors() -> None:
    unlogged = full_page(fixes={}, reports={}, positions={})
    header, *_ = table_cells(render_page(unlogged), "Tracks")
    assert "error, m" not in header
    assert "error, m" in table_cells(render_page(full_page()), "Tracks")[0]
    assert "distance from the log" not in Page(render_page(unlogged)).words


def table_cells(text: str, label: str) -> list[list[str]]:
    """The cells of the table in the region of a label, row by row."""
    region = text[text.index(f'aria-label="{label}') :]
    rows = re.findall(r"<tr>(.*?)</tr>", region[: region.index("</table>")])
    return [re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row) for row in rows]


def test_what_the_model_learned_from_is_never_the_headline() -> None:
    names = {"single boxes, learned from": "single boxes", "left out": "smoothed tracks"}
    reports = {new: full_page().reports[old] for new, old in names.items()}
    learned = frozenset({"single boxes, learned from"})
    page = Page(render_page(full_page(reports=reports, learned_from=learned)))
    assert "left out, against the log:" in page.words
    # The truth of the smoothed track is 3 m; that of the boxes 4 m.
    (median,) = re.findall(r"median error ?([0-9.]+) m", page.words)
    assert float(median) == pytest.approx(3.0, abs=0.01)
    alone = {name: reports[name] for name in learned}
    page = Page(render_page(full_page(reports=alone, learned_from=learned)))
    assert "median error" not in page.words
    assert "no figure of this page says how well it does elsewhere" in page.words


def test_the_map_says_where_on_the_earth_it_is() -> None:
    page = Page(render_page(full_page(positions={})))
    view = [float(v) for v in page.all("svg")[0]["viewbox"].split()]
    # A sphere will do for four digits at a few hundred metres.
    south = PLANE.latitude_deg - np.degrees((view[1] + view[3]) / 6_367_000.0)
    (said,) = re.findall(r"First view: ([0-9.]+)° N", page.words)
    assert float(said) == pytest.approx(south, abs=2e-4)
    (whole,) = [a["d"] for a in page.all("path") if a.get("class") == "log whole"]
    assert len(coordinates(whole)) == len(log())


def test_long_tracks_are_thinned_to_a_page_that_opens() -> None:
    tracks = {"07": [track(k, n=20_000) for k in range(5)]}
    page = Page(render_page(full_page(tracks=tracks)))
    points = [len(one["time"]) for one in page.map_data["series"] if one["track"]]
    assert sum(points) < 13_000
    last = page.map_data["series"][0]
    assert last["time"][-1] == pytest.approx(START + 59.0, abs=0.01)
    assert len([a for a in page.all("ellipse") if "cx" in a]) <= 420


def test_a_log_of_hours_is_drawn_only_beside_what_came_of_the_video() -> None:
    times = START + np.arange(-5000.0, 5000.0)
    hours = Fixes(times, *PLANE.to_geographic(2.0 * (times - START), np.full(times.size, 100.0)))
    page = Page(render_page(full_page(fixes={"07": hours, "08": hours})))
    logs = [a["d"] for a in page.all("path") if a.get("class") == "log"]
    reach = coordinates(logs[0])[:, 0]
    assert reach.min() == pytest.approx(-16.0, abs=0.1)
    assert reach.max() == pytest.approx(2.0 * 67.0, abs=0.1)
    assert logs[1] == ""


@pytest.mark.parametrize(
    "page",
    [
        ReportPage("Nothing", "dock", PLANE),
        ReportPage("No log", "dock", PLANE, tracks={"07": [track()]}),
        ReportPage("Only a log", "dock", PLANE, fixes={"07": log()}),
        ReportPage(
            "Nothing compared", "dock", PLANE, reports={"a": summarise(ScoredPairs.concatenate([]))}
        ),
        ReportPage("No recordings", "dock", PLANE, reports={"a": summarise(boxes())}),
    ],
    ids=lambda page: page.title,
)
def test_a_page_shows_what_there_is(page: ReportPage) -> None:
    found = Page(render_page(page))
    assert found.unbalanced == []
    assert page.title in found.words
    has_map = bool(page.tracks or page.fixes)
    assert ("Map" in found.words) == has_map
    assert len(found.all("script")) == (2 if has_map else 0)


def test_the_page_is_written_whole_or_not_at_all(tmp_path) -> None:
    write_page(full_page(), tmp_path / "new" / "report.html")
    text = (tmp_path / "new" / "report.html").read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert text.rstrip().endswith("</html>")
    with pytest.raises(InputError, match="is a folder"):
        write_page(full_page(), tmp_path / "new")


def errors(along_m, *, covariance=4.0, asked=None, without=0) -> ScoredPairs:
    along = np.asarray(along_m, dtype=float)
    n = along.size
    return ScoredPairs(
        time_utc_s=START + np.arange(n),
        east_m=np.zeros(n),
        north_m=100.0 + along,
        covariance_m2=np.tile(covariance * np.eye(2), (n, 1, 1)),
        true_east_m=np.zeros(n),
        true_north_m=np.full(n, 100.0),
        segment=np.zeros(n, np.int64),
        asked=asked or n,
        without_position=without,
    )


@pytest.mark.parametrize(
    ("pairs", "sentence"),
    [
        (errors([]), "Nothing could be compared with the log"),
        (
            errors(np.linspace(0.0, 20.0, 101)),
            "within 10.0 m of the log, nine in ten within 18.0 m; the worst is 20.0 m off.",
        ),
        (errors(np.full(30, 5.0)), "the error is 5.0 % of the distance"),
        (errors(np.full(30, 5.0)), "too far from the camera, by 5.00 m on average"),
        (errors(np.full(30, -5.0)), "too near to the camera, by 5.00 m on average"),
        (errors(np.tile([-3.0, 3.0], 20)), "Errors are 3.00 m along the line of sight and 0.00"),
        (
            errors(np.full(30, 9.0)),
            "hold 0.0 % of the log's positions: they are too small",
        ),
        (errors(np.full(30, 1.0)), "100 % of the log's positions: they are larger"),
        (
            errors(np.r_[np.full(95, 1.0), np.full(5, 9.0)]),
            "hold 95 % of the log's positions: they can be believed",
        ),
        (errors(np.full(5, 1.0)), "5 positions are too few to judge"),
        (errors(np.full(30, 1.0), covariance=np.nan), "state no uncertainty"),
        (errors(np.tile([-1.0, 1.0], 20)), "Over 1 s a target's movement is off by 2.00 m"),
        (
            errors(np.full(30, 1.0), asked=40, without=4),
            "(75 %): 6 fall outside the log or into its gaps, and the model has no position for 4.",
        ),
    ],
)
def test_the_report_speaks_plainly(pairs: ScoredPairs, sentence: str) -> None:
    said = plain_statements(summarise(pairs))
    assert any(sentence in one for one in said), said


@pytest.mark.parametrize(
    ("p95", "with_log", "sentence"),
    [
        (0.70, 0.85, "hold 85 % of its positions: they are too small. Do not rely on them."),
        (0.78, 0.95, "hold 95 % of its positions: they can be believed."),
        (0.78, 1.0, "and 78 % if it had none: they are not too small, and the log is too inexact"),
        (0.99, 1.0, "hold 100 % of its positions: they are larger than they need to be."),
    ],
)
def test_the_ellipses_are_judged_once_with_the_logs_error_counted(
    p95: float, with_log: float, sentence: str
) -> None:
    report = summarise(errors(np.full(30, 1.0)))
    coverage = replace(report.coverage, reference_sigma_m=1.7, p95=p95, p95_with_log=with_log)
    (said,) = [
        one for one in plain_statements(replace(report, coverage=coverage)) if "ellipses" in one
    ]
    assert said.startswith("With the log's own error of 1.70 m counted,")
    assert sentence in said
    # The tile and the table say the same share as the sentence.
    page = Page(render_page(full_page(reports={"a": replace(report, coverage=coverage)})))
    assert f"{100 * with_log:.0f} %" in page.words.split("in the 95 % ellipse")[1][:20]
    rows = table_cells(render_page(full_page(reports={"a": report_of(coverage)})), "Errors of a")
    assert rows[1][-1] == f"{100 * with_log:.0f} %"


def report_of(coverage: Coverage) -> Report:
    return replace(summarise(errors(np.full(30, 1.0))), coverage=coverage)


@pytest.mark.parametrize(
    ("tracks", "sentence"),
    [
        (
            TracksUsed((2,), 3, "smallest median error"),
            "Track 2, the nearest to the log, was taken",
        ),
        (TracksUsed((1, 4), 5, "smallest median error"), "In each recording the track nearest"),
        (TracksUsed((1, 4), 5, "track_id"), "As asked, tracks 1, 4 were taken"),
        (TracksUsed((4,), 5, "track_id"), "As asked, track 4 was taken"),
    ],
)
def test_the_report_says_which_track_it_scored(tracks: TracksUsed, sentence: str) -> None:
    said = plain_statements(summarise(errors(np.full(30, 1.0)), tracks=tracks))
    assert any(sentence in one for one in said), said


def test_times_are_printed_in_utc() -> None:
    assert clock_time(START) == "2020-09-30 19:36:24 UTC"
    assert clock_time(float("nan")) == "–"


def hostile_page(name: str) -> ReportPage:
    """A page on which every name is the same one."""
    return full_page(
        name,
        title=name,
        scene_name=name,
        model_name=name,
        reports={name: summarise({name: boxes()}), f"{name}, too": summarise({name: boxes()})},
        tracks={name: [track(label=name)], f"{name}2": [track(3, label=name)]},
        model=[ModelRow(name, 1.0, name, 1.0)],
        sources=[SourceRow(name, 1, 0.0, 0.0)],
        outliers=[OutlierRow(name, None, float("nan"), name, 1.0)],
        statements=[name],
        warnings=[name],
        figures=[PageFigure(name, calibration({name: boxes()}), name, name)],
        comparison=Comparison(
            {name: summarise({name: boxes()})}, {name: summarise({name: boxes()})}
        ),
    )


NAMES = {
    "script": HOSTILE,
    "attribute": '"\' onload=\'alert(1)\' onerror="alert(1)" autofocus onfocus=alert(1) x="',
    "comment": "<!--",
    "comment in script": "<!--<script>",
    "character data": "<![CDATA[ ]]> ]]>",
    "style": "</style></title><style>body{background:url(http://127.0.0.1/)}</style>",
    "entity": "&lt;img src=x onerror=alert(1)&gt;&#60;b&#62;",
    "template": "{{ 7 * 7 }}{% for a in b %}${7*7}",
    "svg": "<svg/onload=alert(1)><math><mtext></mtext></math>",
    "address": "javascript:alert(1)",
    "line separator": "a\u2028b\u2029c",
    "control": "a\x1b[31mb\0c\x08",
    "direction": "a\u202eb\u2067c\u200bd\x9be",
    "surrogate": "a\ud800b",
    "long": "x" * 3000,
}


UNSEEN = "[\0-\x08\x0b\x0e-\x1f\x7f-\x9f\u200b-\u200f\u202a-\u202e\u2066-\u2069\ud800]"


def outline(page: Page) -> list[tuple[str, list[str]]]:
    return [(tag, sorted(attributes)) for tag, attributes in page.tags]


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_no_name_makes_an_element_or_an_attribute(name: str, tmp_path: Path) -> None:
    write_page(hostile_page(name), tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    found, harmless = Page(text), Page(render_page(hostile_page("boat")))
    assert outline(found) == outline(harmless)
    assert found.unbalanced == []
    assert len(found.inside["script"]) == 2
    assert found.inside["script"][1] == harmless.inside["script"][1]
    shown = re.sub(r"\s+", " ", re.sub(UNSEEN, "\ufffd", name))
    assert found.words.count(shown) >= 20
    assert found.map_data["series"][0]["name"] == f"track 1, {name}"


def chromium() -> str:
    """A browser; the test is skipped where there is none."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome", "chromium-headless-shell")
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(names)} is on the path")
    return found


@pytest.mark.slow
def test_a_browser_finds_no_markup_in_names_and_fetches_nothing(tmp_path: Path) -> None:
    """One page with all names at once: what Chromium makes of it has the elements of ours alone."""
    browser = chromium()
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.0)
        address = f"http://127.0.0.1:{server.getsockname()[1]}/"
        names = " ".join(NAMES.values()).replace("http://x.example/", address)
        names = names.replace("http://127.0.0.1/", address)
        # The script would write what it ran into the page, and an image ask the server.
        names = names.replace("alert(1)", "document.title='owned'")

        def seen(name: str) -> Page:
            path = tmp_path / "page.html"
            write_page(hostile_page(name), path)
            done = subprocess.run(
                [
                    *(browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"),
                    *(f"--user-data-dir={tmp_path / 'profile'}", path.as_uri()),
                ],
                capture_output=True,
                timeout=120,
                check=False,
            )
            if not done.stdout:
                pytest.skip(f"{browser} does not start here")
            return Page(done.stdout.decode("utf-8", "replace"))

        hostile, harmless = seen(names), seen("boat")
        with pytest.raises(BlockingIOError):
            server.accept()
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in harmless.tags]
    assert outline(hostile) == outline(harmless)
    assert hostile.inside["script"][1] == harmless.inside["script"][1]
    assert hostile.words.count("document.title='owned'") >= 20
