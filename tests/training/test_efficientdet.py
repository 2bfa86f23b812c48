"""What is particular to EfficientDet-D0; what all have in common is tested elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from pond import picture
from safetensors.torch import save_file
from torch import nn

from sightline.errors import InputError
from sightline.training import build
from sightline.training.augmentation import Augmentation, Batches, BatchSettings
from sightline.training.data import Picture
from sightline.training.efficientdet import _GroupNorm
from sightline.training.export import TOLERANCE, export_onnx
from sightline.training.loop import TrainingSettings, train

BOX = (60, 70, 120, 100)
SEA = "a sea of another size"
NEW = {
    "noise": np.random.default_rng(0).integers(0, 256, (512, 512, 3)).astype(np.uint8),
    "stripes": (np.indices((512, 512, 3))[0] // 8 % 2 * 255).astype(np.uint8),
    "black": np.zeros((512, 512, 3), np.uint8),
    SEA: picture([], 4).repeat(3, axis=0).repeat(3, axis=1)[:384, :768],
}


def _of(image: np.ndarray[Any, Any]) -> torch.Tensor:
    return torch.from_numpy(image.transpose(2, 0, 1).copy())[None].float() / 255.0


def test_after_a_short_training_on_small_crops_new_pictures_are_nothing_outrageous(
    tmp_path: Path,
) -> None:
    # Crops of 128 x 128 px leave one pixel to the coarsest level.
    known = Picture(
        "a", 0, picture([BOX], 0), np.array([BOX], np.float32), np.zeros(1, np.int64),
        np.zeros(1, bool), np.ones(1, np.float32),
    )  # fmt: skip
    batches = Batches([known], [], [], Augmentation(), BatchSettings((128, 128), batch=2, seed=1))
    torch.manual_seed(5)
    trainable = build("efficientdet-d0", ("boat",))
    settings = TrainingSettings(
        steps=30, warmup=5, validate_every=30, rate=1e-3, device="cpu", threads=1
    )
    train(trainable, batches, [], settings, tmp_path, {"data": 1})
    for name, image in NEW.items():
        with torch.no_grad():
            logits, offsets = trainable.module(_of(image))
        # With statistics of the batches, stripes come out at 174 and noise at 75.
        assert max(float(level.max()) for level in logits) < 5.0, name
        assert max(float(level.abs().max()) for level in offsets) < 20.0, name
    assert export_onnx(trainable, tmp_path / "a.onnx", pictures=[NEW[SEA]]) <= TOLERANCE


def test_groups_are_normalised_alike_in_training_and_evaluation() -> None:
    generator = torch.Generator().manual_seed(1)
    values = 5.0 + torch.randn(2, 24, 7, 9, generator=generator, dtype=torch.float64)
    reference = nn.GroupNorm(3, 24, eps=1e-3).double()
    own = _GroupNorm(24, nn.SiLU()).double()
    with torch.no_grad():
        for parameter in reference.parameters():
            parameter.copy_(torch.rand(24, generator=generator))
        own.load_state_dict(reference.state_dict())
        expected = nn.functional.silu(reference(values))
        for module in (own.train(), own.eval()):
            torch.testing.assert_close(module(values), expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("norm", "kind"), [("group", _GroupNorm), ("batch", nn.BatchNorm2d)])
def test_the_normalisation_is_the_same_everywhere(norm: str, kind: type) -> None:
    module = build("efficientdet-d0", ("boat",), norm=norm).module
    found = [part for part in module.modules() if isinstance(part, nn.GroupNorm | nn.BatchNorm2d)]
    # As published: the stem, a block of two and fifteen of three; 6 where channels are adapted, 24
    # in three cells of eight nodes, and three for each of five levels in both heads.
    assert len(found) == (1 + 2 + 45) + 6 + 24 + 30
    assert all(isinstance(part, kind) for part in found)
    # As published for one class.
    assert sum(parameter.numel() for parameter in module.parameters()) == 3_825_698


def test_small_boats_have_anchors_of_their_size() -> None:
    images = torch.zeros(1, 3, 128, 128)
    sides = {}
    for scale in (4.0, 1.5):
        trainable = build("efficientdet-d0", ("boat",), anchor_scale=scale)
        boxes = trainable._labeller(images).anchors.boxes  # type: ignore[attr-defined]
        sides[scale] = float((boxes[:, 2] - boxes[:, 0]).min() * (boxes[:, 3] - boxes[:, 1]).min())
    assert sides[1.5] / sides[4.0] == pytest.approx((1.5 / 4.0) ** 2, rel=1e-5)


def test_weights_of_a_network_with_batch_statistics_say_what_they_want(tmp_path: Path) -> None:
    path = tmp_path / "published.safetensors"
    given = build("efficientdet-d0", ("boat",), norm="batch").module.network.state_dict()
    save_file({name: value.contiguous() for name, value in given.items()}, str(path))
    with pytest.raises(InputError, match="add the option norm=batch"):
        build("efficientdet-d0", ("boat",), weights=str(path))
    taken = build("efficientdet-d0", ("boat",), weights=str(path), norm="batch").module.network
    for name, value in taken.state_dict().items():
        assert torch.equal(value, given[name])


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("efficientdet-d0", {"norm": "layer"}, "normalisation 'layer'; known are group, batch"),
        ("efficientdet-d0", {"anchor_scale": 0.0}, "anchors of 0 strides cannot be"),
        ("efficientdet-d0", {"anchor_scale": float("nan")}, "anchors of nan strides cannot be"),
        ("faster-rcnn", {"smallest_anchor_px": -8.0}, "anchors of -8 px cannot be"),
    ],
)
def test_options_that_cannot_be_are_refused(name: str, options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        build(name, ("boat",), **options)
