"""Boxes drawn in a recording: written at once, several people at a time, taken back."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from drawable import Drawable, rows
from numpy.testing import assert_allclose

from sightline import InputError, Scene, fit
from sightline.errors import OutputError
from sightline.labelling import Drawing
from sightline.labelling.box_table import BoxTable
from sightline.types import Boxes

BOX = (100.0, 300.0, 160.0, 330.25)


@contextmanager
def opened(drawable: Drawable, annotator: str = "ada") -> Iterator[Drawing]:
    drawing = Drawing(drawable.scene, annotator=annotator)
    try:
        yield drawing
    finally:
        drawing.close()


def states(drawing: Drawing) -> dict[int, str]:
    return {one.frame: one.state for one in drawing.frames() if one.state != "none"}


def test_the_first_box_begins_a_table_that_the_scene_names(drawable: Drawable) -> None:
    before = drawable.scene.read_text(encoding="utf-8").splitlines()
    with opened(drawable) as drawing:
        assert drawing.frame_size_px == (1280, 720)
        assert drawing.picture(3).shape == (720, 1280, 3)
        drawing.accept(7, BOX)
        assert (
            drawable.table.read_text() == "frame,x1,y1,x2,y2,annotator\n7,100,300,160,330.25,ada\n"
        )
        assert states(drawing) == {7: "drawn"}
    boxes = Scene.load(drawable.scene)["dock"].boxes()
    assert_allclose(boxes.xyxy_px, [BOX])
    assert boxes.source.tolist() == ["ada"]
    after = drawable.scene.read_text(encoding="utf-8").splitlines()
    assert [line for line in after if line not in before] == ['boxes = "boxes/dock.csv"']


def test_frames_know_their_times_and_their_log(drawable: Drawable) -> None:
    with opened(drawable) as drawing:
        frames = drawing.frames()
    assert [one.frame for one in frames] == list(range(drawable.count))
    assert_allclose(np.diff([one.time_utc_s for one in frames]), 2.0, atol=1e-6)
    assert all(one.position_known and one.gap_s <= 0.5 for one in frames)


def test_changes_are_taken_back_and_made_again(drawable: Drawable) -> None:
    with opened(drawable) as drawing:
        drawing.accept(7, BOX)
        drawing.accept(7, (100.0, 300.0, 160.0, 331.0))
        drawing.accept(3, BOX)
        drawing.remove(7)
        history = [rows(drawable.table)]
        while drawing.undo():
            history.append(rows(drawable.table))
        assert history == [
            [(3, 330.25, "ada")],
            [(3, 330.25, "ada"), (7, 331.0, "ada")],
            [(7, 331.0, "ada")],
            [(7, 330.25, "ada")],
            [],
        ]
        while drawing.redo():
            history.append(rows(drawable.table))
        assert history[5:] == history[3::-1]
        drawing.undo()
        drawing.accept(9, BOX)
        assert not drawing.redo()


def test_two_people_draw_the_same_frame(drawable: Drawable) -> None:
    with opened(drawable) as ada, opened(drawable, "bob") as bob:
        ada.accept(7, BOX)
        bob.accept(7, (100.0, 300.0, 160.0, 335.0))
        ada.accept(7, (100.0, 300.0, 160.0, 332.0))
        expected = [(7, 332.0, "ada"), (7, 335.0, "bob")]
        assert sorted(rows(drawable.table)) == expected
        for one in (ada, bob):
            assert sorted((box.frame, box.y2, box.annotator) for box in one.boxes()) == expected
        assert ada.undo()
        assert bob.undo()
        assert rows(drawable.table) == [(7, 330.25, "ada")]
        with pytest.raises(
            InputError, match="its box is by ada, and bob removes only boxes of bob"
        ):
            bob.remove(7)


def test_one_name_in_two_places_overwrites_nothing(drawable: Drawable) -> None:
    with opened(drawable) as here, opened(drawable) as there:
        here.accept(7, BOX)
        with pytest.raises(InputError, match="changed by somebody else meanwhile"):
            there.accept(7, (1.0, 2.0, 3.0, 4.0))
        assert rows(drawable.table) == [(7, 330.25, "ada")]
        # Now it has been seen.
        there.accept(7, (100.0, 300.0, 160.0, 340.0))
        with pytest.raises(InputError, match="changed by somebody else meanwhile"):
            here.undo()
        assert not here.undo()
        assert rows(drawable.table) == [(7, 340.0, "ada")]


PROCESS = """
    import sys
    from pathlib import Path
    from sightline.labelling.box_table import BoxTable
    scene, name, first = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    table = BoxTable(scene, "dock", None, (1280, 720))
    for frame in range(first, first + 15):
        table.rows()
        table.put(frame, name, [(1.0, 2.0, 3.0, 4.0 + frame)])
"""


@pytest.mark.slow
def test_two_processes_lose_nothing(drawable: Drawable) -> None:
    """Both begin the table, and write to it as fast as they can."""
    script = textwrap.dedent(PROCESS)
    running = [
        subprocess.Popen([sys.executable, "-c", script, str(drawable.scene), name, first])
        for name, first in (("ada", "0"), ("bob", "5"))
    ]
    assert [one.wait(timeout=120) for one in running] == [0, 0]
    wanted = [(frame, 4.0 + frame, "ada") for frame in range(15)]
    wanted += [(frame, 4.0 + frame, "bob") for frame in range(5, 20)]
    assert sorted(rows(drawable.table), key=str) == sorted(wanted, key=str)


TABLE = """# from another tool
frame,x1,y1,x2,y2,annotator,target,note,confidence
4,1,2,30,40,ada,0,"a ferry, white",0.5
4,5,6,50,60,ada,1,mine,1
9,1,2,3,4,bob,,,
"""


def test_other_rows_and_columns_stay(drawable: Drawable) -> None:
    drawable.table.parent.mkdir()
    drawable.table.write_text(TABLE)
    named = drawable.scene.read_text().replace(
        'name = "dock"', 'name = "dock"\nboxes = "boxes/dock.csv"'
    )
    drawable.scene.write_text(named)
    with opened(drawable) as drawing:
        assert [(box.frame, box.annotator) for box in drawing.boxes()] == [(4, "ada"), (9, "bob")]
        drawing.accept(6, BOX)
        drawing.accept(4, BOX)
    lines = TABLE.splitlines()
    assert drawable.table.read_text().splitlines() == [
        *lines[:3],
        "4,100,300,160,330.25,ada,1,,1",
        "6,100,300,160,330.25,ada,1,,1",
        lines[4],
    ]


@pytest.mark.parametrize(
    ("box", "why"),
    [
        ((100.0, 300.0, 100.0, 330.0), "is empty or inverted"),
        ((160.0, 330.0, 100.0, 300.0), "is empty or inverted"),
        ((-1.0, 300.0, 100.0, 330.0), "reaches out of the picture of 1280 x 720 px"),
        ((1.0, 300.0, 100.0, 720.5), "reaches out of the picture of 1280 x 720 px"),
        ((5000.0, 300.0, 5100.0, 330.0), "reaches out of the picture of 1280 x 720 px"),
        ((float("nan"), 300.0, 100.0, 330.0), "four finite numbers"),
        ((1.0, 300.0, float("inf"), 330.0), "four finite numbers"),
        ((1.0, 2.0, 3.0), "four finite numbers"),
    ],
)
def test_what_is_no_box_is_refused(drawable: Drawable, box: tuple, why: str) -> None:
    with opened(drawable) as drawing:
        with pytest.raises(InputError, match=why):
            drawing.accept(7, box)
        assert not drawable.table.exists()
        assert not drawing.undo()


@pytest.mark.parametrize("frame", [-1, 61, 10**12])
def test_what_is_no_frame_is_refused(drawable: Drawable, frame: int) -> None:
    with opened(drawable) as drawing:
        for asked in (
            lambda: drawing.accept(frame, BOX),
            lambda: drawing.remove(frame),
            lambda: drawing.picture(frame),
            lambda: drawing.follow(frame),
        ):
            with pytest.raises(InputError, match=f"has no picture of frame {frame}"):
                asked()


@pytest.mark.parametrize("annotator", ["", "  ", "a\nb", "x" * 81])
def test_an_annotator_needs_a_name(drawable: Drawable, annotator: str) -> None:
    with pytest.raises(InputError, match="an annotator needs a name"):
        Drawing(drawable.scene, annotator=annotator)


def test_a_recording_is_chosen(drawable: Drawable) -> None:
    with pytest.raises(InputError, match="unknown recording 'pier'; known are dock"):
        Drawing(drawable.scene, "pier", annotator="ada")
    text = drawable.scene.read_text()
    drawable.scene.write_text(text + text[text.index("[[") :].replace("dock", "pier"))
    with pytest.raises(InputError, match="say which recording to draw in; there are dock, pier"):
        Drawing(drawable.scene, annotator="ada")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"frame,x1,y1,x2,y2,annotator\n1,2,3\n", "line 2"),
        (b"frame,x1,y1,x2,y2,annotator\n1,5,5,2,9,ada\n", "line 2"),
        (b"frame;x1;y1;x2;y2\n1;2;3;4;5\n", "write it so"),
        (b"frame,x1,y1,x2,y2\n1,2,3,4,\xff\n", "write it so"),
        (b"", "write it so"),
        (b"time_utc,x1,y1,x2,y2\n2024-06-01T10:00:00Z,1,2,3,4\n", "write it so"),
    ],
)
def test_a_table_that_is_broken_by_hand_stays_as_it_is(
    drawable: Drawable, content: bytes, why: str
) -> None:
    with opened(drawable) as drawing:
        drawing.accept(7, BOX)
        drawable.table.write_bytes(content)
        for asked in (lambda: drawing.accept(8, BOX), drawing.boxes, drawing.frames, drawing.undo):
            with pytest.raises(InputError, match=why) as raised:
                asked()
            assert "\n" not in str(raised.value)
        assert drawable.table.read_bytes() == content
        assert drawing.wait()
        assert drawing.advice().error
    with pytest.raises(InputError, match=why):
        Drawing(drawable.scene, annotator="ada")


def test_where_nothing_can_be_written_it_is_said(
    drawable: Drawable, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(drawable) as drawing:
        drawing.accept(7, BOX)
        before = drawable.table.read_bytes()
        plain = Path.mkdir

        def read_only(path: Path, *arguments: object, **options: object) -> None:
            if path.parent == drawable.table.parent:
                raise PermissionError(30, "Read-only file system", str(path))
            plain(path, *arguments, **options)  # type: ignore[arg-type]

        with monkeypatch.context() as patched:
            patched.setattr(Path, "mkdir", read_only)
            for asked in (lambda: drawing.accept(8, BOX), lambda: drawing.remove(7), drawing.undo):
                with pytest.raises(OutputError, match="cannot be written: Read-only file system"):
                    asked()
        assert drawable.table.read_bytes() == before
        # What could not be taken back still can.
        assert drawing.undo()
        assert drawing.boxes() == []


def test_a_table_that_nobody_named_is_not_taken(
    drawable: Drawable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sightline.labelling.box_table.WAIT_S", 0.1)
    drawable.table.parent.mkdir()
    drawable.table.write_text(TABLE)
    with opened(drawable) as drawing, pytest.raises(InputError, match="is there already, and"):
        drawing.accept(7, BOX)
    assert drawable.table.read_text() == TABLE
    assert "boxes" not in drawable.scene.read_text()


def test_a_frame_without_the_boat_is_suggested_no_more(drawable: Drawable) -> None:
    with opened(drawable) as drawing:
        first = drawing.suggested(5)
        assert len(set(first)) == 5
        drawing.remove(first[0])
        assert first[0] not in drawing.suggested(drawable.count)
        drawing.accept(first[1], BOX)
        assert first[1] not in drawing.suggested(drawable.count)
        assert drawing.suggested(0) == []


def test_a_name_that_a_spreadsheet_would_run_comes_back(drawable: Drawable) -> None:
    with opened(drawable, "=1+1") as drawing:
        drawing.accept(7, BOX)
        assert [box.annotator for box in drawing.boxes()] == ["=1+1"]
    assert drawable.table.read_text().splitlines()[1].endswith(",'=1+1")
    assert BoxTable(drawable.scene, "dock", drawable.table, (1280, 720)).of(7, "=1+1")


@pytest.mark.slow
def test_boxes_drawn_one_by_one_fit_as_a_table_of_them(drawable: Drawable, tmp_path: Path) -> None:
    """In the suggested frames; the last fit is that of `sightline.fit`."""
    drawn: list[int] = []
    with opened(drawable, "hand") as drawing:
        while len(drawn) < 15:
            frame = drawing.suggested(1)[0]
            if frame not in drawable.hand:
                drawing.remove(frame)
                continue
            drawing.accept(frame, drawable.hand[frame])
            drawn.append(frame)
            assert drawing.wait()
        advice = drawing.advice()
    assert (advice.boxes, advice.running, advice.error) == (15, False, "")
    model = fit(Scene.load(drawable.scene), "camera")
    assert advice.georeferencer is not None
    boxes = np.array(list(drawable.truth.values()))
    by_drawing, by_table = (
        one.locate(boxes, source="hand") for one in (advice.georeferencer, model)
    )
    assert_allclose(by_drawing.east_m, by_table.east_m, rtol=0.02, atol=1.0)
    assert_allclose(by_drawing.north_m, by_table.north_m, rtol=0.02, atol=1.0)
    height = next(one for one in advice.parameters if one.name == "height_m")
    assert abs(height.value - 7.0) < 4.0 * height.sigma
    # They lie over the whole time, and over what the boat shows of the picture.
    columns = np.array([0.5 * (drawable.hand[n][0] + drawable.hand[n][2]) for n in drawn])
    every = np.array([0.5 * (box[0] + box[2]) for box in drawable.hand.values()])
    assert np.ptp(columns) > 0.7 * np.ptp(every)
    assert np.ptp(drawn) > 0.6 * drawable.count
    pd.read_csv(drawable.table)


def test_boxes_that_somebody_recognised_are_labels_of_their_source(drawable: Drawable) -> None:
    """All at once, beside what is drawn, and all taken back by one step."""
    found = Boxes.of(
        np.array([BOX, (110.0, 300.0, 170.0, 331.0), (1250.0, 300.0, 1290.0, 331.0)]),
        frame=np.array([7, 8, 9]),
        source="harbour/launch",
    )
    with opened(drawable) as drawing:
        drawing.accept(7, BOX)
        before = rows(drawable.table)
        assert drawing.confirm(found) == 3
        assert rows(drawable.table) == [
            (7, 330.25, "ada"),
            (7, 330.25, "harbour/launch"),
            (8, 331.0, "harbour/launch"),
            (9, 331.0, "harbour/launch"),
        ]
        labelled = Scene.load(drawable.scene)["dock"].boxes()
        # What hung out of the picture ends at its edge.
        assert labelled.xyxy_px[:, 2].max() == 1280.0
        # Again, with other boxes: they replace those of the source, and no others.
        drawing.confirm(found[np.array([0])].with_columns(xyxy_px=np.array([(1, 2, 3, 4.0)])))
        assert rows(drawable.table)[1] == (7, 4.0, "harbour/launch")
        assert drawing.undo()
        assert drawing.undo()
        assert rows(drawable.table) == before
        assert drawing.redo()
        assert len(rows(drawable.table)) == 4
        for wrong in (np.array([7, 8, 10_000]), np.array([-1, -1, -1])):
            with pytest.raises(InputError):
                drawing.confirm(found.with_columns(frame=wrong))
        assert len(rows(drawable.table)) == 4


def test_what_somebody_else_changed_meanwhile_is_not_taken_back(drawable: Drawable) -> None:
    found = Boxes.of(np.array([BOX, BOX]), frame=np.array([7, 8]), source="harbour")
    with opened(drawable) as drawing:
        drawing.confirm(found)
        text = drawable.table.read_text(encoding="utf-8")
        drawable.table.write_text(text.replace("8,100,", "8,101,"), encoding="utf-8")
        with pytest.raises(InputError, match="changed by somebody else"):
            drawing.undo()
        assert len(rows(drawable.table)) == 2
