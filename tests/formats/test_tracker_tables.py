"""Tables as trackers and detectors write them: read as what they say, or refused in a line."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import iter_boxes, read_boxes
from sightline.tally import Tally
from sightline.types import NO_TRACK, Boxes

SIZE_PX = (1280, 720)


class Row(NamedTuple):
    """What a tracker saw: frame from 0, id, corners in px, confidence."""

    frame: int
    track: int
    x1: float
    y1: float
    x2: float
    y2: float
    conf: float

    @property
    def size(self) -> tuple[float, float]:
        return round(self.x2 - self.x1, 2), round(self.y2 - self.y1, 2)


def seen() -> list[Row]:
    """Three targets in twelve frames; numbers with two decimals, as they are written below."""
    rows = []
    for frame in range(12):
        for track in (1, 2, 3):
            x1, y1 = 150.25 + 310.5 * track + 3.25 * frame, 300.5 + 20.25 * track
            conf = 0.31 + 0.2 * track + 0.005 * frame
            rows.append(Row(frame, track, x1, y1, x1 + 40.5, y1 + 18.75, round(conf, 3)))
    return rows


ROWS = seen()


def mot(row: Row, *, first: int = 1, sep: str = ",", conf: str | None = None, end: str = "") -> str:
    w, h = row.size
    told = f"{row.conf}" if conf is None else conf
    cells = [row.frame + first, row.track, row.x1, row.y1, w, h, told, -1, -1, -1]
    return sep.join(map(str, cells)) + end


def lines(form: Callable[[Row], str], head: str = "") -> str:
    return (head + "\n" if head else "") + "".join(form(row) + "\n" for row in ROWS)


def corners(row: Row) -> str:
    return f"{row.x1},{row.y1},{row.x2},{row.y2}"


def german(row: Row) -> str:
    cells = [row.frame, row.x1, row.y1, row.x2, row.y2, row.conf, row.track]
    return ";".join(str(cell).replace(".", ",") for cell in cells)


def centre(row: Row) -> str:
    w, h = row.size
    return f"{row.frame},{row.track},{row.x1 + w / 2},{row.y1 + h / 2},{w},{h},{row.conf}"


def shares(row: Row, unit: float = 1.0) -> str:
    scale = unit / np.array([*SIZE_PX, *SIZE_PX])
    four = np.array([row.x1, row.y1, row.x2, row.y2]) * scale
    return f"{row.frame},{','.join(f'{v:.9f}' for v in four)},{row.conf},{row.track}"


NAMED = "frame,x1,y1,x2,y2,confidence,track_id"
TABLES = {
    "mot.txt": lines(mot),
    "spaces.txt": lines(lambda r: mot(r, sep=" ", end=" ")),
    "more-spaces.txt": lines(lambda r: "  " + mot(r, sep="   ")),
    "tabs.txt": lines(lambda r: mot(r, sep="\t")),
    "comma-space.txt": lines(lambda r: mot(r, sep=", ")),
    "trailing.txt": lines(lambda r: mot(r, end=",")),
    "from-zero.txt": lines(lambda r: mot(r, first=0)),
    "float-frames.txt": lines(lambda r: f"{r.frame + 1}.0,{r.track}.0," + mot(r).split(",", 2)[2]),
    "percent.txt": lines(lambda r: mot(r, conf=f"{100 * r.conf:.1f}")),
    "percent-sign.txt": lines(lambda r: mot(r, conf=f"{100 * r.conf:.1f}%")),
    "seven.txt": lines(lambda r: ",".join(mot(r).split(",")[:7])),
    "boxmot.txt": lines(lambda r: ",".join(mot(r).split(",")[:7]) + f",8,{r.track - 1}"),
    "nine.txt": lines(lambda r: ",".join(mot(r).split(",")[:7]) + ",8,-1"),
    "header.txt": lines(mot, "frame,id,bb_left,bb_top,bb_width,bb_height,conf,x,y,z"),
    "comment.txt": lines(mot, "# frame, id, bb_left, bb_top, bb_width, bb_height, conf, x, y, z"),
    "headless.csv": lines(mot),
    "decimal-commas.txt": lines(lambda r: mot(r, sep=" ").replace(".", ",")),
    "german.csv": lines(german, NAMED.replace(",", ";")),
    "named.csv": lines(lambda r: f"{r.frame},{corners(r)},{r.conf},{r.track}", NAMED),
    "tabs.csv": lines(
        lambda r: f"{r.frame},{corners(r)},{r.conf},{r.track}".replace(",", "\t"),
        NAMED.replace(",", "\t"),
    ),
    "bars.csv": lines(
        lambda r: f"{r.frame},{corners(r)},{r.conf},{r.track}".replace(",", "|"),
        NAMED.replace(",", "|"),
    ),
    "supervision.csv": lines(
        lambda r: f"{corners(r)},8,{r.conf},{r.track},{r.frame}",
        "x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,frame",
    ),
    "other-names.csv": lines(
        lambda r: f"{r.frame},{r.track},{r.conf},{corners(r)}",
        "Frame Number,Object ID,Score,BBox Left,BBox Top,BBox Right,BBox Bottom",
    ),
    "zero-corners.csv": lines(
        lambda r: f"{r.frame},{r.track},{corners(r)},{r.conf}", "frame_idx,id,x0,y0,x1,y1,conf"
    ),
    "quoted.csv": lines(
        lambda r: f'"{r.frame}","{r.track}",{corners(r)},"{r.conf}"',
        '"frame","id","xmin","ymin","xmax","ymax","score"',
    ),
    "sizes.csv": lines(
        lambda r: f"{r.frame},{r.track},{r.x1},{r.y1},{r.size[0]},{r.size[1]},{r.conf}",
        "frame,track_id,left,top,width,height,confidence",
    ),
    "xywh.csv": lines(
        lambda r: f"{r.frame},{r.track},{r.x1},{r.y1},{r.size[0]},{r.size[1]},{r.conf}",
        "frame,track_id,x,y,w,h,confidence",
    ),
    "centres.csv": lines(centre, "frame_id,id,cx,cy,w,h,conf"),
    "shares.csv": lines(shares, NAMED),
    "shares.txt": lines(
        lambda r: mot(r).replace(
            f"{r.x1},{r.y1},{r.size[0]},{r.size[1]}",
            f"{r.x1 / 1280:.9f},{r.y1 / 720:.9f},{r.size[0] / 1280:.9f},{r.size[1] / 720:.9f}",
        )
    ),
    "percent-places.csv": lines(lambda r: shares(r, 100.0), NAMED),
}


def check(boxes: Boxes, rows: list[Row] = ROWS) -> None:
    assert boxes.frame.tolist() == [row.frame for row in rows]
    assert boxes.track_id.tolist() == [row.track for row in rows]
    np.testing.assert_allclose(boxes.xyxy_px, [row[2:6] for row in rows], rtol=0, atol=1e-5)
    np.testing.assert_allclose(boxes.confidence, [row.conf for row in rows], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", TABLES)
def test_a_table_says_the_same_however_it_is_written(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(TABLES[name], encoding="utf-8")
    tally = Tally(path)
    check(read_boxes(path, image_size_px=SIZE_PX, tally=tally))
    assert (tally.read, tally.left_out) == ({"rows": len(ROWS), "boxes": len(ROWS)}, {})
    check(Boxes.concatenate(list(iter_boxes(path, 5, image_size_px=SIZE_PX, tally=tally))))


def test_a_table_of_a_spreadsheet_in_utf16(tmp_path: Path) -> None:
    path = tmp_path / "unicode.csv"
    path.write_text(TABLES["tabs.csv"], encoding="utf-16")
    check(read_boxes(path))


def test_corners_in_a_motchallenge_file_are_seen_and_told(tmp_path: Path) -> None:
    path = tmp_path / "xyxy.txt"
    path.write_text(lines(lambda r: f"{r.frame + 1},{r.track},{corners(r)},{r.conf},-1,-1,-1"))
    tally = Tally(path)
    check(read_boxes(path, tally=tally))
    assert "taken for the lower right corner" in tally.notes[0]


def test_an_unsorted_table_is_the_same_boxes(tmp_path: Path) -> None:
    path = tmp_path / "unsorted.txt"
    rows = sorted(ROWS, key=lambda row: (row.track, row.frame))
    path.write_text("".join(mot(row) + "\n" for row in rows))
    check(read_boxes(path), rows)


def test_ground_truth_is_known_by_its_values(tmp_path: Path) -> None:
    path = tmp_path / "gt.txt"
    path.write_text(
        "".join(
            ",".join(mot(r).split(",")[:6]) + f",{int(r.track != 2)},1,{0.5 + r.frame / 24}\n"
            for r in ROWS
        )
    )
    tally = Tally(path)
    boxes = read_boxes(path, tally=tally)
    assert set(boxes.track_id) == {1, 3}
    assert (boxes.confidence == 1.0).all()
    left = tally.left_out["marked as not to be counted"]
    assert (left.count, left.row) == (12, "line 2")


def test_confidences_that_were_cut_to_whole_numbers_drop_no_box(tmp_path: Path) -> None:
    """Nine columns with the confidence 0 throughout were once taken for ground truth."""
    path = tmp_path / "int.txt"
    path.write_text(lines(lambda r: ",".join(mot(r).split(",")[:6]) + ",0,8,-1"))
    tally = Tally(path)
    boxes = read_boxes(path, tally=tally)
    assert len(boxes) == len(ROWS)
    assert (boxes.confidence == 1.0).all()
    assert "all confidences are 0" in tally.notes[0]


def test_rows_without_a_box_are_left_out_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "nan.csv"
    path.write_text(
        lines(
            lambda r: (
                f"{r.frame},nan,nan,nan,nan,,{r.track}"
                if r.track == 2
                else f"{r.frame},{corners(r)},{r.conf},{r.track}"
            ),
            NAMED,
        )
    )
    with caplog.at_level(logging.WARNING):
        check(read_boxes(path), [row for row in ROWS if row.track != 2])
    assert "left out: 12 without a box (no coordinates) (line 3: " in caplog.text


@pytest.mark.parametrize("none", ["None", "", "nan", "null", "-1"])
def test_boxes_without_an_id_are_told(tmp_path: Path, none: str) -> None:
    path = tmp_path / "none.csv"
    path.write_text(
        lines(
            lambda r: f"{r.frame},{corners(r)},{r.conf},{none if r.track == 2 else r.track}", NAMED
        )
    )
    tally = Tally(path)
    boxes = read_boxes(path, tally=tally)
    assert boxes.track_id.tolist() == [NO_TRACK if r.track == 2 else r.track for r in ROWS]
    assert tally.notes == [
        "12 of 36 boxes have no track id and belong to no track, since others have one"
    ]


def test_a_column_that_numbers_the_rows_is_no_track(tmp_path: Path) -> None:
    path = tmp_path / "ids.csv"
    body = "".join(f"{i},{r.frame},{corners(r)},{r.conf}\n" for i, r in enumerate(ROWS))
    path.write_text("id,frame,x1,y1,x2,y2,confidence\n" + body)
    tally = Tally(path)
    assert set(read_boxes(path, tally=tally).track_id) == {NO_TRACK}
    assert "numbers the rows" in tally.notes[0]


def test_boxes_partly_outside_are_kept_as_they_stand(tmp_path: Path) -> None:
    path = tmp_path / "outside.csv"
    path.write_text("frame,x1,y1,x2,y2\n" + "".join(f"{i},-40.5,10,60,50\n" for i in range(12)))
    tally = Tally(path)
    np.testing.assert_array_equal(read_boxes(path, tally=tally).xyxy_px[:, 0], -40.5)
    assert "12 of 12 boxes begin left of the picture" in tally.notes[0]


def test_a_tracker_s_broken_boxes_cost_themselves(tmp_path: Path) -> None:
    path = tmp_path / "broken.txt"
    broken = "3,9,10,10,-5,4,0.5\n3,9,10,10,0,4,0.5\n3,9,10,inf,5,4,0.5\n"
    path.write_text(lines(lambda r: ",".join(mot(r).split(",")[:7])) + broken)
    tally = Tally(path)
    check(read_boxes(path, skip_empty=True, tally=tally))
    assert {reason: left.count for reason, left in tally.left_out.items()} == {
        "with a negative width or height": 1,
        "without width or height": 1,
        "with a coordinate that is no number": 1,
    }
    with pytest.raises(InputError, match="line 39: inf is no number"):
        read_boxes(path, tally=Tally(path))


def test_a_class_behind_the_confidence_is_the_label(tmp_path: Path) -> None:
    path = tmp_path / "labelled.txt"
    path.write_text(lines(lambda r: ",".join(mot(r).split(",")[:7]) + ",boat"))
    boxes = read_boxes(path)
    check(boxes)
    assert set(boxes.label) == {"boat"}


def test_a_column_that_is_not_used_is_named(tmp_path: Path) -> None:
    path = tmp_path / "speed.csv"
    path.write_text(lines(lambda r: f"{r.frame},{corners(r)},7", "frame,x1,y1,x2,y2,speed"))
    tally = Tally(path)
    assert len(read_boxes(path, tally=tally)) == len(ROWS)
    assert tally.notes == ["the column speed is not used"]


def yolo(row: Row, *, name: int = 0, end: bool = True, conf: bool = True) -> str:
    """A frame, and what Ultralytics writes of each box: class, centre, size, confidence, id."""
    w, h = row.size
    width, height = SIZE_PX
    centre_x, centre_y = (row.x1 + w / 2) / width, (row.y1 + h / 2) / height
    cells = [row.frame + 1, name, centre_x, centre_y, w / width, h / height]
    told = [row.conf] * conf + [row.track] * end
    return " ".join(f"{c:.9f}" if isinstance(c, float) else f"{c}" for c in [*cells, *told])


def at_the_edge(rows: list[Row] = ROWS) -> list[Row]:
    """The same, moved until the last touches the right edge."""
    shift = SIZE_PX[0] - max(row.x2 for row in rows)
    return [row._replace(x1=row.x1 + shift, x2=row.x2 + shift) for row in rows]


@pytest.mark.parametrize("conf", [True, False])
@pytest.mark.parametrize("suffix", [".txt", ".csv"])
def test_labels_of_yolo_behind_their_frame_are_centres(
    tmp_path: Path, suffix: str, conf: bool
) -> None:
    """Two boxes of a frame have the same class, so the second column is no id."""
    path = tmp_path / f"yolo{suffix}"
    path.write_text("".join(yolo(row, conf=conf) + "\n" for row in ROWS))
    tally = Tally(path)
    boxes = read_boxes(path, image_size_px=SIZE_PX, tally=tally)
    check(boxes, [row if conf else row._replace(conf=1.0) for row in ROWS])
    assert "as YOLO writes them" in tally.notes[0]
    with pytest.raises(InputError, match="whose size is not known here"):
        read_boxes(path)


def test_one_target_in_shares_is_told_by_its_id_or_the_edge_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "yolo.txt"
    edge = [row for row in at_the_edge() if row.track == 3]
    path.write_text("".join(yolo(row) + "\n" for row in edge))
    check(read_boxes(path, image_size_px=SIZE_PX), edge)
    path.write_text("".join(yolo(row) + "\n" for row in ROWS if row.track == 3))
    check(read_boxes(path, image_size_px=SIZE_PX), [row for row in ROWS if row.track == 3])
    path.write_text("".join(yolo(row, conf=False) + "\n" for row in ROWS if row.track == 3))
    with pytest.raises(InputError, match="write a header, as frame,class_id,xc,yc,w,h,conf,track"):
        read_boxes(path, image_size_px=SIZE_PX)
    head = "frame,class_id,xc,yc,w,h,track_id\n".replace(",", " ")
    path.write_text(head + path.read_text())
    alone = [row._replace(conf=1.0) for row in ROWS if row.track == 3]
    check(read_boxes(path, image_size_px=SIZE_PX), alone)


def test_classes_first_in_pixels_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "boxes.txt"
    path.write_text(lines(lambda r: f"{r.frame},0,{r.x1},{r.y1},40.5,18.75,{r.conf},{r.track}"))
    with pytest.raises(InputError, match="nothing tells whether its rows are frame,id,left,top"):
        read_boxes(path, image_size_px=SIZE_PX)


CENTRED = {
    "xc,yc,w,h": "xc,yc,w,h",
    "cx,cy": "cx,cy,w,h",
    "x_center": "x_center,y_center,width,height",
    "xywh of Ultralytics": "xywh_x,xywh_y,xywh_w,xywh_h",
}


@pytest.mark.parametrize("unit", ["px", "shares"])
@pytest.mark.parametrize("names", CENTRED.values(), ids=CENTRED)
def test_centres_by_name(tmp_path: Path, names: str, unit: str) -> None:
    path = tmp_path / "boxes.csv"
    scale = np.array([*SIZE_PX, *SIZE_PX]) if unit == "shares" else 1.0

    def row(r: Row) -> str:
        four = np.array([(r.x1 + r.x2) / 2, (r.y1 + r.y2) / 2, *r.size]) / scale
        return f"{r.frame},{','.join(f'{v:.10f}' for v in four)},{r.conf},{r.track},0"

    path.write_text(lines(row, f"frame,{names},conf,id,cls"))
    check(read_boxes(path, image_size_px=SIZE_PX))


def xywh(row: Row, middle: bool) -> str:
    w, h = row.size
    x, y = (row.x1 + w / 2, row.y1 + h / 2) if middle else (row.x1, row.y1)
    return f"{row.frame},{x},{y},{w},{h},{row.conf},{row.track}"


def test_bare_x_and_y_are_told_by_the_edges_of_the_picture(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    right = at_the_edge()
    shift = min(row.x1 for row in ROWS)
    left = [row._replace(x1=row.x1 - shift, x2=row.x2 - shift) for row in ROWS]
    for head in ("frame,x,y,w,h,conf,id", "frame,x,y,width,height,conf,id"):
        path.write_text(head + "\n" + "".join(xywh(row, True) + "\n" for row in right))
        tally = Tally(path)
        check(read_boxes(path, image_size_px=SIZE_PX, tally=tally), right)
        assert "its x,y are taken for the centre" in tally.notes[0]
        path.write_text(head + "\n" + "".join(xywh(row, False) + "\n" for row in left))
        tally = Tally(path)
        check(read_boxes(path, image_size_px=SIZE_PX, tally=tally), left)
        assert not tally.notes


def test_bare_x_and_y_that_nothing_tells(tmp_path: Path) -> None:
    path = tmp_path / "boxes.csv"
    path.write_text(lines(lambda r: xywh(r, False), "frame,x,y,w,h,conf,id"))
    tally = Tally(path)
    check(read_boxes(path, image_size_px=SIZE_PX, tally=tally))
    assert "taken for the upper left corner; if they are the centre, call them" in tally.notes[0]
    path.write_text(lines(lambda r: xywh(r, True) + ",8", "frame,x,y,w,h,conf,id,cls"))
    with pytest.raises(InputError, match="call the columns xc,yc,w,h or left,top,width,height"):
        read_boxes(path, image_size_px=SIZE_PX)
    path.write_text(lines(lambda r: yolo(r).replace(" ", ","), "frame,cl,x,y,w,h,conf,id"))
    with pytest.raises(InputError, match="x,y,w,h may be the centre"):
        read_boxes(path, image_size_px=SIZE_PX)
    # Roboflow gives each detection an id of its own, and its centre.
    path.write_text(
        lines(lambda r: xywh(r, True) + ",a-b", "frame,x,y,width,height,confidence,id,detection_id")
    )
    check(read_boxes(path, image_size_px=SIZE_PX))


HUGE = "1" + "0" * 400


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", lines(shares, NAMED), "as shares of the picture, whose size is not known"),
        ("a.csv", f"frame,x1,y1,x2,y2\n{HUGE},1,2,3,4\n", r"line 2: 10{60}.* is no number"),
        ("a.txt", f"{HUGE},1,1,2,3,4,1\n", r"line 1: 10{60}.* is no number"),
        ("a.csv", f"frame,x1,y1,x2,y2\n1,{HUGE},2,3,4\n", "is no number"),
        ("a.csv", f"frame,x1,y1,x2,y2,track_id\n1,1,2,3,4,{HUGE}\n", "is no number"),
        (
            "a.csv",
            "frame,x1,y1,x2,y2\n" + "0,nan,nan,nan,nan\n" * 3,
            "none of its 3 rows is of use",
        ),
        ("a.txt", "1,1,5,5,5,5,0,1,0.5\n" * 3, "none of its 3 rows is of use: 3 marked as not"),
        ("a.txt", "0 0 Car 0 0 -1.79 296.7 161.7 455.2 292.3\n", "has no header, and 'Car'"),
        ("a.csv", "image,xmin,ymin,xmax,ymax\na.jpg,1,2,3,4\n", "lacks the column frame"),
        (
            "a.csv",
            "x_min,y_min,x_max,y_max,class_id,confidence,tracker_id\n1,2,3,4,8,0.5,1\n",
            r'supervision writes it with custom_data=\{"frame": NUMBER\}',
        ),
        (
            "a.csv",
            lines(lambda r: f"{r.frame},{r.x1},{r.y1},40,18", "frame,x1,y1,x2,y2"),
            "36 of 36 boxes are empty or reversed; .* name them left,top,width,height",
        ),
        (
            "a.txt",
            lines(lambda r: mot(r, conf=f"{400 * r.conf - 100}")),
            "its confidences lie between 104 and 286; expected 0 to 1, or percents",
        ),
        ("a.csv", "frame,x1,y1,x2,y2,track_id\n0,1,2,3,4,boat-7\n", "boat-7 is no number"),
        ("a.csv", "# nothing\n\n", "holds no table"),
        (
            "a.txt",
            "0 0.51 0.52 0.1 0.05\n8 0.21 0.32 0.1 0.05\n",
            "has 5 columns; .* put them into one table with the header frame,class_id,xc,yc,w,h",
        ),
        ("a.csv", "frame,x,y,w,h\n0,1e308,0,1e308,4\n", "line 2: inf is too large a number"),
    ],
)
def test_what_cannot_be_understood_is_told_in_a_line(
    tmp_path: Path, name: str, content: str, message: str
) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_boxes(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 400
