"""`detect` and `detector evaluate` as somebody at the shell sees them."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from sightline.formats import read_boxes

Command = Callable[..., Any]

BOX = [200.0, 235.0, 250.0, 255.0]
"""Where the boat of the small video is at its start."""


def detector_file(path: Path, *, outputs: np.ndarray | None = None) -> Path:
    """A network of COCO's classes that always sees the same boat, in 640 x 360 px."""
    if outputs is None:
        outputs = np.zeros((1, 84, 4725), np.float32)
        x1, y1, x2, y2 = BOX
        outputs[0, :4, 0] = [(x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1]
        outputs[0, 4 + 8, 0] = 0.8
    value = numpy_helper.from_array(outputs, "output0")
    graph = helper.make_graph(
        [helper.make_node("Constant", [], ["output0"], value=value)],
        "constant",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 360, 640])],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, outputs.shape)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)], ir_version=10)
    onnx.save(model, str(path))
    return path


@pytest.fixture
def scene(harbour: Path) -> Path:
    """The small video as a scene, with the true box of its first and tenth frame."""
    (harbour / "boat.csv").write_text(
        "frame,x1,y1,x2,y2\n0,100,235,150,255\n10,180,235,230,255\n39,412,235,462,255\n"
    )
    (harbour / "boat.toml").write_text(
        '[[recordings]]\nname = "boat"\nframes = "frames"\nclock = "frames.csv"\n'
        'boxes = "boat.csv"\n'
    )
    return harbour / "boat.toml"


@pytest.mark.parametrize("ending", ["csv", "txt"])
def test_boxes_of_a_video(sightline: Command, harbour: Path, tmp_path: Path, ending: str) -> None:
    network = detector_file(tmp_path / "net.onnx")
    out = tmp_path / f"boxes.{ending}"
    result = tmp_path / "r.json"
    done = sightline(
        "detect", harbour / "boat.mp4", "-o", out, "--detector", network, "--views", "whole",
        "--start-utc", "2023-11-14T22:13:20Z", "--json", result,
    )  # fmt: skip
    assert done.status == 0, done.err
    assert "40 boxes in 40 frames" in done.out
    boxes = read_boxes(out)
    assert boxes.frame.tolist() == list(range(40))
    np.testing.assert_allclose(boxes.xyxy_px, np.tile(BOX, (40, 1)), atol=0.01)
    np.testing.assert_allclose(boxes.confidence, 0.8, atol=1e-4)
    if ending == "csv":
        assert set(boxes.source) == {"net"}
        assert set(boxes.label) == {"boat"}
        np.testing.assert_allclose(np.diff(boxes.time_utc_s), 0.1, atol=2e-3)
        head = out.read_text().splitlines()[0]
        assert head == "frame,x1,y1,x2,y2,confidence,annotator,label,time_utc"
    told = json.loads(result.read_text())
    assert (told["frames"], told["boxes"]) == (40, 40)


def masked(path: Path, left: int) -> Path:
    """A mask of the left part of 640 x 360 px."""
    image = np.full((360, 640), 255, np.uint8)
    image[:, :left] = 0
    cv2.imwrite(str(path), image)
    return path


def test_what_is_masked_is_not_kept_and_is_counted(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    """The boat is 50 px wide and at 100 + 8 i px: half of it is masked until frame 24."""
    out, told = tmp_path / "boxes.csv", tmp_path / "r.json"
    plain = sightline("detect", harbour / "boat.mp4", "-o", out, "--detector", "motion")
    assert plain.status == 0, plain.err
    assert (read_boxes(out).xyxy_px[:, 2] < 320.0).any()
    mask = masked(tmp_path / "mask.png", 320)
    done = sightline(
        *("detect", harbour / "boat.mp4", "-o", out, "--detector", "motion"),
        *("--mask", mask, "--json", told),
    )
    assert done.status == 0, done.err
    boxes = read_boxes(out)
    assert len(boxes)
    assert boxes.xyxy_px[:, [0, 2]].mean(axis=1).min() >= 320.0 - 1.0
    network = detector_file(tmp_path / "net.onnx")
    done = sightline(
        *("detect", harbour / "boat.mp4", "-o", out, "--detector", network, "--views", "whole"),
        *("--mask", mask, "--json", told, "--start-utc", "2023-11-14T22:13:20Z"),
    )
    assert done.status == 0, done.err
    assert "left out: 40 boxes in what is masked" in done.out
    assert json.loads(told.read_text())["masked"] == 40
    assert len(read_boxes(out)) == 0


def test_drawn_boxes_that_are_masked_are_neither_missed_nor_found(
    sightline: Command, scene: Path, tmp_path: Path
) -> None:
    masked(scene.parent / "mask.png", 320)
    scene.write_text('[camera]\nmask = "mask.png"\n' + scene.read_text())
    network, result = detector_file(tmp_path / "net.onnx"), tmp_path / "r.json"
    done = sightline(
        *("detector", "evaluate", scene, "--detector", network, "--views", "whole"),
        *("--json", result),
    )
    assert done.status == 0, done.err
    told = json.loads(result.read_text())
    # Of three boxes one lies to the right; what the network sees is on the left.
    assert (told["frames"], told["drawn"], told["found"]) == (3, 1, 0)


def test_tracks_outside_of_an_area_are_left_out(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    (tmp_path / "far.geojson").write_text(
        '{"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}'
    )
    told = tmp_path / "r.json"
    command = (
        *("track", harbour / "detections" / "01.csv", "--model", harbour / "camera.safetensors"),
        *("-o", tmp_path / "t.geojson", "--json", told, "--clock", harbour / "clock" / "01.csv"),
    )
    plain = sightline(*command)
    assert plain.status == 0, plain.err
    before = json.loads(told.read_text())
    assert before["tracks"] > 0
    assert "left_out" not in before
    done = sightline(*command, "--area", tmp_path / "far.geojson")
    assert done.status == 0, done.err
    after = json.loads(told.read_text())
    assert after["tracks"] == 0
    assert after["left_out"]["boxes outside of the area"] > 0
    assert re.search(r"left out: \d+ boxes outside of the area", done.out)


def test_a_budget_bounds_the_tiles_of_a_frame(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    """Enlarged by half, 640 x 360 px come in nine tiles: one a frame, and all in the first."""
    network, out = detector_file(tmp_path / "net.onnx"), tmp_path / "boxes.csv"
    done = sightline(
        *("detect", harbour / "boat.mp4", "-o", out, "--detector", network),
        *("--budget", "0.001", "--start-utc", "2023-11-14T22:13:20Z"),
    )
    assert done.status == 0, done.err
    assert re.search(r"looked at 1 of \d+ tiles of each frame", done.out)
    assert set(read_boxes(out).frame.tolist()) == set(range(40))


@pytest.mark.parametrize("options", [("--views", "everywhere"), ("--enlarge", "2")])
def test_tracks_are_made_of_what_is_seen_at_any_size(
    sightline: Command, harbour: Path, tmp_path: Path, options: tuple[str, str]
) -> None:
    """What the network sees at 200 px of its input is elsewhere, and more often, when enlarged."""
    network = detector_file(tmp_path / "net.onnx")
    common = ("--detector", network, "--model", harbour / "camera.safetensors", "--clock")
    points = []
    for number, more in enumerate(((), options)):
        done = sightline(
            *("track", harbour / "frames", "-o", tmp_path / f"{number}.geojson", *common),
            *(harbour / "frames.csv", "--json", tmp_path / f"{number}.json", *more),
        )
        assert done.status == 0, done.err
        points.append(json.loads((tmp_path / f"{number}.json").read_text())["points"])
    assert points[0] != points[1]


@pytest.mark.slow
def test_frames_without_times_have_boxes_without(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    out = tmp_path / "boxes.csv"
    done = sightline(
        "detect", harbour / "frames", "-o", out, "--detector", detector_file(tmp_path / "n.onnx")
    )
    assert done.status == 0, done.err
    assert np.isnan(read_boxes(out).time_utc_s).all()


def test_a_fitted_model_tells_the_horizon(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    out = tmp_path / "boxes.csv"
    done = sightline(
        "detect", harbour / "frames", "-o", out, "--detector", detector_file(tmp_path / "n.onnx"),
        "--model", harbour / "camera.safetensors",
    )  # fmt: skip
    assert done.status == 0, done.err
    assert len(read_boxes(out)) >= 40


def test_boxes_of_what_moves_need_no_file(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    out = tmp_path / "boxes.csv"
    done = sightline("detect", harbour / "boat.mp4", "-o", out, "--detector", "motion")
    assert done.status == 0, done.err
    assert set(read_boxes(out).source) == {"motion"}


def test_a_detector_is_measured_against_drawn_boxes(
    sightline: Command, scene: Path, tmp_path: Path
) -> None:
    """The box at 200 px is 20 px beside that of frame 10: 30 / 70 = 0.43 of overlap."""
    network, result = detector_file(tmp_path / "net.onnx"), tmp_path / "r.json"
    done = sightline(
        "detector", "evaluate", scene, "--detector", network, "--views", "whole", "--json", result
    )
    assert done.status == 0, done.err
    assert "3 boxes in 3 frames" in done.out
    told = json.loads(result.read_text())
    assert told["recall"] == pytest.approx(1 / 3)
    assert told["precision"] == pytest.approx(1 / 3)
    assert told["mean_iou"] == pytest.approx(30 / 70, abs=1e-4)
    assert told["map_50"] == 0.0
    assert set(told["recordings"]) == {"boat"}


def test_without_its_extra_nothing_is_measured(
    sightline: Command, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycocotools", None)
    # The detector is not looked for either: a day of frames may come before the measure.
    got = sightline("detector", "evaluate", scene, "--detector", tmp_path / "none.onnx")
    assert got.status == 2
    (line,) = got.err.strip().splitlines()
    assert line.endswith('pycocotools is not installed; run: pip install "sightline[score]"')


def test_labels_beside_the_scene(sightline: Command, scene: Path, tmp_path: Path) -> None:
    labels = tmp_path / "labels"
    labels.mkdir()
    (labels / "boat.csv").write_text("frame,x1,y1,x2,y2\n5,200,235,250,255\n6,,,,\n")
    (labels / "empty.csv").write_text("recording,frame\nboat,7\n")
    network, result = detector_file(tmp_path / "net.onnx"), tmp_path / "r.json"
    done = sightline(
        "detector", "evaluate", scene, "--detector", network, "--views", "whole",
        "--labels", labels, "--json", result,
    )  # fmt: skip
    assert done.status == 0, done.err
    told = json.loads(result.read_text())
    assert (told["frames"], told["drawn"], told["recall"]) == (3, 1, 1.0)
    assert told["false_per_frame"] == pytest.approx(2 / 3)


DETECT = "detect {h}/boat.mp4 -o {t}/out/b.csv"
TRACK = "track {h}/boxes/01.csv --model {h}/camera.safetensors -o {t}/out/t.csv"
EVALUATE = "detector evaluate {h}/boat.toml --json {t}/out/e.json"
NET = " --detector {t}/net.onnx"

REFUSED = [
    ("no file", DETECT + " --detector {t}/none.onnx", "there is no such ONNX file"),
    ("corrupt", DETECT + " --detector {t}/bad.onnx", "is no ONNX file that can be run"),
    ("no detector", DETECT + " --detector {t}/other.onnx", "no decoder is known .*: output0 1x9"),
    ("decoder", DETECT + NET + " --decoder yolo99", "unknown decoder 'yolo99'; known are darknet"),
    ("unfit", DETECT + NET + " --decoder torchvision", "not those of the decoder 'torchvision'"),
    ("class", DETECT + NET + " --classes ship", "unknown class of net 'ship'; known are person"),
    ("no class", DETECT + NET + " --classes ,", "classes names no class"),
    ("gpu", DETECT + NET + " --provider tensorrt", "cannot be run with tensorrt.*are .*cpu"),
    ("cuda", DETECT + NET + " --provider cuda", "cannot be run with cuda.*are .*cpu"),
    ("provider", DETECT + NET + " --provider tpu", "unknown provider 'tpu'; known are cpu, cuda"),
    ("views", DETECT + NET + " --views all", "unknown kind of views 'all'; known are strip"),
    ("detector", DETECT + " --detector yolo", "unknown detector 'yolo'; known are motion, harbour"),
    ("motion", DETECT + " --detector motion --threshold 0.5", "runs no network"),
    ("small mask", DETECT + NET + " --mask {h}/small/0.png", "0.png: masks all of the picture"),
    ("no mask", DETECT + NET + " --mask {t}/none.png", "none.png: there is no such file"),
    (
        "mask of another size",
        DETECT + NET + " --mask {t}/half.png",
        "half.png: has 320 x 360 px, and the pictures of .*boat.mp4 640 x 360 px",
    ),
    (
        "mask of another size than the model",
        TRACK + " --mask {t}/half.png",
        "half.png: has 320 x 360 px, and the pictures of the model 640 x 360 px",
    ),
    ("no area", TRACK + " --area {t}/empty.geojson", "empty.geojson: is empty"),
    ("area is missing", TRACK + " --area {t}/none.geojson", "none.geojson: there is no such file"),
    ("enlarged", DETECT + NET + " --enlarge 0", "enlarge is 0; it must be more than 0"),
    ("budget", DETECT + NET + " --budget 0", "budget is 0 ms; give the milliseconds"),
    (
        "a table has no views",
        "track {h}/boxes/01.csv --model {h}/camera.safetensors -o {t}/out/t.csv --views whole",
        "01.csv: is a table of boxes, and nothing is detected; leave .*--views",
    ),
    ("table", "detect {h}/boxes/01.csv -o {t}/out/b.csv", "is a table; boxes are found in"),
    ("source", "detect {h}/none.mp4 -o {t}/out/b.csv", "no such video or folder"),
    ("ending", "detect {h}/boat.mp4 -o {t}/out/b.json", "no format of boxes ends in '.json'"),
    (
        "size of the model",
        "detect {h}/small -o {t}/out/b.csv --model {h}/camera.safetensors" + NET,
        "its pictures have 80 x 60 px, the model learned from 640 x 360 px",
    ),
    ("onto itself", "detect {h}/boat.mp4 -o {h}/boat.mp4", "is read by this command"),
    ("measured class", EVALUATE + NET + " --classes ship", "unknown class of net 'ship'"),
    ("recording", EVALUATE + NET + " --recordings 99", "unknown recording '99'; known are boat"),
    ("labels", EVALUATE + NET + " --labels {t}/none", "there is no such folder of labels"),
    ("empty labels", EVALUATE + NET + " --labels {t}/labels", "holds no box, and no frame"),
    (
        "boxes without pictures",
        "detector evaluate {h}/scene.toml --json {t}/out/e.json" + NET,
        "no recording has both pictures and boxes",
    ),
]


@pytest.mark.parametrize(
    ("command", "message"), [case[1:] for case in REFUSED], ids=[c[0] for c in REFUSED]
)
def test_bad_input_ends_in_a_line(
    sightline: Command, scene: Path, tmp_path: Path, command: str, message: str
) -> None:
    detector_file(tmp_path / "net.onnx")
    detector_file(tmp_path / "other.onnx", outputs=np.zeros((1, 9), np.float32))
    (tmp_path / "bad.onnx").write_bytes(b"\x08\x07 this is no network")
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "boat.csv").write_text("frame,x1,y1,x2,y2\n")
    cv2.imwrite(str(tmp_path / "half.png"), np.eye(360, 320, dtype=np.uint8) * 255)
    (tmp_path / "empty.geojson").write_text("")
    (scene.parent / "small").mkdir()
    cv2.imwrite(str(scene.parent / "small" / "0.png"), np.zeros((60, 80, 3), np.uint8))
    done = sightline(*command.format(h=scene.parent, t=tmp_path).split())
    assert done.status == 2
    assert done.err.startswith("error: ")
    assert len(done.err.splitlines()) == 1
    assert re.search(message, done.err), done.err
    assert not (tmp_path / "out").exists()
