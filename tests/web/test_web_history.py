"""What was kept, replayed: over HTTP, and on the page in a real browser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from web_browser import Browser, browser
from web_moments import PLANE, START, harbour

from sightline.area import Line
from sightline.geodesy import LocalPlane
from sightline.live.boundaries import BoundaryWatch
from sightline.live.store import KeptMoments, Store
from sightline.moment import BoundaryState, Moment, UnseenVessel
from sightline.web.app import build_app
from sightline.web.hub import Hub
from sightline.web.server import LiveServer

PERIOD_S = 0.5


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten minutes of the harbour, twice a second."""
    path = tmp_path_factory.mktemp("kept") / "dock.db"
    kept = Store(path, camera="dock", plane=PLANE)
    kept.keep([harbour(PERIOD_S * k) for k in range(1200)])
    kept.close()
    return path


@pytest.fixture
def client(store: Path) -> TestClient:
    hub = Hub()
    hub.kept = KeptMoments(store)
    return TestClient(build_app(hub), base_url="http://127.0.0.1")


def test_what_was_kept_is_given_back_as_it_was_published(client: TestClient) -> None:
    extent = client.get("/api/kept").json()
    assert extent == pytest.approx({"from_utc_s": START, "to_utc_s": START + 599.5})
    told = client.get("/api/replay", params={"at": START + 100.0, "seconds": 10.0}).json()
    assert told["step_s"] == 1.0
    # The last of each second.
    times = [one["time_utc"] for one in told["moments"]]
    assert times == [json.loads(harbour(100.5 + k).text)["time_utc"] for k in range(10)]
    published = harbour(100.5).to_message()
    (first, *_) = told["moments"]
    assert first["camera"] == "dock"
    for one, other in zip(first["targets"], published["targets"], strict=True):  # type: ignore[arg-type]
        for name in ("id", "latitude_deg", "longitude_deg", "covariance_m2", "state", "mmsi"):
            assert one[name] == other[name]
        assert one["name"] == other["name"]


def test_a_long_part_has_few_moments_and_one_outside_none(client: TestClient) -> None:
    told = client.get("/api/replay", params={"at": START, "seconds": 86400.0}).json()
    assert told["step_s"] == 720.0
    assert len(told["moments"]) == 1
    assert client.get("/api/replay", params={"at": 0.0}).json()["moments"] == []


@pytest.mark.parametrize(
    "query",
    [
        *("", "at=", "at=x", "at=nan", "at=inf", "at=-1", "at=1e300"),
        *("at=1&seconds=0", "at=1&seconds=-1", "at=1&seconds=86401", "at=1&seconds=nan"),
    ],
)
def test_what_cannot_be_asked_is_refused(client: TestClient, query: str) -> None:
    assert client.get(f"/api/replay?{query}").status_code == 422


def test_without_a_store_and_with_one_that_is_damaged(tmp_path: Path) -> None:
    hub = Hub()
    asking = TestClient(build_app(hub), base_url="http://127.0.0.1")
    assert asking.get("/api/kept").status_code == 404
    (tmp_path / "notes.db").write_text("these are notes\n" * 100, encoding="utf-8")
    for name in ("notes.db", "none.db"):
        hub.kept = KeptMoments(tmp_path / name)
        assert asking.get("/api/kept").status_code == 503
        assert asking.get("/api/replay?at=1").status_code == 503
    assert not (tmp_path / "none.db").exists()


def test_it_is_read_while_it_is_written_to(tmp_path: Path) -> None:
    kept = Store(tmp_path / "dock.db", camera="dock", plane=PLANE)
    reader = KeptMoments(kept.path)
    assert reader.extent_utc_s() is None
    kept.keep([harbour(0.0)])
    assert reader.extent_utc_s() == (START, START)
    kept.keep([harbour(1.0)])
    assert len(reader.moments(START, 5.0)) == 2
    kept.close()


def test_metrics_have_lines_and_zones_by_name() -> None:
    states = [
        BoundaryState('the "gate"', "line", left_to_right=3, right_to_left=1).to_message(),
        BoundaryState(
            "basin", "zone", inside=2, entries=5, exits=3, mean_dwell_s=61.5
        ).to_message(),
    ]
    hub = Hub(health=lambda: {"state": "ok", "boundaries": states})
    text = TestClient(build_app(hub), base_url="http://127.0.0.1").get("/metrics").text
    head = 'sightline_line_crossings_total{camera="",boundary="the \\"gate\\""'
    assert f'{head},direction="left_to_right"}} 3.0' in text
    assert f'{head},direction="right_to_left"}} 1.0' in text
    assert text.count("# TYPE sightline_line_crossings_total counter") == 1
    assert 'sightline_zone_inside{camera="",boundary="basin"} 2.0' in text
    assert 'sightline_zone_mean_dwell_seconds{camera="",boundary="basin"} 61.5' in text
    assert "longest_dwell" not in text


@pytest.fixture(scope="module")
def page(
    store: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[LiveServer, Browser]]:
    server = LiveServer("127.0.0.1:0", health=lambda: {"state": "ok"})
    corners = np.array([[10.1394, 54.325], [10.1414, 54.325]])
    watch = BoundaryWatch(LocalPlane(54.3, 10.1), lines={"<b>gate</b>": Line(corners)})
    server.hub.kept = KeptMoments(store)
    server.hub.boundaries = watch.geojson()
    server.start()
    server.publish(_live())
    try:
        with browser(tmp_path_factory.mktemp("page")) as made:
            made.size(1400, 900)
            made.open(server.url)
            yield server, made
    finally:
        server.close()


def _live() -> Moment:
    now = harbour(2000.0)
    return Moment(
        now.time_utc_s,
        now.capture,
        now.camera,
        now.targets,
        now.frame_size_px,
        unseen=(UnseenVessel(211999999, "GHOST", 54.3245, 10.1400, 12.0, 30.0),),
        boundaries=(BoundaryState("<b>gate</b>", "line", left_to_right=2),),
    )


@pytest.mark.slow
def test_the_slider_replays_and_goes_back_to_live(page: tuple[LiveServer, Browser]) -> None:
    _, made = page
    made.until("!sightline.replay.toggleButton.hidden && sightline.state.moment")
    made.press("r")
    made.until("sightline.state.replayed?.targets.length > 0")
    assert "replay" in made.evaluate("document.getElementById('status').textContent")
    # By the keyboard: the slider has the focus, and a step is a second.
    assert made.evaluate("document.activeElement.id") == "replay-time"
    at_s = START + 200.0
    made.evaluate(f"sightline.replay.seek({at_s})")
    made.until(f"Math.abs(Date.parse(sightline.state.replayed.time_utc) / 1000 - {at_s}) <= 1")
    shown = made.evaluate(
        "sightline.state.replayed.targets.map((one) => [one.id, one.latitude_deg])"
    )
    time_s = made.evaluate("Date.parse(sightline.state.replayed.time_utc) / 1000")
    kept = harbour(time_s - START).to_message()["targets"]
    assert shown == [[one["id"], one["latitude_deg"]] for one in kept]  # type: ignore[union-attr, attr-defined]
    # What comes meanwhile does not disturb.
    page[0].publish(_live())
    assert made.evaluate("sightline.state.replayed !== null")
    made.evaluate("sightline.replay.play()")
    made.until(f"sightline.replay.atS > {at_s} + 1")
    made.evaluate("document.activeElement.blur()")
    made.press("r")
    made.until("sightline.state.replayed === null")
    assert made.complaints == []


@pytest.mark.slow
def test_filters_lines_and_vessels_that_nobody_sees(page: tuple[LiveServer, Browser]) -> None:
    server, made = page
    server.publish(_live())
    made.until("sightline.state.moment?.vessels_without_target?.length === 1")
    count = "document.querySelectorAll('#targets tr').length"
    made.until(f"{count} === 8")
    wanted = {"named": 4, "unnamed": 4, "moored": 2, "moving": 6, "all": 8}
    for name, number in wanted.items():
        made.evaluate(
            f"(() => {{ const one = document.getElementById('filter'); one.value = '{name}';"
            " one.dispatchEvent(new Event('change')); })()"
        )
        made.until(f"{count} === {number}")
    titles = "sightline.chart.map.querySourceFeatures('{}').map((one) => one.properties.title)"
    made.until(f"{titles.format('unseen')}.includes('GHOST')")
    made.until(f"{titles.format('boundaries')}.includes('<b>gate</b>: 2 → 0 ←')")
    assert made.complaints == []
