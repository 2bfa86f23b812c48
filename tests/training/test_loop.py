from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from pond import picture
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from safetensors.torch import load_file

from sightline.errors import InputError
from sightline.training import ARCHITECTURES, Prediction, Target, Trainable, build, loop
from sightline.training.architecture import _MODULES
from sightline.training.augmentation import Augmentation, Batches, BatchSettings
from sightline.training.data import Picture
from sightline.training.export import TOLERANCE, ExportError, export_onnx
from sightline.training.loop import (
    CHECKPOINT,
    CONFIGURATION,
    WEIGHTS,
    TrainingResult,
    TrainingSettings,
    Validation,
    find_device,
    load_weights,
    train,
    validate,
)

CLASSES = ("boat", "sailboat")
SMALL = {
    "harbour": {"width": 0.5},
    "yolox-nano": {"width": 0.125},
    # A checkpoint of the large ones takes a gigabyte.
    "yolov3": {"cfg": "yolov3-tiny"},
    "yolov4": {"cfg": "yolov4-tiny"},
}
THERE = [name for name in ARCHITECTURES if importlib.util.find_spec(_MODULES[name])]


class KilledError(Exception):
    pass


def _pictures() -> list[Picture]:
    found = []
    for seed, box in enumerate([(60, 70, 120, 100), (150, 90, 200, 120), (20, 40, 60, 60)]):
        boxes = np.array([box], np.float32)
        found.append(
            Picture(
                "a",
                seed,
                picture([box], seed),
                boxes,
                np.array([seed % 2]),
                np.zeros(1, bool),
                np.ones(1, np.float32),
            )
        )
    return found


def _batches(size_px: tuple[int, int] = (128, 128)) -> Batches:
    return Batches(_pictures(), [], [], Augmentation(), BatchSettings(size_px, batch=2, seed=1))


def _train(folder: Path, name: str, steps: int, kill_at: int = 0) -> Trainable:
    torch.manual_seed(5)
    trainable = build(name, CLASSES, **SMALL.get(name, {}))

    def tell(_what: str, share: float) -> None:
        if kill_at and share * steps > kill_at - 0.5:
            raise KilledError

    settings = TrainingSettings(
        steps=steps, warmup=2, validate_every=2, checkpoint_every=1, device="cpu", threads=1
    )
    train(trainable, _batches(), _pictures()[:1], settings, folder, {"data": 1}, progress=tell)
    return trainable


@pytest.mark.parametrize("name", THERE)
def test_each_architecture_trains_resumes_and_exports(name: str, tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        folder.mkdir()
    _train(whole, name, 4)
    with pytest.raises(KilledError):
        # Step 3 is done when the kill comes, and its checkpoint is not yet written.
        _train(killed, name, 4, kill_at=3)
    trainable = _train(killed, name, 4)
    expected = load_file(whole / CHECKPOINT)
    resumed = load_file(killed / CHECKPOINT)
    assert expected.keys() == resumed.keys()
    for key, value in expected.items():
        assert torch.equal(value, resumed[key]), key
    moved = build(name, CLASSES, **SMALL.get(name, {})).module.state_dict()
    assert any(
        not torch.equal(value, moved[key]) for key, value in trainable.module.state_dict().items()
    )
    path = tmp_path / f"{name}.onnx"
    assert export_onnx(trainable, path, size_px=(128, 128)) <= TOLERANCE
    model = onnx.load(path)
    assert model.ir_version <= 13
    assert model.opset_import[0].version <= 26


class _Clock:
    """Every look at it is ten seconds later."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        self.now_s += 10.0
        return self.now_s


def test_a_training_stops_when_its_minutes_are_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A step takes ten seconds by this clock, so a minute is six of a hundred.
    monkeypatch.setattr(loop, "time", _Clock())
    settings = TrainingSettings(
        steps=100, minutes=1.0, validate_every=2, checkpoint_every=1, device="cpu", threads=1
    )
    shares: list[float] = []

    def learn(kill_at: float = 2.0) -> TrainingResult:
        def tell(_what: str, share: float) -> None:
            shares.append(share)
            if share >= kill_at:
                raise KilledError

        trainable = build("harbour", CLASSES, width=0.5)
        return train(
            trainable, _batches(), _pictures()[:1], settings, tmp_path, {"data": 1}, progress=tell
        )

    with pytest.raises(KilledError):
        learn(kill_at=0.5)
    # Two steps of the first sitting were kept; what they took is not given again.
    made = learn()
    assert made.steps == 6
    assert made.learned_s == 60.0
    assert made.elapsed_s > made.learned_s
    assert not made.stopped_early
    assert shares == pytest.approx([1 / 6, 2 / 6, 3 / 6, 3 / 6, 4 / 6, 5 / 6, 1.0])
    assert [row["step"] for row in made.history] == [2.0, 4.0, 6.0]
    assert learn().steps == 6


@pytest.mark.parametrize("minutes", [-1.0, float("nan"), float("inf")])
def test_minutes_that_cannot_be_are_refused(minutes: float) -> None:
    with pytest.raises(InputError, match="minutes cannot be; give 0 for no limit"):
        TrainingSettings(minutes=minutes)


@pytest.mark.parametrize("name", THERE)
def test_losses_are_finite_without_boxes_and_with_open_regions(name: str) -> None:
    trainable = build(name, CLASSES, **SMALL.get(name, {}))
    trainable.module.train()
    nothing = Target(
        torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool)
    )
    everything = Target(
        torch.tensor([[0.0, 0.0, 128.0, 128.0]]),
        torch.zeros(1, dtype=torch.int64),
        torch.ones(1, dtype=torch.bool),
    )
    losses = trainable.losses(torch.rand(2, 3, 128, 128), [nothing, everything])
    for loss in losses.values():
        assert torch.isfinite(loss)


def test_harbour_learns_to_find_a_boat() -> None:
    torch.manual_seed(0)
    trainable = build("harbour", ("boat",), width=0.5)
    optimizer = torch.optim.AdamW(trainable.module.parameters(), lr=4e-3)
    plain = Augmentation(
        rotation=False, brightness=False, exposure=False, blur=False, noise=False, color=False,
        compression=False, scales=(0.8, 1.2),
    )  # fmt: skip
    pictures = [replace(one, labels=np.zeros(1, np.int64)) for one in _pictures()]
    batches = Batches(pictures, [], [], plain, BatchSettings((160, 128), batch=4, seed=0))
    trainable.module.train()
    for number in range(160):
        optimizer.param_groups[0]["lr"] = 4e-3 * (1.0 - number / 160.0)
        images, targets = batches(number)
        loss = torch.stack(list(trainable.losses(images, targets).values())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    seen = validate(trainable, pictures, torch.device("cpu"))
    assert seen.score > 0.9
    assert seen.giou_loss < 0.4


def test_an_open_region_teaches_nothing() -> None:
    torch.manual_seed(0)
    trainable = build("harbour", CLASSES, width=0.5)
    everywhere = Target(
        torch.tensor([[0.0, 0.0, 64.0, 64.0]]),
        torch.zeros(1, dtype=torch.int64),
        torch.ones(1, dtype=torch.bool),
    )
    losses = trainable.losses(torch.rand(1, 3, 64, 64), [everywhere])
    assert losses["class"].item() == 0.0


class _Fixed:
    """Finds what it is told to."""

    name = "fixed"
    class_names = CLASSES
    stride = 32

    def __init__(self, found: list[Prediction]) -> None:
        self.module = torch.nn.Identity()
        self._found = iter(found)

    def losses(self, images: torch.Tensor, targets: object) -> dict[str, torch.Tensor]:
        raise NotImplementedError

    def predict(self, *_args: object) -> list[Prediction]:
        return [next(self._found)]

    def export_module(self) -> object:
        raise NotImplementedError


def test_average_precision_is_that_of_coco() -> None:
    rng = np.random.default_rng(2)
    pictures, found, truths, results = [], [], [], []
    for number in range(12):
        corner = rng.uniform(0, 180, (4, 2))
        boxes = np.concatenate([corner, corner + rng.uniform(10, 60, (4, 2))], axis=1)
        labels = rng.integers(0, 2, 4)
        blank = np.zeros((256, 256, 3), np.uint8)
        pictures.append(
            Picture(
                "a",
                number,
                blank,
                boxes.astype(np.float32),
                labels,
                np.zeros(4, bool),
                np.ones(4, np.float32),
            )
        )
        guess = np.concatenate([boxes + rng.normal(0, 4, (4, 4)), boxes[:2] + 100.0])
        score = rng.uniform(0.1, 1.0, 6)
        kind = np.concatenate([labels, [0, 1]])
        order = np.argsort(-score)
        found.append(
            Prediction(
                torch.from_numpy(guess[order]),
                torch.from_numpy(score[order]),
                torch.from_numpy(kind[order]),
            )
        )
        for box, label in zip(boxes.astype(np.float32).astype(float), labels, strict=True):
            sides = box[2:] - box[:2]
            truths.append(
                {
                    "id": len(truths) + 1, "image_id": number, "category_id": int(label),
                    "bbox": [*box[:2], *sides], "area": float(sides.prod()), "iscrowd": 0,
                }
            )  # fmt: skip
        results += [
            {
                "image_id": number, "category_id": int(k), "score": float(s),
                "bbox": [*b[:2], *(b[2:] - b[:2])],
            }
            for b, s, k in zip(guess, score, kind, strict=True)
        ]  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        oracle = COCO()
        oracle.dataset = {
            "images": [{"id": number} for number in range(12)],
            "annotations": truths,
            "categories": [{"id": 0}, {"id": 1}],
        }
        oracle.createIndex()
        evaluation = COCOeval(oracle, oracle.loadRes(results), "bbox")
        evaluation.params.iouThrs = np.array([0.5])
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][0, :, :, 0, -1].mean(axis=0)
    seen = validate(_Fixed(found), pictures, torch.device("cpu"))  # type: ignore[arg-type]
    assert seen.ap50["boat"] == pytest.approx(precision[0], abs=1e-6)
    assert seen.ap50["sailboat"] == pytest.approx(precision[1], abs=1e-6)


def _in_view(
    boxes: list[list[float]], found: list[list[float]], ignore: list[bool] | None = None
) -> Validation:
    """Average precision of boxes that are found in this order of confidence, all boats."""
    known = Picture(
        *("a", 0, np.zeros((64, 64, 3), np.uint8), np.array(boxes, np.float32)),
        np.zeros(len(boxes), np.int64),
        np.array(ignore if ignore is not None else [False] * len(boxes)),
        np.ones(len(boxes), np.float32),
    )
    scores = 0.9 - 0.1 * torch.arange(len(found))
    seen = Prediction(torch.tensor(found), scores, torch.zeros(len(found), dtype=torch.int64))
    return validate(_Fixed([seen]), [known], torch.device("cpu"))  # type: ignore[arg-type]


NEAR, FAR, OPEN = [4.0, 4.0, 24.0, 20.0], [34.0, 10.0, 50.0, 18.0], [2.0, 40.0, 60.0, 62.0]


def test_a_boat_is_found_once() -> None:
    # One of two: the precision is 1 up to a recall of a half, which are 51 of 101 values.
    assert _in_view([NEAR, FAR], [NEAR, NEAR]).ap50["boat"] == pytest.approx(51 / 101)
    # The third box finds the other, at a precision of two thirds.
    seen = _in_view([NEAR, FAR], [NEAR, NEAR, FAR])
    assert seen.ap50["boat"] == pytest.approx((51 + 50 * 2 / 3) / 101)


def test_what_is_found_in_an_open_region_is_neither_right_nor_wrong() -> None:
    inside, beside = [10.0, 44.0, 30.0, 56.0], [10.0, 24.0, 30.0, 36.0]
    seen = _in_view([NEAR, OPEN], [inside, NEAR], [False, True])
    assert seen.ap50["boat"] == pytest.approx(1.0)
    # Elsewhere it is wrong, and halves the precision.
    seen = _in_view([NEAR, OPEN], [beside, NEAR], [False, True])
    assert seen.ap50["boat"] == pytest.approx(0.5)


class _Slope:
    """A weight that each batch pulls down by the learning rate, as Adam does with one gradient."""

    name = "slope"
    class_names = CLASSES
    stride = 32

    def __init__(self, *, bad: tuple[int, ...] = ()) -> None:
        self.module = torch.nn.BatchNorm2d(3)
        self.weights: list[float] = []
        self._bad = bad

    def losses(self, images: torch.Tensor, *_: object) -> dict[str, torch.Tensor]:
        weight = self.module.bias
        self.weights.append(float(weight[0].detach()))
        if len(self.weights) - 1 in self._bad:
            return {"sum": (self.module(images * float("nan")) + weight[:, None, None]).sum()}
        return {"sum": 0.0 * self.module(images).sum() + weight.sum()}

    def predict(self, *_args: object) -> list[Prediction]:
        raise NotImplementedError

    def export_module(self) -> object:
        raise NotImplementedError


def _descend(folder: Path, slope: _Slope, **settings: object) -> TrainingResult:
    chosen = TrainingSettings(device="cpu", threads=1, **settings)  # type: ignore[arg-type]

    def batches(_number: int) -> tuple[torch.Tensor, list[Target]]:
        return torch.rand(2, 3, 32, 32), []

    return train(slope, batches, [], chosen, folder, {})  # type: ignore[arg-type]


def test_the_learning_rate_rises_and_falls_as_half_a_cosine(tmp_path: Path) -> None:
    slope = _Slope()
    _descend(tmp_path, slope, steps=60, rate=0.01, warmup=10, last_rate=0.1, validate_every=60)
    rates = -np.diff(slope.weights)
    np.testing.assert_allclose(rates[:10], 0.01 * np.arange(1, 11) / 10, rtol=1e-3)
    along = np.arange(49) / 50
    wanted = 0.01 * (0.1 + 0.9 * (1.0 + np.cos(np.pi * along)) / 2.0)
    np.testing.assert_allclose(rates[10:], wanted, rtol=1e-3)
    assert rates[10] == pytest.approx(0.01, rel=1e-3)
    assert rates[-1] < 0.0011


def test_a_batch_that_is_no_number_teaches_nothing_and_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    slope = _Slope(bad=(3, 4, 7))
    with caplog.at_level(logging.WARNING, "sightline"):
        made = _descend(tmp_path, slope, steps=12, rate=0.01, warmup=0, validate_every=6)
    steps = np.diff(slope.weights)
    assert np.isfinite(slope.weights).all()
    assert (steps == 0.0).tolist() == [number in (3, 4, 7) for number in range(11)]
    for name, value in slope.module.state_dict().items():
        assert torch.isfinite(value).all(), name
    # The losses that are told are those of the batches that taught.
    first = [3.0 * slope.weights[number] for number in (0, 1, 2, 5)]
    assert made.history[0]["loss_sum"] == pytest.approx(np.mean(first), abs=1e-6)
    said = [record.getMessage() for record in caplog.records]
    assert [line.split(",")[0] for line in said] == [
        "step 6: of the last 6 batches 2 had a gradient that is not finite",
        "step 12: of the last 6 batches 1 had a gradient that is not finite",
    ]


def test_a_training_whose_batches_are_all_bad_is_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    slope = _Slope(bad=(0, 1))
    with caplog.at_level(logging.WARNING, "sightline"):
        made = _descend(tmp_path, slope, steps=2, validate_every=2)
    assert "of the last 2 batches 2 had" in caplog.text
    assert "loss_sum" not in made.history[0]


@pytest.mark.parametrize("patience", [1, 3])
def test_patience_is_so_many_validations_without_a_better_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, patience: int
) -> None:
    scores = iter([0.3, 0.5, *np.linspace(0.4, 0.1, 20)])

    def judge(*_: object) -> Validation:
        return Validation({"boat": math.nan}, math.nan, float(next(scores)))

    monkeypatch.setattr(loop, "validate", judge)
    settings = TrainingSettings(
        steps=60, warmup=1, validate_every=2, patience=patience, device="cpu", threads=1
    )
    trainable = build("harbour", CLASSES, width=0.5)
    made = train(trainable, _batches((64, 64)), _pictures()[:1], settings, tmp_path, {})
    assert made.best_step == 4
    assert made.steps == 4 + 2 * patience
    assert made.stopped_early


def test_training_stops_when_it_gets_no_better(tmp_path: Path) -> None:
    trainable = build("harbour", CLASSES, width=0.5)
    settings = TrainingSettings(
        steps=50, rate=1e-9, warmup=1, validate_every=1, patience=3, device="cpu"
    )
    result = train(trainable, _batches(), _pictures(), settings, tmp_path, {})
    assert result.stopped_early
    assert result.steps < 50
    assert (tmp_path / WEIGHTS).exists()


def test_a_folder_with_another_run_is_refused(tmp_path: Path) -> None:
    _train(tmp_path, "harbour", 1)
    with pytest.raises(InputError, match="other settings or other data"):
        _train(tmp_path, "harbour", 2)


def test_a_configuration_of_something_else_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / CONFIGURATION
    for content in ('{"editor": "mine"}', "[1]", "no JSON"):
        path.write_text(content, encoding="utf-8")
        with pytest.raises(InputError, match="is there, and of no training"):
            _train(tmp_path, "harbour", 1)
        assert path.read_text(encoding="utf-8") == content
        assert list(tmp_path.iterdir()) == [path]


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    _train(tmp_path, "harbour", 1)
    path = tmp_path / CHECKPOINT
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="is damaged or no file of weights"):
        _train(tmp_path, "harbour", 1)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    _train(tmp_path, "harbour", 1)
    with pytest.raises(InputError, match="another size"):
        load_weights(tmp_path / WEIGHTS, build("harbour", CLASSES, width=1.0))
    with pytest.raises(InputError, match="other classes"):
        load_weights(tmp_path / WEIGHTS, build("harbour", ("boat",), width=0.5))
    with pytest.raises(InputError, match="there is no such file"):
        load_weights(tmp_path / "none.safetensors", build("harbour", CLASSES, width=0.5))


def test_a_device_that_is_not_there_is_refused() -> None:
    assert find_device("cpu").type == "cpu"
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="not to be had here"):
            find_device("cuda")
    with pytest.raises(InputError, match="not to be had here"):
        find_device("abacus")


def test_an_export_that_differs_is_not_written(tmp_path: Path) -> None:
    trainable = build("harbour", CLASSES, width=0.5)
    module, info = trainable.export_module()

    class Restless(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = module

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            # A constant in the trace, another number in each call.
            return self.inner(images) + float(np.random.default_rng().uniform(1.0, 2.0))

    trainable.export_module = lambda: (Restless(), info)  # type: ignore[method-assign]
    with pytest.raises(ExportError, match="differs by"):
        export_onnx(trainable, tmp_path / "a.onnx", size_px=(64, 64))
    assert list(tmp_path.iterdir()) == []
