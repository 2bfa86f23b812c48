"""What the page of drawing is answered, and who may change something."""

from __future__ import annotations

import csv
import io
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from web_drawing import small_scene
from web_moments import HOSTILE

from sightline.labelling.drawing import Drawing
from sightline.web.access import HEADERS, Guard
from sightline.web.draw_app import build_draw_app
from sightline.web.workbench import Workbench

TOKEN = "a token of some length"
BOX = {"frame": 2, "box_px": [4.0, 5.0, 20.5, 30.25]}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return small_scene(tmp_path)


@pytest.fixture
def drawing(scene: Path) -> Iterator[Drawing]:
    made = Drawing(scene, annotator="ada")
    yield made
    made.close()


def client(drawing: Drawing, scene: Path, *, token: str | None = None, **options) -> TestClient:
    bench = Workbench(scene, drawing, **options)
    app = Guard(build_draw_app(bench), token, 8081)
    return TestClient(app, base_url="http://127.0.0.1:8081", follow_redirects=False)


@pytest.fixture
def asked(drawing: Drawing, scene: Path) -> TestClient:
    return client(drawing, scene)


def rows(scene: Path) -> list[dict[str, str]]:
    path = scene.parent / "boxes" / "01.csv"
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_a_box_is_in_the_table_when_it_is_answered(asked: TestClient, scene: Path) -> None:
    answer = asked.put("/api/boxes", json=BOX)
    assert answer.status_code == 200
    (box,) = answer.json()["boxes"]
    assert (box["frame"], box["box_px"], box["annotator"]) == (2, BOX["box_px"], "ada")
    (row,) = rows(scene)
    assert [float(row[name]) for name in ("frame", "x1", "y1", "x2", "y2")] == [
        2,
        4,
        5,
        20.5,
        30.25,
    ]
    assert asked.request("DELETE", "/api/boxes", json={"frame": 2}).json()["boxes"] == []
    assert rows(scene) == []
    assert asked.post("/api/undo", json={}).json()["count"] == 1
    assert len(rows(scene)) == 1
    assert asked.post("/api/redo", json={}).json()["boxes"] == []
    assert [asked.post("/api/redo", json={}).json()["count"] for _ in range(2)] == [0, 0]


def test_what_is_shown_is_told(asked: TestClient) -> None:
    about = asked.get("/api/scene").json()
    assert about["frame_size_px"] == [64, 48]
    assert (about["recording"], about["annotator"], about["shore"]) == ("01", "ada", False)
    frames = asked.get("/api/frames").json()
    assert frames["frame"] == [0, 1, 2, 3, 4, 5]
    assert frames["time_utc_s"][1] - frames["time_utc_s"][0] == pytest.approx(1.0)
    state = asked.get("/api/state").json()
    assert set(state["suggested"]) <= set(frames["frame"])
    assert state["advice"]["rmse_m"] is None
    assert asked.get("/api/state").headers["cache-control"] == "no-store"


def test_pictures_are_those_of_the_recording(asked: TestClient, scene: Path) -> None:
    true = np.asarray(Image.open(scene.parent / "frames" / "000003.png").convert("RGB"))
    whole = asked.get("/frames/3.jpg")
    assert whole.headers["content-type"] == "image/jpeg"
    seen = np.asarray(Image.open(io.BytesIO(whole.content)).convert("RGB"))
    assert seen.shape == true.shape
    assert np.abs(seen.astype(int) - true).mean() < 12.0
    part = asked.get("/frames/3.png", params={"x": 40, "y": 30, "width": 32, "height": 10})
    crop = np.asarray(Image.open(io.BytesIO(part.content)).convert("RGB"))
    # Cut where the picture ends, and without a loss.
    np.testing.assert_array_equal(crop, true[30:40, 40:64])


@pytest.mark.parametrize(
    "path",
    [
        *("/frames/6.jpg", "/frames/-1.jpg", "/frames/x.jpg", "/frames/99999999999999999999.jpg"),
        *("/frames/../scene.toml", "/frames/..%2Fscene.toml.jpg", "/frames/1.5.jpg"),
        *("/frames/3.png", "/frames/3.png?x=0&y=0&width=9999&height=1"),
        *("/frames/3.png?x=64&y=0&width=1&height=1", "/frames/3.png?x=-1&y=0&width=1&height=1"),
        *("/static/../workbench.py", "/static/%2Fetc%2Fpasswd", "/api/nothing"),
    ],
)
def test_there_is_nothing_else(path: str, asked: TestClient) -> None:
    answer = asked.get(path)
    assert answer.status_code in (404, 422)
    assert HEADERS.items() <= answer.headers.items()


@pytest.mark.parametrize(
    "body",
    [
        *("", "{", "[]", "null", "1", "{}", "[" * 60_000, '"' + "x" * 60_000 + '"'),
        '{"frame": 2}',
        '{"frame": "2", "box_px": [4, 5, 20, 30]}',
        '{"frame": 2.5, "box_px": [4, 5, 20, 30]}',
        '{"frame": true, "box_px": [4, 5, 20, 30]}',
        '{"frame": -1, "box_px": [4, 5, 20, 30]}',
        '{"frame": 6, "box_px": [4, 5, 20, 30]}',
        '{"frame": 1e999, "box_px": [4, 5, 20, 30]}',
        '{"frame": 9007199254740993000000000, "box_px": [4, 5, 20, 30]}',
        '{"frame": 2, "box_px": [4, 5, 20]}',
        '{"frame": 2, "box_px": [4, 5, 20, 30, 40]}',
        '{"frame": 2, "box_px": [4, 5, 20, NaN]}',
        '{"frame": 2, "box_px": [4, 5, 20, Infinity]}',
        '{"frame": 2, "box_px": [4, 5, 20, 1e999]}',
        '{"frame": 2, "box_px": [4, 5, 20, "30"]}',
        '{"frame": 2, "box_px": [4, 5, 20, null]}',
        '{"frame": 2, "box_px": [20, 5, 4, 30]}',
        '{"frame": 2, "box_px": [4, 5, 4, 30]}',
        '{"frame": 2, "box_px": [4, 5, 20, 49]}',
        '{"frame": 2, "box_px": [-1, 5, 20, 30]}',
        '{"frame": 2, "box_px": [4, 5, 20, 30], "annotator": "eve"}',
        '{"frame": 2, "box_px": [4, 5, 20, 30], "path": "/etc/passwd"}',
    ],
)
def test_a_box_that_is_none_is_refused_in_a_line(body: str, asked: TestClient, scene: Path) -> None:
    before = scene.read_bytes()
    answer = asked.put("/api/boxes", content=body, headers={"content-type": "application/json"})
    assert answer.status_code in (400, 422)
    said = answer.json()
    assert len(said.get("reason", said.get("detail"))) < 600
    assert rows(scene) == []
    assert scene.read_bytes() == before


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/api/follow", {"frame": 2, "count": 0}),
        ("POST", "/api/follow", {"frame": 2, "count": 10**9}),
        ("POST", "/api/follow", {"frame": 2, "forward": "yes"}),
        ("POST", "/api/follow", {"frame": 77}),
        ("DELETE", "/api/boxes", {"frame": 77}),
        ("POST", "/api/place", {"place": "x" * 2001}),
        ("POST", "/api/points", {"pixel_px": [1, 2], "place": "nowhere"}),
        ("POST", "/api/points", {"pixel_px": [1, 99], "place": "54.32, 10.14"}),
        ("POST", "/api/points", {"pixel_px": [1, 2, 3], "place": "54.32, 10.14"}),
        ("POST", "/api/points", {"pixel_px": [1, 2], "place": "54.32, 10.14", "name": "x" * 101}),
        ("PUT", "/api/points", {"number": 1, "pixel_px": [1, 2], "place": "54.32, 10.14"}),
        ("PUT", "/api/points", {"number": 0, "pixel_px": [1, 2], "place": "54.32, 10.14"}),
        ("DELETE", "/api/points", {"number": 3}),
    ],
)
def test_other_changes_have_bounds(
    method: str, path: str, body: dict[str, object], asked: TestClient, scene: Path
) -> None:
    before = {one: one.read_bytes() for one in scene.parent.rglob("*") if one.is_file()}
    answer = asked.request(method, path, json=body)
    assert answer.status_code == 422
    assert "\n" not in answer.json()["reason"]
    assert {one: one.read_bytes() for one in scene.parent.rglob("*") if one.is_file()} == before


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"origin": "http://127.0.0.1:8081", "sec-fetch-site": "same-origin"}, 200),
        ({"origin": "http://127.0.0.1:9999"}, 403),
        ({"origin": "https://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"sec-fetch-site": "cross-site"}, 403),
        ({"sec-fetch-site": "same-site"}, 403),
        ({"origin": "http://127.0.0.1:8081", "sec-fetch-site": "cross-site"}, 403),
        ({"host": "evil.example"}, 421),
        ({"content-type": "text/plain"}, 415),
        ({"content-type": "application/x-www-form-urlencoded"}, 415),
        ({"content-type": "application/json; charset=utf-8"}, 200),
    ],
)
def test_only_a_page_of_ours_changes_something(
    headers: dict[str, str], status: int, asked: TestClient, scene: Path
) -> None:
    body = json.dumps(BOX)
    sent = {"content-type": "application/json", **headers}
    assert asked.put("/api/boxes", content=body, headers=sent).status_code == status
    assert len(rows(scene)) == (status == 200)


@pytest.mark.parametrize("method", ["PUT", "DELETE"])
def test_without_the_token_nothing_is_told_or_changed(
    method: str, drawing: Drawing, scene: Path
) -> None:
    asked = client(drawing, scene, token=TOKEN)
    for path in ("/", "/api/scene", "/api/state", "/frames/2.jpg", "/static/draw.mjs"):
        assert asked.get(path).status_code == 401
    assert asked.request(method, "/api/boxes", json=BOX).status_code == 401
    wrong = {"authorization": f"Bearer {TOKEN}x"}
    assert asked.request(method, "/api/boxes", json=BOX, headers=wrong).status_code == 401
    assert rows(scene) == []
    right = {"authorization": f"Bearer {TOKEN}"}
    assert asked.put("/api/boxes", json=BOX, headers=right).status_code == 200
    assert len(rows(scene)) == 1


def test_more_than_a_box_takes_is_not_taken(asked: TestClient, scene: Path) -> None:
    body = json.dumps({**BOX, "more": "x" * 70_000})
    sent = {"content-type": "application/json"}
    assert asked.put("/api/boxes", content=body, headers=sent).status_code == 413

    def parts() -> Iterator[bytes]:
        # Nothing says how long it is.
        for _ in range(1000):
            yield b" " * 1000

    assert asked.put("/api/boxes", content=parts(), headers=sent).status_code == 413
    assert rows(scene) == []


def test_changes_are_asked_for_by_their_own_methods(asked: TestClient) -> None:
    for path in ("/api/undo", "/api/redo", "/api/follow", "/api/place", "/api/points/undo"):
        assert asked.get(path).status_code == 405
    assert asked.post("/api/boxes", json=BOX).status_code == 405


def test_several_people_see_each_other_and_keep_their_own(scene: Path) -> None:
    with_names = {}
    for name in ("ada", "bob"):
        drawing = Drawing(scene, annotator=name)
        with_names[name] = client(drawing, scene)
    left, right = [4.0, 5.0, 20.0, 30.0], [5.0, 5.0, 21.0, 31.0]
    assert with_names["ada"].put("/api/boxes", json={"frame": 1, "box_px": left}).is_success
    assert with_names["bob"].put("/api/boxes", json={"frame": 1, "box_px": right}).is_success
    for one in with_names.values():
        boxes = one.get("/api/state").json()["boxes"]
        assert {box["annotator"]: box["box_px"] for box in boxes} == {"ada": left, "bob": right}
    refused = with_names["bob"].request("DELETE", "/api/boxes", json={"frame": 1})
    assert refused.is_success
    assert [row["annotator"] for row in rows(scene)] == ["ada"]


def test_boxes_that_are_drawn_at_the_same_time_are_all_kept(asked: TestClient, scene: Path) -> None:
    def put(frame: int) -> None:
        answer = asked.put("/api/boxes", json={**BOX, "frame": frame})
        assert answer.status_code == 200, answer.text

    threads = [threading.Thread(target=put, args=(frame,)) for frame in range(6)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert sorted(int(row["frame"]) for row in rows(scene)) == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("place", ["", "nowhere", "91, 10", "54.3", "\ud800", "1" * 2000])
def test_a_place_that_is_none_yet_is_told(place: str, asked: TestClient) -> None:
    answer = asked.post(
        "/api/place",
        content=json.dumps({"place": place}),
        headers={"content-type": "application/json"},
    )
    assert answer.status_code in (200, 422)
    assert "\n" not in answer.json()["reason"]
    assert len(answer.json()["reason"]) > 10


def test_a_control_point_is_a_pixel_and_a_place(asked: TestClient, scene: Path) -> None:
    place = asked.post("/api/place", json={"place": "54°19.398'N 10°08.364'E"}).json()
    assert place["latitude_deg"] == pytest.approx(54.0 + 19.398 / 60.0)
    assert place["longitude_deg"] == pytest.approx(10.0 + 8.364 / 60.0)
    name = "pier \u202e\x1b" + HOSTILE[:60]
    sent = {"pixel_px": [12.5, 30.25], "place": "54.3233, 10.1394", "name": name}
    (point,) = asked.post("/api/points", json=sent).json()["points"]
    assert point["pixel_px"] == [12.5, 30.25]
    assert (point["latitude_deg"], point["longitude_deg"]) == (54.3233, 10.1394)
    # What cannot be seen, or sends a terminal something, is not kept.
    assert point["name"].startswith("pier \ufffd\ufffd</script>")
    from sightline.scene import Scene

    kept = Scene.load(scene).control_points
    assert kept.pixel_px.tolist() == [[12.5, 30.25]]
    moved = {"number": 1, "pixel_px": [13.0, 31.0], "place": "54.3234, 10.1395"}
    assert asked.put("/api/points", json=moved).json()["points"][0]["pixel_px"] == [13.0, 31.0]
    assert asked.post("/api/points/undo", json={}).json()["points"][0]["pixel_px"] == [12.5, 30.25]
    assert asked.request("DELETE", "/api/points", json={"number": 1}).json()["points"] == []


def test_the_shore_is_shown_where_it_was_given(drawing: Drawing, scene: Path) -> None:
    assert client(drawing, scene).get("/shore.geojson").status_code == 404
    asked = client(drawing, scene, shore=b'{"type": "FeatureCollection", "features": []}')
    assert asked.get("/shore.geojson").json()["features"] == []
    assert asked.get("/api/scene").json()["shore"] is True
