"""Detectors beside each other; that each can learn is tested elsewhere."""

from __future__ import annotations

import json
import math
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")

from sightline.cli import main
from sightline.errors import InputError
from sightline.evaluation.detection import DetectionReport
from sightline.evaluation.report import write_json
from sightline.scene import Scene
from sightline.training import comparison, loop
from sightline.training.comparison import (
    COMPARISON,
    FIGURE,
    MEASURED,
    TABLE,
    VARIANTS,
    ComparedDetector,
    ComparisonSettings,
    DetectorComparison,
    augmentation_figure,
    compare_detectors,
    hardware,
    write_comparison,
)
from sightline.training.data import Labels
from sightline.training.export import ExportError
from sightline.training.loop import TrainingSettings
from sightline.training.recipe import Recipe

SMALL = {"yolov3": {"cfg": "yolov3-tiny"}, "yolov4": {"cfg": "yolov4-tiny"}}


def _recipe(**changes: tuple[str, ...]) -> Recipe:
    parts = {"train": ("a",), "validation": (), **changes}
    return Recipe(
        architecture="yolov3",
        labels=Labels(class_names=("boat",)),
        size_px=(64, 64),
        batch=2,
        training=TrainingSettings(steps=2, warmup=1, validate_every=1, device="cpu", threads=1),
        **parts,
    )


def test_a_detector_is_trained_and_measured_on_a_recording_left_out(
    scene: Scene, tmp_path: Path
) -> None:
    made = compare_detectors(
        scene,
        _recipe(),
        ("b",),
        tmp_path / "out",
        ComparisonSettings(("yolov3",), SMALL, augmentations=False),
    )
    (row,) = made.rows
    # Darknet's count for COCO, less 3 x 79 filters of either head, 512 and 256 inputs and a bias;
    # running means and variances are no parameters.
    learned = 8_858_734 - 3 * 79 * (513 + 257) - 2 * _normalised("yolov3-tiny")
    assert row.parameters == learned
    assert row.steps == 2
    assert row.training_s > 0.0
    assert row.frame_ms > 0.0
    assert row.report.frames == row.report.drawn == 6
    assert 0.0 <= row.report.map_50_95 <= row.report.map_50 <= 1.0
    assert made.settings["steps"] == 2
    assert made.settings["minutes"] == 0.0
    assert made.settings["options"] == SMALL
    assert made.split == {"train": ("a",), "validation": (), "test": ("b",)}
    assert json.loads(json.dumps(made.to_dict()))["detectors"]["yolov3"]["steps"] == 2
    with pytest.raises(InputError, match="without YOLOv4's augmentations"):
        augmentation_figure(made)


def _normalised(name: str) -> int:
    from sightline.training.darknet.cfg import published

    return sum(layer.filters for _, layer in published(name).convolutions if layer.batch_normalize)


def test_the_hardware_is_named() -> None:
    named = hardware("cpu")
    assert named["cores"] >= 1
    assert named["cpu"]
    assert named["gpu"] is None
    assert named["torch"]


def test_the_figure_shows_both_measures_of_every_variant() -> None:
    histories = {
        name: [
            {"step": 500.0, "score": 0.2 + 0.1 * i, "giou_loss": 1.5 - 0.1 * i},
            {"step": 1000.0, "score": 0.4 + 0.1 * i, "giou_loss": 1.0 - 0.1 * i},
        ]
        for i, name in enumerate(VARIANTS)
    }
    made = DetectorComparison((), histories, {}, {}, {})
    left, right = augmentation_figure(made).axes
    assert [line.get_label() for line in left.lines] == list(VARIANTS)
    assert list(left.lines[1].get_ydata()) == pytest.approx([0.3, 0.5])
    assert list(right.lines[3].get_ydata()) == pytest.approx([1.2, 0.7])
    assert list(right.lines[0].get_xdata()) == [500.0, 1000.0]


@pytest.mark.parametrize(
    ("architectures", "test", "recipe", "augmentations", "said"),
    [
        (("yolov9",), ("b",), _recipe(), False, "unknown architecture 'yolov9'; known are yolov3"),
        (("yolov3",), ("a",), _recipe(), False, "'a' is both learned from and tested on"),
        (("yolov3",), ("b",), _recipe(validation=("b",)), False, "'b' is both learned from"),
        (("yolov3",), ("b",), _recipe(), True, "--validation NAME"),
        (("yolov3",), ("c",), _recipe(), False, r"no boxes in pictures to test on \(c\)"),
        (("yolov3",), (), _recipe(), False, r"to test on \(none was named\)"),
    ],
)
def test_what_cannot_be_compared_is_said_before_anything_is_trained(
    architectures: tuple[str, ...],
    test: tuple[str, ...],
    recipe: Recipe,
    augmentations: bool,
    said: str,
    scene: Scene,
    tmp_path: Path,
) -> None:
    with pytest.raises(InputError, match=said):
        compare_detectors(
            scene,
            recipe,
            test,
            tmp_path / "out",
            ComparisonSettings(architectures, augmentations=augmentations),
        )
    assert not (tmp_path / "out").exists()


SMALL_RUN = "--no-augmentations --arch yolov3 --size 64x64 --batch 2 --steps 1 "

REFUSED = [
    ("option", "--option backbone=resnet50", "expected ARCH.NAME=VALUE"),
    ("minutes", "--no-augmentations --minutes -3", "-3 minutes cannot be"),
    ("device", SMALL_RUN + "--device abacus", "the device 'abacus' is not to be had here"),
    ("no boxes to learn from", SMALL_RUN + "--train c", "for train (c) have no boxes"),
    ("no labels", SMALL_RUN + "--labels {t}/none", "none: there is no such folder of labels"),
    ("empty labels", SMALL_RUN + "--labels {t}/labels", "a.csv: holds no box, and no frame"),
    ("no .cfg", SMALL_RUN + "--option yolov3.cfg={t}/no.cfg", "no.cfg: cannot be read"),
    ("a section", SMALL_RUN + "--option yolov3.cfg={t}/odd.cfg", "unknown section [lstm]"),
    (
        "weights that do not fit",
        SMALL_RUN + "--option yolov3.cfg=yolov3-tiny --option yolov3.weights={t}/short.weights",
        "short.weights: ",
    ),
]


@pytest.mark.parametrize(
    ("words", "said"), [case[1:] for case in REFUSED], ids=[case[0] for case in REFUSED]
)
def test_bad_input_of_a_comparison_is_a_line(
    words: str, said: str, scene: Scene, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "labels").mkdir()
    for name in ("a", "b"):
        (tmp_path / "labels" / f"{name}.csv").write_text("frame,x1,y1,x2,y2\n")
    (tmp_path / "odd.cfg").write_text("[net]\nwidth=64\nheight=64\n[lstm]\noutput=3\n")
    (tmp_path / "short.weights").write_bytes(struct.pack("<iiiq", 0, 2, 5, 0) + bytes(400))
    before = set(tmp_path.rglob("*"))
    command = ["detector", "compare", str(scene.path), "-o", str(tmp_path / "out"), "--test", "b"]
    with pytest.raises(SystemExit) as stopped:
        main([*command, *words.format(t=tmp_path).split()])
    assert stopped.value.code == 2
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert line.startswith("error: ")
    assert said in line
    assert set(tmp_path.rglob("*")) == before


def test_what_measures_is_asked_for_before_anything_is_trained(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycocotools", None)
    trained = _fails("yolov3", monkeypatch, None)
    with pytest.raises(InputError, match=r'pycocotools is not .* "sightline\[train\]"'):
        compare_detectors(
            scene, _recipe(), ("b",), tmp_path / "out", ComparisonSettings(("yolov3",))
        )
    assert trained == []


def test_cuda_where_there_is_none_is_said_in_a_line(
    scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def without(*_args: object, **_more: object) -> None:
        raise RuntimeError("no NVIDIA driver")

    # As torch does without a driver, so that a machine with one tests the same.
    monkeypatch.setattr(loop.torch, "zeros", without)
    for command in ("train", "compare"):
        words = ["--arch", "harbour", "--device", "cuda", "-o", str(tmp_path / "out")]
        more = ["--test", "b", "--no-augmentations"] if command == "compare" else []
        with pytest.raises(SystemExit) as stopped:
            main(["detector", command, str(scene.path), *words, *more])
        assert stopped.value.code == 2
        (line,) = capfd.readouterr().err.strip().splitlines()
        assert "the device 'cuda' is not to be had here; use cpu, or auto" in line
    assert not (tmp_path / "out").exists()


def _fails(name: str, monkeypatch: pytest.MonkeyPatch, error: Exception | None) -> list[str]:
    """Has one architecture fail when it is exported; notes which were trained."""
    trained: list[str] = []
    real = comparison.train_detector

    def train(scene: Scene, recipe: Recipe, folder: Path, **more: object) -> object:
        trained.append(folder.name)
        made = real(scene, recipe, folder, **more)
        if recipe.architecture == name and error is not None:
            raise error
        return made

    monkeypatch.setattr(comparison, "train_detector", train)
    return trained


def _written(folder: Path) -> dict[str, object]:
    content = json.loads((folder / COMPARISON).read_text())
    assert isinstance(content, dict)
    return content


BOTH = ComparisonSettings(("yolov3", "yolov4"), SMALL, augmentations=False)


def test_one_that_fails_does_not_cost_the_others_their_rows(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    _fails("yolov3", monkeypatch, ExportError("yolov3.onnx: differs\nby 1.1"))
    made = compare_detectors(scene, _recipe(), ("b",), out, BOTH)
    assert [row.name for row in made.rows] == ["yolov4"]
    assert made.failed == {"yolov3": "yolov3.onnx: differs by 1.1"}
    assert _written(out)["failed"] == made.failed
    table = (out / TABLE).read_text()
    assert "| yolov4 | " in table
    assert table.splitlines()[-1] == "yolov3 could not be compared: yolov3.onnx: differs by 1.1"


def test_when_all_fail_the_first_reason_is_raised(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _fails("yolov3", monkeypatch, ExportError("differs"))
    with pytest.raises(ExportError, match="differs"):
        compare_detectors(
            scene, _recipe(), ("b",), tmp_path / "out", replace(BOTH, architectures=("yolov3",))
        )


def test_a_failure_is_a_line_and_a_status_when_the_rest_is_done(
    scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    _fails("yolov4", monkeypatch, RuntimeError("no memory"))
    words = ["--arch", "yolov4,yolov3", "--size", "64x64", "--batch", "2", "--steps", "1"]
    words += ["--no-augmentations", "--train", "a", "--test", "b", "--device", "cpu"]
    for name, options in SMALL.items():
        words += ["--option", f"{name}.cfg={options['cfg']}"]
    with pytest.raises(SystemExit) as stopped:
        main(["detector", "compare", str(scene.path), "-o", str(tmp_path / "out"), *words])
    assert stopped.value.code == 2
    said = capfd.readouterr()
    assert "yolov3" in said.out
    errors = [line for line in said.err.splitlines() if line.startswith("error: ")]
    assert errors == ["error: yolov4 could not be compared: no memory"]
    assert list(_written(tmp_path / "out")["detectors"]) == ["yolov3"]


def test_rows_are_kept_as_they_come_and_are_not_measured_twice(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    trained = _fails("yolov4", monkeypatch, KeyboardInterrupt())  # type: ignore[arg-type]
    with pytest.raises(KeyboardInterrupt):
        compare_detectors(scene, _recipe(), ("b",), out, BOTH)
    first = _written(out)["detectors"]
    assert list(first) == ["yolov3"]
    assert trained == ["yolov3", "yolov4"]

    monkeypatch.undo()
    trained = _fails("yolov4", monkeypatch, None)
    compare_detectors(scene, _recipe(), ("b",), out, BOTH)
    assert trained == ["yolov4"]
    both = _written(out)["detectors"]
    assert list(both) == ["yolov3", "yolov4"]
    assert both["yolov3"] == first["yolov3"]
    compare_detectors(scene, _recipe(), ("b",), out, BOTH)
    assert trained == ["yolov4"]
    assert _written(out)["detectors"] == both


def _another_box(scene: Scene, out: Path) -> dict[str, object]:
    path = scene.path.parent / "boxes" / "b.csv"
    path.write_text(path.read_text().rpartition("\n5,")[0] + "\n")
    return {}


def _damaged(scene: Scene, out: Path) -> dict[str, object]:
    (out / "yolov3" / MEASURED).write_text("{")
    return {}


def _no_detector(scene: Scene, out: Path) -> dict[str, object]:
    (out / "yolov3" / "yolov3.onnx").unlink()
    return {}


@pytest.mark.parametrize("change", [_another_box, _damaged, _no_detector])
def test_what_was_measured_of_something_else_is_measured_anew(
    change: Callable[[Scene, Path], dict[str, object]],
    scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "out"
    one = replace(BOTH, architectures=("yolov3",))
    before = compare_detectors(scene, _recipe(), ("b",), out, one)
    change(scene, out)
    trained = _fails("yolov3", monkeypatch, None)
    after = compare_detectors(Scene.load(scene.path), _recipe(), ("b",), out, one)
    assert trained == ["yolov3"]
    # The training itself was whole, and is not repeated.
    assert after.rows[0].training_s == before.rows[0].training_s
    assert after.rows[0].report.drawn == (5 if change is _another_box else 6)


def test_another_recipe_is_said_in_the_row(scene: Scene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    one = replace(BOTH, architectures=("yolov3",))
    compare_detectors(scene, _recipe(), ("b",), out, one)
    longer = replace(_recipe(), training=TrainingSettings(steps=3, device="cpu", threads=1))
    made = compare_detectors(scene, longer, ("b",), out, BOTH)
    assert [row.name for row in made.rows] == ["yolov4"]
    assert "is of a run with other settings" in made.failed["yolov3"]


def test_a_row_is_the_same_after_it_was_written(tmp_path: Path) -> None:
    report = DetectionReport(
        frames=3, drawn=0, found=0, map_50=math.nan, map_50_95=math.nan, iou=0.3, threshold=0.0,
        recall=math.nan, precision=math.nan, false_per_frame=0.0, allowed_per_frame=1.0,
        recall_at_allowed=math.nan, threshold_at_allowed=math.nan, mean_iou=math.nan,
        mean_giou=math.nan, foot_px=math.nan,
    )  # fmt: skip
    row = ComparedDetector("harbour", 10, 20, 3.0, 4, math.nan, report)
    write_json(tmp_path / "a.json", row.to_dict())
    again = ComparedDetector.from_dict(json.loads((tmp_path / "a.json").read_text()))
    assert repr(again) == repr(row)


def test_the_figure_is_written_with_the_variants_there_are(tmp_path: Path) -> None:
    history = {"YOLO only": [{"step": 1.0, "score": 0.2, "giou_loss": 1.5}]}
    write_comparison(DetectorComparison((), history, {}, {}, {}), tmp_path)
    assert (tmp_path / FIGURE).read_bytes()[:4] == b"\x89PNG"
    assert _written(tmp_path)["augmentation"] == history


def test_wrong_options_are_said_before_anything_is_trained(scene: Scene, tmp_path: Path) -> None:
    options = SMALL | {"yolov4": {"depth": 3}}
    with pytest.raises(InputError, match="unknown option of yolov4 'depth'"):
        compare_detectors(
            scene, _recipe(), ("b",), tmp_path / "out", replace(BOTH, options=options)
        )
    assert not (tmp_path / "out").exists()
