"""`run` says after a minute what it sees, and what to do where nothing moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline import Scene, run
from sightline.cli.run import with_sheet
from sightline.errors import FitError
from sightline.formats import read_boxes
from sightline.pipeline.first_look import FirstLook, FirstLooker, first_look
from sightline.pipeline.fit_unlabelled import associate_scene
from sightline.reporting.run_report import write_found
from sightline.scene import Recording
from sightline.scene.detections import SceneDetections
from sightline.simulation.simulate import Simulation, SimulationSettings, simulate
from sightline.types import NO_TRACK, Boxes, Frame


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    return simulate(
        tmp_path_factory.mktemp("shore"),
        SimulationSettings(
            seed=1, recordings=1, duration_s=80.0, rate_hz=6.0, video=False, shore=True
        ),
    )


@pytest.fixture(scope="module")
def recording(made: Simulation) -> Recording:
    return replace(Scene.load(made.scene).recordings[0], boxes_path=None)


def _of(made: Simulation, moving: bool) -> Boxes:
    times = made.recordings[0].time_utc_s
    boxes = made.harbour.boxes(times, of="all")
    chosen = [boat.identity for boat in made.harbour.boats if boat.path.moves == moving]
    boxes = boxes[np.isin(boxes.track_id, chosen)]
    return boxes.with_columns(track_id=np.full(len(boxes), NO_TRACK, dtype=np.int64))


def test_boats_are_counted_by_whether_they_move(made: Simulation, recording: Recording) -> None:
    times = made.recordings[0].time_utc_s
    moves, rests = _of(made, True), _of(made, False)
    boxes = Boxes.concatenate([moves, rests])
    look = first_look(recording, boxes, times)
    frames = int((times <= times[0] + 60.0).sum())
    assert look.frames == frames
    assert look.seconds == pytest.approx(60.0, abs=0.5)
    until = times[0] + 60.0
    true_moving = (moves.time_utc_s <= until).sum() / frames
    true_moored = (rests.time_utc_s <= until).sum() / frames
    assert look.per_frame(look.moving) == pytest.approx(true_moving, rel=0.1)
    # What is small or was hidden is not told within a minute.
    assert 0.6 * true_moored < look.per_frame(look.moored) <= 1.02 * true_moored
    assert not (look.moving & look.moored).any()
    assert look.log_goes is True
    assert not look.nothing_moves
    (line,) = look.sentences()
    assert f"{look.per_frame(look.moving):.1f} moving" in line
    told = look.to_dict()
    assert told["frames"] == frames
    assert told["nothing_moves"] is False
    assert told["moving_per_frame"] == look.per_frame(look.moving)


def test_it_says_what_to_do_where_only_the_log_moves(
    made: Simulation, recording: Recording
) -> None:
    look = first_look(recording, _of(made, False), made.recordings[0].time_utc_s)
    assert look.nothing_moves
    _, advice = look.sentences()
    for word in ("--detector", "area", "draw boxes"):
        assert word in advice


def test_a_log_that_lies_still_is_no_reason_to_say_so(
    made: Simulation, recording: Recording, tmp_path: Path
) -> None:
    lines = recording.fixes()
    log = tmp_path / "still.csv"
    rows = [f"{t:.3f},{lines.latitude_deg[0]},{lines.longitude_deg[0]}" for t in lines.time_utc_s]
    log.write_text("\n".join(["time_utc,latitude_deg,longitude_deg", *rows]) + "\n")
    still = replace(recording, fixes_path=log)
    look = first_look(still, _of(made, False), made.recordings[0].time_utc_s)
    assert look.log_goes is False
    assert not look.nothing_moves
    nobody = replace(recording, fixes_path=None)
    assert first_look(nobody, _of(made, False), made.recordings[0].time_utc_s).log_goes is None


def test_nothing_at_all_is_seen(recording: Recording, made: Simulation) -> None:
    look = first_look(recording, Boxes.of([]), made.recordings[0].time_utc_s)
    assert look.nothing_moves
    assert "0.0 boats a frame" in look.sentences()[0]


@pytest.mark.slow
def test_a_run_of_a_table_tells_it_before_it_fits(made: Simulation) -> None:
    scene = Scene.load(made.scene)
    scene = replace(scene, recordings=tuple(replace(r, boxes_path=None) for r in scene.recordings))
    seen: list[FirstLook] = []
    try:
        result = run(scene, model="camera", detector="motion", first_look=seen.append)
    except FitError:
        assert seen
    else:
        assert result.first_look is seen[0]
    boxes = read_boxes(made.scene.parent / "detections" / "01.csv")
    (look,) = seen
    assert look.per_frame(np.ones(len(look.boxes), bool)) == pytest.approx(
        (boxes.frame < look.frames).sum() / look.frames, rel=0.02
    )


def test_association_says_that_nothing_moves(
    made: Simulation, recording: Recording, tmp_path: Path
) -> None:
    rests = _of(made, False)
    table = tmp_path / "rests.csv"
    rows = [
        ",".join([str(frame), *(f"{edge:.2f}" for edge in box)])
        for frame, box in zip(rests.frame.tolist(), rests.xyxy_px, strict=True)
    ]
    table.write_text("\n".join(["frame,x1,y1,x2,y2", *rows]) + "\n")
    scene = Scene.load(made.scene)
    still = replace(scene, recordings=(replace(recording, detections_path=table),))
    with pytest.raises(FitError, match="nothing that was found moves while the log does"):
        associate_scene(still, detector=None)


class _Known:
    """A detector that knows the boxes of each frame."""

    name = "known"

    def __init__(self, boxes: Boxes) -> None:
        self._boxes = boxes

    def detect(self, frame: Frame) -> Boxes:
        return self._boxes[self._boxes.frame == frame.index].with_columns(
            time_utc_s=np.full(int((self._boxes.frame == frame.index).sum()), frame.time_utc_s)
        )

    def reset(self) -> None:
        pass


@pytest.mark.slow
def test_a_page_of_what_was_found_is_written(tmp_path: Path) -> None:
    import cv2

    video = simulate(
        tmp_path / "harbour",
        SimulationSettings(
            seed=2, recordings=1, duration_s=30.0, rate_hz=2.0, image_size_px=(640, 360)
        ),
    )
    times = video.recordings[0].time_utc_s
    boxes = video.harbour.boxes(times, of="all")
    boxes = boxes.with_columns(track_id=np.full(len(boxes), NO_TRACK, dtype=np.int64))
    scene = Scene.load(video.scene)
    told: list[FirstLook] = []
    looker = FirstLooker(told.append)
    seen = SceneDetections(scene, _Known(boxes), observer=looker)
    found = seen.boxes(scene.recordings[0])
    (look,) = told
    assert look is looker.look
    assert look.frames == times.size
    assert len(look.boxes) == len(found) == len(boxes)
    assert 3 <= len(look.pictures) <= 10
    assert set(look.pictures) <= set(range(times.size))
    page = tmp_path / "found.png"
    write_found(look, page)
    image = cv2.imread(str(page))
    assert image is not None
    # Four cells of 320 px in a row.
    assert image.shape[1] == 4 * 320
    assert image.std() > 10.0
    # Without pictures there is no page.
    none = tmp_path / "none.png"
    write_found(replace(look, pictures={}), none)
    assert not none.exists()


def test_the_page_is_there_where_a_run_fails(made: Simulation, tmp_path: Path) -> None:
    import cv2

    boxes = _of(made, True)
    first = boxes[boxes.frame == 0]
    good, picture = cv2.imencode(".jpg", np.full((720, 1280, 3), 90, np.uint8))
    assert good
    look = FirstLook(
        recording="01",
        seconds=60.0,
        frames=1,
        boxes=first,
        moving=np.ones(len(first), dtype=bool),
        moored=np.zeros(len(first), dtype=bool),
        log_goes=True,
        pictures={0: picture.tobytes()},
    )
    told = with_sheet(FitError("nobody is recognised"), look, tmp_path / "results")
    assert "results-found.png" in str(told)
    assert (tmp_path / "results-found.png").exists()
    # A file that is there is somebody's.
    again = with_sheet(FitError("nobody is recognised"), look, tmp_path / "results")
    assert str(again) == "nobody is recognised"
    assert str(with_sheet(FitError("no"), None, tmp_path / "other")) == "no"
