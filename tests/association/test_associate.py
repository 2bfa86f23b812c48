"""Who is who: simulated feeds whose truth is known, refusals, and a real recording."""

from dataclasses import replace

import numpy as np
import pyais
import pytest
from _support.traffic import Traffic

from sightline.association import associate
from sightline.association.observations import observe
from sightline.association.search import RecordingObservations
from sightline.detection import LowerEdge
from sightline.errors import FitError, InputError
from sightline.formats import read_ais_feed, write_boxes
from sightline.pipeline.evaluate import place_boxes, score
from sightline.pipeline.fit_unlabelled import associate_scene, fit_association
from sightline.scene import Scene
from sightline.types import Boxes, to_datetime64


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
def test_the_vessels_in_view_are_found_in_a_feed_and_no_others(seed):
    traffic = Traffic.random(seed, vessels=25)
    boxes, owner = traffic.boxes(), traffic.owner()
    watch = RecordingObservations("one", observe(boxes), tuple(traffic.paths().values()))
    found = associate([watch], traffic.camera.image_size_px)
    assert {int(one.vessel) for one in found.found} == set(traffic.in_view)
    assert found.offset_s["one"] == pytest.approx(-37.0, abs=1.0)
    turn = (found.camera.heading_deg - traffic.camera.heading_deg + 180.0) % 360.0 - 180.0
    assert abs(turn) < 2.5
    for one in found.found:
        own = owner == int(one.vessel)
        assert (one.taken & own).sum() > 0.7 * own.sum()
        assert (one.taken & ~own).sum() < 0.1 * one.taken.sum()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_the_log_of_a_vessel_that_was_never_in_view_is_refused(seed):
    traffic = Traffic.random(seed, vessels=12)
    elsewhere = [path for mmsi, path in traffic.paths().items() if mmsi not in traffic.in_view]
    seen = observe(traffic.boxes())
    with pytest.raises(FitError, match="no logged vessel can be told"):
        associate(
            [RecordingObservations("one", seen, (elsewhere[seed],))], traffic.camera.image_size_px
        )


def test_nobody_is_recognised_without_boxes_or_without_a_log():
    traffic = Traffic.random(0, vessels=6)
    seen, path = observe(traffic.boxes()), next(iter(traffic.paths().values()))
    for watch in (
        RecordingObservations("a", observe(Boxes.of([])), (path,)),
        RecordingObservations("a", seen, ()),
    ):
        with pytest.raises(FitError, match="no recording has both"):
            associate([watch], (1280, 720))


@pytest.mark.slow
def test_a_real_boat_is_found_among_clutter_and_its_boxes_teach_the_camera(data_dir):
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    only = replace(scene, recordings=(replace(scene["07"], boxes_path=None),))
    found = associate_scene(only)
    taken, boxes = found.found[0].taken, found.watches[0].seen.boxes
    drawn = scene["07"].boxes()
    frame, first = np.unique(drawn.frame, return_index=True)
    edges = drawn.xyxy_px[first]
    # Where drawn boxes are at most 400 frames apart, the boat is between them.
    before = frame[np.clip(np.searchsorted(frame, boxes.frame, side="right") - 1, 0, None)]
    after = frame[np.clip(np.searchsorted(frame, boxes.frame), 0, frame.size - 1)]
    judged = after - before <= 400
    boat = np.stack([np.interp(boxes.frame, frame, edge) for edge in edges.T], axis=1)
    xyxy = boxes.xyxy_px
    on_boat = (
        (np.minimum(boat[:, 2], xyxy[:, 2]) > np.maximum(boat[:, 0], xyxy[:, 0]))
        & (np.minimum(boat[:, 3], xyxy[:, 3]) > np.maximum(boat[:, 1], xyxy[:, 1]))
        & judged
    )
    assert (taken & on_boat).sum() >= 0.9 * on_boat.sum()
    assert (taken & judged & ~on_boat).sum() <= 0.05 * (taken & judged).sum()
    assert found.evidence - found.runner_up > 5.0
    others = scene.without(["07"])
    model = fit_association(only, found, "camera")
    assert abs(model.report.clock_offset_s["07"]) < 1.0
    assert score(place_boxes(others, lambda _: model)).ape.rmse < 12.0
    # Without pictures nothing tells where the horizon is.
    blind = replace(only, recordings=(replace(only.recordings[0], frames_path=None),))
    model = fit_association(blind, found, "camera")
    assert score(place_boxes(others, lambda _: model)).ape.rmse < 25.0


def ais_file(path, traffic):
    """The feed as sentences with the times of their reception."""
    lines = []
    for mmsi, log in traffic.reports().items():
        for i in range(len(log.time_utc_s)):
            fields = {
                "type": 1 if log.class_a else 18,
                "mmsi": mmsi,
                "lat": float(log.latitude_deg[i]),
                "lon": float(log.longitude_deg[i]),
                "speed": float(log.speed_mps[i] * 3600.0 / 1852.0),
                "course": float(log.course_deg[i]),
                "second": int(log.time_utc_s[i]) % 60,
            }
            stamp = str(to_datetime64(log.time_utc_s[i]))[:19]
            lines.append((log.time_utc_s[i], f"{stamp}Z {pyais.encode_dict(fields)[0]}"))
    path.write_text("\n".join(line for _, line in sorted(lines)) + "\n", encoding="ascii")


@pytest.mark.slow
def test_a_feed_in_a_file_teaches_a_scene_without_drawn_boxes(tmp_path):
    traffic = Traffic.random(4, vessels=12, unlogged=0)
    ais_file(tmp_path / "ais.nmea", traffic)
    feed = read_ais_feed(tmp_path / "ais.nmea")
    told = traffic.reports()[traffic.in_view[0]]
    read = feed[traffic.in_view[0]].velocity_mps
    np.testing.assert_allclose(read, told.velocity_mps, atol=0.06)
    write_boxes(traffic.boxes(), tmp_path / "seen.csv")
    (tmp_path / "scene.toml").write_text(
        f"""[camera]
latitude_deg = {traffic.plane.latitude_deg}
longitude_deg = {traffic.plane.longitude_deg}
image_size_px = [1280, 720]
[[recordings]]
name = "one"
detections = "seen.csv"
fixes = "ais.nmea"
""",
        encoding="utf-8",
    )
    scene = Scene.load(tmp_path / "scene.toml")
    found = associate_scene(scene)
    assert {int(one.vessel) for one in found.found} == set(traffic.in_view)
    model = fit_association(scene, found, "camera")
    assert model.camera is not None
    assert model.camera.height_m == pytest.approx(traffic.camera.height_m, rel=0.2)
    assert any("Recognised without drawn boxes" in s for s in model.report.statements)
    # The detector leaves water below the hulls, as was measured; nothing else tells it from pitch.
    seen = traffic.boxes()
    low = seen.xyxy_px.copy()
    low[:, 3] += 3.0 + 0.15 * (low[:, 3] - low[:, 1])
    measured = seen.with_columns(xyxy_px=low, source=np.full(len(seen), "measured"))
    write_boxes(measured, tmp_path / "seen.csv")
    low_found = associate_scene(scene)
    edge = LowerEdge(px=3.0, share=0.15, spread_px=0.3)
    told = fit_association(scene, low_found, "camera", lower_edges={"measured": edge})
    untold = fit_association(scene, low_found, "camera")
    # Of the pitch the principal point may take a part; the level line is that of both.
    off = [
        abs(
            one.camera.pitch_deg
            - np.degrees(np.arctan(one.camera.principal_dy_px / one.camera.focal_px))
            - traffic.camera.pitch_deg
        )
        for one in (told, untold)
    ]
    assert off[0] < 0.5 * off[1]


def test_what_cannot_be_recognised_is_said_in_one_line(tmp_path):
    traffic = Traffic.random(0, vessels=6, duration_s=60.0)
    write_boxes(traffic.boxes(), tmp_path / "seen.csv")
    (tmp_path / "log.csv").write_text(
        "time_utc,latitude_deg,longitude_deg\n"
        "2001-01-01T00:00:00Z,54.3,10.1\n2001-01-01T00:00:05Z,54.3,10.1\n",
        encoding="utf-8",
    )
    place = "latitude_deg = 54.3233\nlongitude_deg = 10.1394\n"
    rest = (
        'image_size_px = [1280, 720]\n[[recordings]]\nname = "one"\n'
        'detections = "seen.csv"\nfixes = "log.csv"\n'
    )
    (tmp_path / "apart.toml").write_text(f"[camera]\n{place}{rest}", encoding="utf-8")
    with pytest.raises(InputError, match="does not overlap"):
        associate_scene(Scene.load(tmp_path / "apart.toml"))
    (tmp_path / "nowhere.toml").write_text(f"[camera]\n{rest}", encoding="utf-8")
    with pytest.raises(FitError, match="say where the camera stands"):
        associate_scene(Scene.load(tmp_path / "nowhere.toml"))
