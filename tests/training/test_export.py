"""Exported files: what they say, and what they find."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from torch import nn

from sightline.cli import main
from sightline.detection import _onnxruntime
from sightline.detection.classes import COCO
from sightline.detection.decoders import Outputs, decoder_by_name
from sightline.detection.metadata import KEY, read_metadata
from sightline.detection.onnx import DetectorOptions, OnnxDetector
from sightline.detection.tiling import TilingSettings
from sightline.errors import InputError
from sightline.training import Trainable, build
from sightline.training.architecture import InputFormat
from sightline.training.darknet.cfg import published
from sightline.training.darknet.module import DarknetModule
from sightline.training.darknet.weights import write_weights
from sightline.training.export import ExportError, _paired, _photograph, export_onnx
from sightline.training.loop import CONFIGURATION, WEIGHTS, save_weights
from sightline.training.trained import load_darknet, load_mean, load_trained, read_names
from sightline.types import Frame

SMALL = {
    "yolov3": {"cfg": "yolov3-tiny"},
    "yolov4": {"cfg": "yolov4-tiny"},
    "efficientdet-d0": {},
    "faster-rcnn": {},
}
CLASSES = ("boat", "buoy")


def _excited(name: str, **options: Any) -> Trainable:
    """A network with random weights that takes many things for boats."""
    torch.manual_seed(3)
    trainable = build(name, CLASSES, **SMALL[name], **options)
    if name == "faster-rcnn":
        nn.init.normal_(trainable.module.roi_heads.box_predictor.cls_score.weight, std=0.1)
        # Enough to compare.
        trainable.module.rpn._post_nms_top_n["testing"] = 50
    if name.startswith("yolo"):
        for output in trainable.darknet.network.head_convolutions:  # type: ignore[attr-defined]
            convolution = trainable.module.layers[output].convolution
            nn.init.normal_(convolution.weight, std=0.02)
            nn.init.zeros_(convolution.bias)
            with torch.no_grad():
                # Sure of itself, and moderate in the sides of boxes.
                convolution.weight.view(3, 7, -1)[:, 4:] *= 30.0
    if name == "efficientdet-d0":
        head = trainable.module.network.class_net.predict
        nn.init.zeros_(head.conv_pw.bias)
        nn.init.normal_(head.conv_pw.weight, std=0.3)
    trainable.module.eval()
    return trainable


def _picture(width: int, height: int) -> np.ndarray[Any, Any]:
    rng = np.random.default_rng(7)
    picture = rng.integers(60, 120, (height, width, 3))
    picture[height // 3 : height // 2, width // 4 : width // 2] = (250, 40, 90)
    return picture.astype(np.uint8)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, {}) for name in SMALL),
        ("efficientdet-d0", {"norm": "batch"}),
        # The file speaks of the published anchors all the same.
        ("efficientdet-d0", {"anchor_scale": 1.5}),
    ],
)
def test_a_file_finds_what_the_network_finds(
    name: str, options: dict[str, Any], tmp_path: Path
) -> None:
    trainable = _excited(name, **options)
    path = tmp_path / f"{name}.onnx"
    export_onnx(trainable, path, size_px=(256, 128), default_classes=CLASSES)
    picture = _picture(256, 128)
    batch = torch.from_numpy(picture.transpose(2, 0, 1)[None].astype(np.float32) / 255.0)
    with torch.no_grad():
        (wanted,) = trainable.predict(batch, 0.3)
    assert len(wanted.scores) > 0

    session = _onnxruntime.load().InferenceSession(str(path), providers=["CPUExecutionProvider"])
    said = read_metadata(str(path), session.get_modelmeta().custom_metadata_map)
    assert said is not None
    arrays = tuple(session.run(None, {"images": batch.numpy()}))
    names = tuple(output.name for output in session.get_outputs())
    outputs = Outputs(names, arrays, (256, 128), said.anchors, said.scale_xy, labelled=True)
    found = decoder_by_name(said.decoder).of_one(outputs, 0)
    for box, score, label in zip(wanted.boxes_xyxy_px, wanted.scores, wanted.labels, strict=True):
        apart = np.abs(found.xyxy_px - box.numpy()).max(axis=1)
        apart = np.where(np.abs(found.scores[:, label] - float(score)) < 1e-3, apart, np.inf)
        # An anchor's box may be a thousand pixels wide.
        assert apart.min() < 1e-3 * max(1.0, float(box.abs().max()))

    # The detector that runs files takes this one, and finds something in the whole frame.
    detector = OnnxDetector(path, options=DetectorOptions(views=TilingSettings(kind="whole")))
    assert detector.decoder == said.decoder
    assert len(detector.detect(Frame(0, 0.0, picture[..., ::-1].copy())).xyxy_px) > 0


def test_the_real_network_agrees_with_its_file_to_four_digits(
    data_dir: Path, tmp_path: Path
) -> None:
    source = data_dir / "weights" / "yolo-fastest-1.1-xl"
    trainable = load_darknet(f"{source}.cfg", f"{source}.weights")
    path = tmp_path / "fastest.onnx"
    assert export_onnx(trainable, path) < 1e-4
    session = _onnxruntime.load().InferenceSession(str(path), providers=["CPUExecutionProvider"])
    picture = torch.rand(2, 3, 224, 416, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        wanted = trainable.module(picture)
    for ours, theirs in zip(wanted, session.run(None, {"images": picture.numpy()}), strict=True):
        assert float(np.abs(ours.numpy() - theirs).max()) < 1e-4


def test_a_file_says_what_it_is(tmp_path: Path) -> None:
    trainable = build("yolov4", CLASSES, cfg="yolov4-tiny")
    export_onnx(trainable, tmp_path / "a.onnx", size_px=(320, 200), fixed=True)
    session = _onnxruntime.load().InferenceSession(str(tmp_path / "a.onnx"))
    assert session.get_inputs()[0].shape == [1, 3, 224, 320]
    said = read_metadata("a.onnx", session.get_modelmeta().custom_metadata_map)
    assert said is not None
    assert said.classes == CLASSES
    assert said.default_classes == ("boat",)
    assert said.decoder == "darknet"
    assert said.input.size == (320, 224)
    assert said.scale_xy == (1.05, 1.05)
    assert said.anchors is not None
    assert said.anchors[0][0] == (81.0, 82.0)
    model = __import__("onnx").load(str(tmp_path / "a.onnx"))
    assert model.ir_version <= 13
    assert all(one.version <= 26 for one in model.opset_import)


def test_lists_of_boxes_are_compared_whatever_their_order() -> None:
    boxes = torch.tensor([[0.0, 0, 10, 10], [5, 5, 9, 9], [1, 1, 2, 2]])
    labels, scores = torch.tensor([0, 1, 0]), torch.tensor([0.9, 0.9, 0.051])
    swapped = [boxes.numpy()[[1, 0]], labels.numpy()[[1, 0]], scores.numpy()[[1, 0]]]
    ours, theirs = _paired((boxes, labels, scores), swapped)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one.numpy(), other)
    missing = [boxes.numpy()[:1], labels.numpy()[:1], scores.numpy()[:1]]
    ours, theirs = _paired((boxes, labels, scores), missing)
    assert ours[0].shape != theirs[0].shape


class _Odd(nn.Module):  # type: ignore[misc]
    """Counts how often it is called, as no exported file can."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return images.mean(dim=(1,)) + self.calls


def test_a_file_that_disagrees_is_not_left_behind(tmp_path: Path) -> None:
    trainable = build("yolov3", CLASSES, cfg="yolov3-tiny")
    _, info = trainable.export_module()
    info = type(info)("yolov5")
    trainable.export_module = lambda: (_Odd(), info)  # type: ignore[method-assign]
    with pytest.raises(ExportError, match="differs by"):
        export_onnx(trainable, tmp_path / "a.onnx")
    assert not list(tmp_path.iterdir())


class _Seeing(nn.Module):  # type: ignore[misc]
    """Notes what it is given; a picture without any red is nothing to it."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[torch.Tensor] = []

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.seen.append(images)
        return images[:, :1].log()


def _seeing(color: str = "rgb") -> tuple[Trainable, _Seeing]:
    trainable = build("yolov3", CLASSES, cfg="yolov3-tiny")
    _, info = trainable.export_module()
    module = _Seeing()
    given = type(info)("yolov5", input_format=InputFormat(color=color))
    trainable.export_module = lambda: (module, given)  # type: ignore[method-assign]
    return trainable, module


@pytest.mark.parametrize("color", ["rgb", "bgr"])
def test_a_file_is_checked_with_the_pictures_that_are_given(color: str, tmp_path: Path) -> None:
    trainable, module = _seeing(color)
    pictures = [np.full((200, 300, 3), (value, 20, 30), np.uint8) for value in (50, 60, 70)]
    export_onnx(trainable, tmp_path / "a.onnx", size_px=(256, 128), pictures=pictures)
    red, blue = (0, 2) if color == "rgb" else (2, 0)
    seen = torch.cat([one[:, red, 5, 5] for one in module.seen])
    assert set((seen * 255.0).round().int().tolist()) == {50, 60, 70}
    last = module.seen[-1]
    assert last.shape == (2, 3, 160, 320)
    assert float(last[0, blue, 5, 5]) == pytest.approx(30 / 255)
    # Beyond the picture there is what frames are filled up with.
    assert float(last[0, red, 5, 310]) == pytest.approx(114 / 255)


def test_what_is_not_a_number_is_a_difference(tmp_path: Path) -> None:
    trainable, _ = _seeing()
    black = [np.zeros((200, 300, 3), np.uint8)]
    trainable.export_module()[0].register_forward_hook(lambda *given: given[2] * 0.0)
    with pytest.raises(ExportError, match="differs by nan"):
        export_onnx(trainable, tmp_path / "a.onnx", pictures=black)
    assert not list(tmp_path.iterdir())


def test_without_pictures_the_check_has_as_much_of_each_frequency_as_a_photograph() -> None:
    pixels = _photograph((2, 3, 256, 256), 1).numpy()
    assert pixels.min() >= 0.0
    assert pixels.max() <= 1.0
    assert pixels.std() == pytest.approx(0.2, abs=0.03)
    power = np.abs(np.fft.rfft(pixels - pixels.mean(), axis=3)).mean(axis=(0, 1, 2))
    # Along a line of a picture of which the amplitude falls as 1/f, it falls as its square root.
    slope = np.polyfit(np.log(np.arange(4, 64)), np.log(power[4:64]), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.2)
    assert not np.array_equal(pixels, _photograph((2, 3, 256, 256), 2).numpy())


def _trained(folder: Path, seed: int = 0, **options: object) -> Trainable:
    torch.manual_seed(seed)
    trainable = build("yolov4", CLASSES, cfg="yolov4-tiny")
    folder.mkdir()
    save_weights(folder / WEIGHTS, trainable, trainable.module.state_dict())
    content = {
        "architecture": "yolov4",
        "classes": list(CLASSES),
        "options": {"cfg": "yolov4-tiny", "weights": "gone.weights", **options},
    }
    (folder / CONFIGURATION).write_text(json.dumps(content))
    return trainable


def test_a_training_is_read_from_its_folder(tmp_path: Path) -> None:
    trainable = _trained(tmp_path / "run")
    for path in (tmp_path / "run", tmp_path / "run" / WEIGHTS):
        again = load_trained(path)
        assert again.class_names == CLASSES
        for name, value in trainable.module.state_dict().items():
            assert torch.equal(again.module.state_dict()[name], value)


def test_trainings_have_a_mean(tmp_path: Path) -> None:
    one, other = (_trained(tmp_path / f"run{seed}", seed).module.state_dict() for seed in (0, 1))
    mean = load_mean([tmp_path / "run0", tmp_path / "run1"]).module.state_dict()
    differing = 0
    for name, value in mean.items():
        wanted = ((one[name] + other[name]) / 2).to(value.dtype)
        torch.testing.assert_close(value, wanted)
        differing += int(not torch.equal(one[name], other[name]))
    assert differing > 10
    alone = load_mean([tmp_path / "run1"]).module.state_dict()
    assert all(torch.equal(value, other[name]) for name, value in alone.items())


def test_trainings_of_two_networks_have_no_mean(tmp_path: Path) -> None:
    _trained(tmp_path / "run")
    wider = build("harbour", CLASSES, width=1.5)
    for name, network, options in (
        ("small", build("harbour", CLASSES), {}),
        ("wide", wider, {"width": 1.5}),
    ):
        folder = tmp_path / name
        folder.mkdir()
        save_weights(folder / WEIGHTS, network, network.module.state_dict())
        content = {"architecture": "harbour", "classes": list(CLASSES), "options": options}
        (folder / CONFIGURATION).write_text(json.dumps(content))
    for first, second in (("run", "small"), ("small", "wide")):
        with pytest.raises(InputError, match=f"{second}: is not of the same network and classes"):
            load_mean([tmp_path / first, tmp_path / second])


def test_the_mean_of_trainings_is_exported_and_a_cfg_has_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in (0, 1):
        torch.manual_seed(seed)
        network = build("harbour", CLASSES)
        folder = tmp_path / f"run{seed}"
        folder.mkdir()
        save_weights(folder / WEIGHTS, network, network.module.state_dict())
        content = {"architecture": "harbour", "classes": list(CLASSES)}
        (folder / CONFIGURATION).write_text(json.dumps(content))
    out = tmp_path / "mean.onnx"
    two = (tmp_path / "run0", "--mean", tmp_path / "run1")
    assert _run("detector", "export", *two, "-o", out) == 0
    assert out.exists()
    weights = tmp_path / "a.weights"
    weights.write_bytes(b"")
    cfg = ("yolov4-tiny", weights, "--mean", tmp_path / "run1")
    assert _run("detector", "export", *cfg, "-o", tmp_path / "b.onnx") > 0
    assert "--mean is for folders that detector train left" in capsys.readouterr().err


def test_names_stand_one_in_a_line(tmp_path: Path) -> None:
    path = tmp_path / "a.names"
    path.write_text("boat\n wind surfer \n\n")
    assert read_names(path) == ("boat", "wind surfer")


def _run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in arguments])
    assert isinstance(stopped.value.code, int)
    return stopped.value.code


def test_darknet_files_are_exported_from_the_command_line(data_dir: Path, tmp_path: Path) -> None:
    source = data_dir / "weights" / "yolo-fastest-1.1-xl"
    out, told = tmp_path / "a.onnx", tmp_path / "a.json"
    files = (f"{source}.cfg", f"{source}.weights")
    command = ("detector", "export", *files, "-o", out, "--classes", "boat", "--json", told)
    assert _run(*command) == 0
    content = json.loads(told.read_text())
    assert content["classes"] == list(COCO)
    assert content["export_difference"] < 1e-4
    said = _onnxruntime.load().InferenceSession(str(out)).get_modelmeta().custom_metadata_map[KEY]
    assert json.loads(said)["default_classes"] == ["boat"]


def test_a_training_is_exported_from_the_command_line(tmp_path: Path) -> None:
    _trained(tmp_path / "run")
    assert _run("detector", "export", tmp_path / "run", "-o", tmp_path / "a.onnx") == 0
    assert (tmp_path / "a.onnx").stat().st_size > 1e6


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A .cfg of three classes with its weights, names, and things to go wrong."""
    network = published("yolov4-tiny").with_classes(3)
    from sightline.training.darknet.cfg import format_cfg

    (tmp_path / "three.cfg").write_text(format_cfg(network))
    write_weights(tmp_path / "three.weights", DarknetModule(network).dump())
    (tmp_path / "three.names").write_text("boat\nbuoy\ngull\n")
    (tmp_path / "two.names").write_text("boat\nbuoy\n")
    (tmp_path / "twice.names").write_text("boat\nboat\ngull\n")
    (tmp_path / "empty.names").write_text("\n")
    (tmp_path / "short.weights").write_bytes((tmp_path / "three.weights").read_bytes()[:-400])
    (tmp_path / "odd.cfg").write_text(format_cfg(network) + "[lstm]\noutput=3\n")
    return tmp_path


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("{t}/three.cfg {t}/three.weights", "tells 3 classes apart, and nothing says which"),
        ("{t}/three.cfg {t}/three.weights --names {t}/two.names", "has 2 names, and"),
        ("{t}/three.cfg {t}/three.weights --names {t}/twice.names", "a name twice"),
        ("{t}/three.cfg {t}/three.weights --names {t}/empty.names", "has no names"),
        ("{t}/three.cfg {t}/three.weights --names {t}/no.names", "cannot be read"),
        ("{t}/three.cfg {t}/short.weights --names {t}/three.names", "expected 5884944 numbers"),
        ("{t}/three.cfg {t}/no.weights --names {t}/three.names", "cannot be read"),
        ("{t}/three.cfg", "give the .weights behind it"),
        ("{t}/odd.cfg {t}/three.weights", "unknown section [lstm]; known are [net], [convol"),
        ("yolov4-tiny {t}/three.weights", "it would fit with classes=3 in place of 80"),
        ("{t}/no {t}/three.weights", "is no .cfg"),
        ("{t}/no", "config.json: cannot be read"),
        ("{t}/three.cfg {t}/three.weights --names {t}/three.names --size big", "--size 'big'"),
        (
            "{t}/three.cfg {t}/three.weights --names {t}/three.names --classes ship",
            "unknown class 'ship'; known are boat, buoy, gull",
        ),
    ],
)
def test_what_cannot_be_exported_is_said_in_a_line(
    command: str, said: str, tiny: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = set(tiny.iterdir())
    words = command.format(t=tiny).split()
    assert _run("detector", "export", *words, "-o", tiny / "out.onnx") == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert set(tiny.iterdir()) == before


def test_other_endings_and_files_that_are_read_are_refused(
    tiny: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ("detector", "export", tiny / "three.cfg", tiny / "three.weights", "-o")
    assert _run(*words, tiny / "a.pt") == 2
    assert "must end in .onnx" in capfd.readouterr().err
    assert _run(*words, tiny / "three.weights") == 2
    assert "is read by this command" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "is damaged"),
        ("[]", "does not say which network"),
        ('{"architecture": "yolov9", "classes": ["a"]}', "does not say which network"),
        ('{"architecture": "yolov4", "classes": []}', "does not say which network"),
        (
            '{"architecture": "yolov4", "classes": ["a"], "options": {"depth": 3}}',
            "unknown option of yolov4 'depth'; known are cfg",
        ),
        (
            '{"architecture": "yolov4", "classes": ["a"], "options": {"cfg": "yolov4-tiny"}}',
            "holds weights for other classes",
        ),
    ],
)
def test_a_damaged_training_is_refused(content: str, said: str, tmp_path: Path) -> None:
    _trained(tmp_path / "run")
    (tmp_path / "run" / CONFIGURATION).write_text(content)
    with pytest.raises(InputError, match=said):
        load_trained(tmp_path / "run")
