from __future__ import annotations

import csv
import logging
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.errors import InputError
from sightline.formats import iter_boxes, read_boxes, write_boxes
from sightline.formats.labels import Labels, read_labels, write_labels
from sightline.types import NO_FRAME, NO_TRACK, Boxes

pixel = st.floats(-5000.0, 5000.0)
# Boxes all of which are within the first pixel would be in shares of the picture.
side = st.floats(2.0, 5000.0)
word = st.text("abcdefghijklmnop-_ÄØ0123456789", max_size=8)


@st.composite
def tables(draw: st.DrawFn) -> Boxes:
    rows = draw(
        st.lists(
            st.tuples(
                *(pixel, pixel, side, side),
                st.integers(0, 10**9),
                st.integers(0, 4 * 10**12),
                st.floats(0.0, 1.0),
                word,
                st.integers(NO_TRACK, 10**6),
                word,
            ),
            min_size=1,
            max_size=8,
        )
    )
    x, y, width, height, frame, milliseconds, confidence, source, track, label = zip(
        *rows, strict=True
    )
    corners = np.array([x, y, np.add(x, width), np.add(y, height)]).T
    return Boxes.of(
        corners,
        frame=frame,
        time_utc_s=np.array(milliseconds) / 1000.0 if draw(st.booleans()) else None,
        confidence=confidence,
        source=source,
        track_id=track,
        label=label,
    )


@given(boxes=tables())
def test_boxes_survive_csv(tmp_path_factory: pytest.TempPathFactory, boxes: Boxes) -> None:
    path = tmp_path_factory.mktemp("boxes") / "boxes.csv"
    write_boxes(boxes, path)
    read = read_boxes(path)
    # pandas reads decimals to the last bit but one.
    np.testing.assert_allclose(read.xyxy_px, boxes.xyxy_px, rtol=1e-15)
    np.testing.assert_allclose(read.confidence, boxes.confidence, rtol=1e-15)
    np.testing.assert_array_equal(read.frame, boxes.frame)
    np.testing.assert_array_equal(
        np.round(read.time_utc_s * 1000.0), np.round(boxes.time_utc_s * 1000.0)
    )
    np.testing.assert_array_equal(read.source, boxes.source)
    np.testing.assert_array_equal(read.track_id, boxes.track_id)
    np.testing.assert_array_equal(read.label, boxes.label)


@given(boxes=tables())
def test_boxes_survive_motchallenge(tmp_path_factory: pytest.TempPathFactory, boxes: Boxes) -> None:
    path = tmp_path_factory.mktemp("boxes") / "det.txt"
    write_boxes(boxes, path)
    read = read_boxes(path, source="camera")
    np.testing.assert_allclose(read.xyxy_px, boxes.xyxy_px, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(read.confidence, boxes.confidence, rtol=1e-15)
    np.testing.assert_array_equal(read.frame, boxes.frame)
    np.testing.assert_array_equal(read.track_id, boxes.track_id)
    assert set(read.source) == {"camera"}


@pytest.mark.parametrize("name", ["06", "07", "08", "09", "10", "13", "15", "17", "18", "19", "21"])
def test_real_boxes(data_dir: Path, name: str) -> None:
    path = data_dir / "tracks-at-sea" / "boxes" / f"{name}.csv"
    with path.open() as file:
        rows = list(csv.DictReader(file))
    boxes = read_boxes(path)
    assert len(boxes) == len(rows)
    assert boxes.source.tolist() == [row["annotator"] for row in rows]
    assert boxes.frame.tolist() == [int(row["frame"]) for row in rows]
    corners = [[float(row[key]) for key in ("x1", "y1", "x2", "y2")] for row in rows]
    np.testing.assert_array_equal(boxes.xyxy_px, corners)
    assert np.isnan(boxes.time_utc_s).all()
    assert (boxes.confidence == 1.0).all()


def test_real_detections_with_boxes_that_have_no_size(
    data_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = data_dir / "tracks-at-sea" / "detections" / "07-orb.csv"
    with path.open() as file:
        rows = list(csv.DictReader(file))
    sized = [row for row in rows if row["x1"] != row["x2"] and row["y1"] != row["y2"]]
    assert len(sized) < len(rows)
    with pytest.raises(InputError, match=r"07-orb\.csv, line \d+: the box .* is empty or reversed"):
        read_boxes(path)
    with caplog.at_level(logging.WARNING):
        boxes = read_boxes(path, source="orb", skip_empty=True)
    assert f"left out: {len(rows) - len(sized)} without width or height (line " in caplog.text
    assert boxes.track_id.tolist() == [int(row["track_id"]) for row in sized]
    assert set(boxes.source) == {"orb"}


def test_chunks_are_the_file_in_order(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text("frame,x1,y1,x2,y2\n" + "".join(f"{i},0,0,{i + 1},9\n" for i in range(25)))
    chunks = list(iter_boxes(path, 10))
    assert [len(chunk) for chunk in chunks] == [10, 10, 5]
    np.testing.assert_array_equal(np.concatenate([c.frame for c in chunks]), np.arange(25))
    np.testing.assert_array_equal(Boxes.concatenate(chunks).xyxy_px, read_boxes(path).xyxy_px)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".csv", ".txt"])
def test_reading_in_chunks_keeps_memory_flat(tmp_path: Path, suffix: str) -> None:
    def peak(n: int) -> int:
        path = tmp_path / f"{n}{suffix}"
        path.write_text("frame,x1,y1,x2,y2,confidence\n" * (suffix == ".csv"))
        row = "{},1,2,3,4,0.5\n" if suffix == ".csv" else "{},-1,1,2,3,4,0.5,-1,-1,-1\n"
        with path.open("a") as file:
            file.writelines(row.format(i + 1) for i in range(n))
        tracemalloc.start()
        total = sum(len(chunk) for chunk in iter_boxes(path, 1000))
        high = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert total == n
        return high

    peak(1000)
    # Files longer than the quarter of a megabyte that pandas reads at once.
    assert peak(90_000) < 1.2 * peak(30_000)


def test_the_same_box_twice_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text("frame,x1,y1,x2,y2\n5,0,0,1,1\n5,0,0,1,1\n")
    assert len(read_boxes(path)) == 2


def test_boxes_of_no_rows(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text("frame,x1,y1,x2,y2,annotator,time_utc\n")
    assert len(read_boxes(path)) == 0


def test_times_may_stand_in_for_frames(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text("time_utc,x1,y1,x2,y2\n2020-09-30T12:00:00.25Z,0,0,1,1\n")
    boxes = read_boxes(path)
    assert boxes.time_utc_s.tolist() == [1_601_467_200.25]
    assert boxes.frame.tolist() == [NO_FRAME]


def test_empty_cells_of_optional_columns(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text(
        "frame,x1,y1,x2,y2,confidence,annotator,time_utc,track_id,label\n"
        "1,0,0,1,1,,,,,\n2,0,0,1,1,0.5,012,12.5,3,boat\n"
    )
    boxes = read_boxes(path, source="me")
    assert boxes.source.tolist() == ["me", "012"]
    assert boxes.confidence.tolist() == [1.0, 0.5]
    assert boxes.track_id.tolist() == [NO_TRACK, 3]
    assert boxes.label.tolist() == ["", "boat"]
    np.testing.assert_array_equal(boxes.time_utc_s, [np.nan, 12.5])


def test_motchallenge_detections(tmp_path: Path) -> None:
    path = tmp_path / "det.txt"
    path.write_text("1,-1,100,200,50,30,-1,-1,-1,-1\n4,7,10.5,20,5,3,0.25,-1,-1,-1\n")
    boxes = read_boxes(path)
    np.testing.assert_array_equal(boxes.xyxy_px, [[100, 200, 150, 230], [10.5, 20, 15.5, 23]])
    assert boxes.frame.tolist() == [0, 3]
    assert boxes.track_id.tolist() == [NO_TRACK, 7]
    assert boxes.confidence.tolist() == [1.0, 0.25]


def test_motchallenge_ground_truth_says_which_rows_count(tmp_path: Path) -> None:
    path = tmp_path / "gt.txt"
    path.write_text("1,1,0,0,5,5,1,1,0.8\n1,2,0,0,5,5,0,7,0.2\n1,3,0,0,0,5,0,7,0.2\n")
    assert read_boxes(path).track_id.tolist() == [1]


HEAD = "frame,x1,y1,x2,y2\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "", "is empty"),
        ("a.csv", "frame,x1,y1,x2\n", "lacks the column y2; found frame, x1, y1, x2"),
        ("a.csv", "x1,y1,x2,y2\n0,0,1,1\n", r"lacks the column frame \(or time_utc\)"),
        ("a.csv", "frame,x1,y1,x2,y2,confidance\n", "unknown column 'confidance'; known are x1"),
        ("a.csv", HEAD + "0,0,0,nan,1\n", r"line 2: nan is no number \(x2\)"),
        ("a.csv", HEAD + "0,0,0,inf,1\n", r"line 2: inf is no number \(x2\)"),
        (
            "a.csv",
            HEAD + "0,0,0,1,1\n\n0,2,0,1,1\n",
            "line 4: the box 2,0,1,1 is empty or reversed",
        ),
        ("a.csv", HEAD + "0.5,0,0,1,1\n", r"line 2: 0\.5 is no whole number"),
        ("a.csv", HEAD + "-1,0,0,1,1\n", "line 2: -1 is no frame; frames count from 0"),
        ("a.csv", HEAD[:-1] + ",target\n0,0,0,1,1,2\n", "line 2: 2 is no target; give 1 or 0"),
        ("a.csv", HEAD[:-1] + ",confidence\n0,0,0,1,1,1.5\n", "1.5 is no confidence"),
        ("a.csv", "time_utc,x1,y1,x2,y2\n,0,0,1,1\n", "is no time"),
        ("a.csv", HEAD + "0,0,0,1,1,7\n", "more cells than its header has names"),
        ("a.csv", "\x89PNG\0\0", "is not text"),
        ("a.txt", "", "is empty"),
        ("a.txt", "1,1,2,3\n", "has 4 columns; a MOTChallenge file has at least six"),
        (
            "a.txt",
            "-2,1,0,0,5,5,1,-1,-1,-1\n",
            "line 1: -2 is no frame; MOTChallenge counts from 1",
        ),
        ("a.txt", "1,1,0,0,5,-5,1,-1,-1,-1\n", "line 1: the box 0,0,5,-5 is empty or reversed"),
        ("a.txt", "1,1,0,0,5,5,130.5,-1,-1,-1\n", "130.5 is no confidence between 0 and 1"),
        ("a.txt", "frame,id,left,top,w\n1,1,0,0,5\n", "lacks the columns x2, y2"),
        ("a.json", "{}", r"no format of boxes ends in '\.json'; known are \.csv, \.txt"),
    ],
)
def test_refused_boxes(tmp_path: Path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_boxes(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_boxes_of_other_boats_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(HEAD[:-1] + ",target\n0,0,0,1,1,1\n0,5,5,6,6,0\n1,2,2,3,3,\n")
    boxes = read_boxes(path)
    assert boxes.frame.tolist() == [0, 1]
    np.testing.assert_allclose(boxes.xyxy_px, [[0, 0, 1, 1], [2, 2, 3, 3]])


def test_labels_survive_csv(tmp_path: Path) -> None:
    boxes = Boxes.of(
        [[0, 0, 1.25, 1], [4, 4, 9, 8]],
        frame=[7, 3],
        confidence=[0.5, 1.0],
        source="log",
        label="boat",
    )
    labels = Labels(boxes, np.array([True, False]), np.array([5]))
    path = tmp_path / "a.csv"
    write_labels(labels, path)
    read = read_labels(path)
    order = np.argsort(boxes.frame)
    np.testing.assert_array_equal(read.boxes.frame, boxes.frame[order])
    np.testing.assert_allclose(read.boxes.xyxy_px, boxes.xyxy_px[order])
    np.testing.assert_allclose(read.boxes.confidence, boxes.confidence[order])
    np.testing.assert_array_equal(read.boxes.source, boxes.source[order])
    np.testing.assert_array_equal(read.target, labels.target[order])
    assert read.empty_frames.tolist() == [5]
    # All of the target: a table for a scene as well.
    write_labels(Labels.of_target(boxes), path)
    np.testing.assert_array_equal(read_boxes(path).frame, boxes.frame)


def test_boxes_that_cannot_be_written(tmp_path: Path) -> None:
    boxes = Boxes.of([[0, 0, 1, 1], [0, 0, 1, 1]], frame=[0, NO_FRAME])
    with pytest.raises(InputError, match="every box needs a frame, or every box a time"):
        write_boxes(boxes, tmp_path / "a.csv")
    with pytest.raises(InputError, match="needs the frame of every box"):
        write_boxes(boxes, tmp_path / "a.txt")
    with pytest.raises(InputError, match="every box needs a frame to be written as a label"):
        write_labels(Labels.of_target(boxes), tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


def test_an_empty_name_is_nobodys_and_nan_is_a_name(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text("frame,x1,y1,x2,y2,annotator\n1,0,0,9,9,\n2,0,0,9,9,nan\n3,0,0,9,9,NA\n")
    read = read_boxes(path, source="somebody")
    assert read.source.tolist() == ["somebody", "nan", "NA"]


def test_blank_lines_of_a_table_with_names_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text("frame,x1,y1,x2,y2,annotator\n1,0,0,9,9,me\n\n2,0,0,9,9,me\n")
    assert read_boxes(path).frame.tolist() == [1, 2]
