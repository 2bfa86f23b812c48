"""What YOLOv3 and YOLOv4 minimise, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from torch import Tensor
from torchvision.ops import complete_box_iou_loss, generalized_box_iou_loss

from sightline.errors import InputError
from sightline.training.architecture import Target
from sightline.training.darknet.cfg import Yolo, parse
from sightline.training.darknet.loss import YoloLoss, inside
from sightline.training.darknet.module import DarknetModule, decode, split_head
from sightline.training.darknet_family import build

ANCHORS = ((8.0, 8.0), (16.0, 16.0), (32.0, 16.0))
CERTAIN = 12.0
"""A logit whose sigmoid is 1 to six digits."""


def _head(**changes: float) -> Yolo:
    options = {"scale_x_y": 1.0, "ignore_thresh": 0.7, "iou_thresh": 1.0, **changes}
    settings = "".join(f"{name}={value}\n" for name, value in options.items())
    text = (
        "[net]\nwidth=64\nheight=64\n[convolutional]\nfilters=21\nsize=1\nstride=16\n"
        "activation=linear\n[yolo]\nmask=0,1,2\nanchors=8,8, 16,16, 32,16\nclasses=2\n" + settings
    )
    return parse(text, source="head").heads[0]


def _target(
    *boxes: tuple[float, ...], labels: tuple[int, ...] = (), ignore: bool = False
) -> Target:
    count = len(boxes)
    return Target(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        torch.tensor(labels or (0,) * count, dtype=torch.int64),
        torch.full((count,), ignore),
    )


def _silent() -> Tensor:
    """(1, 21, 4, 4) that says there is nothing anywhere."""
    output = torch.zeros(1, 3, 7, 4, 4)
    output[:, :, 4] = -CERTAIN
    return output.view(1, 21, 4, 4)


def _saying(output: Tensor, anchor: int, row: int, column: int, *values: float) -> Tensor:
    output = output.clone().view(1, 3, 7, 4, 4)
    output[0, anchor, :, row, column] = torch.tensor(values)
    return output.view(1, 21, 4, 4)


# In the cell of row 1 and column 2 (stride 16), its centre at a quarter of the cell; 16 x 16 px.
BOX = (28.0, 12.0, 44.0, 28.0)


def test_where_there_is_nothing_every_anchor_pays_for_its_doubt() -> None:
    losses = YoloLoss()([torch.full((1, 21, 4, 4), -2.0)], [_head()], [_target()])
    assert float(losses["box"]) == 0.0
    assert float(losses["classification"]) == 0.0
    # 48 anchors, each -log(1 - sigmoid(-2)).
    assert float(losses["objectness"]) == pytest.approx(48 * math.log1p(math.exp(-2)), rel=1e-5)


@pytest.mark.parametrize("box", ["mse", "giou", "ciou"])
def test_the_right_answer_costs_next_to_nothing(box: str) -> None:
    quarter = math.log(0.25 / 0.75)
    said = _saying(_silent(), 1, 1, 2, quarter, quarter, 0.0, 0.0, CERTAIN, -CERTAIN, CERTAIN)
    losses = YoloLoss(box=box)([said], [_head()], [_target(BOX, labels=(1,))])
    assert float(losses["objectness"]) < 1e-3
    assert float(losses["classification"]) < 1e-4
    # The cross-entropy of a quarter with itself is not zero; twice that, times its weight.
    entropy = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))
    weight = 2.0 - 16.0 * 16.0 / 64.0**2
    wanted = 2.0 * entropy * weight if box == "mse" else 0.0
    assert float(losses["box"]) == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize("scale", [1.0, 1.2])
def test_squared_errors_are_those_of_the_logarithms(scale: float) -> None:
    head = _head(scale_x_y=scale)
    inner = (0.25 - 0.5) / scale + 0.5
    place = math.log(inner / (1.0 - inner))
    exact = _saying(_silent(), 1, 1, 2, place, place, 0.0, 0.0, 0.0, 0.0, 0.0)
    wrong = _saying(_silent(), 1, 1, 2, place, place, 0.3, -0.2, 0.0, 0.0, 0.0)
    loss = YoloLoss(box="mse")
    at_best = float(loss([exact], [head], [_target(BOX)])["box"])
    error = float(loss([wrong], [head], [_target(BOX)])["box"]) - at_best
    assert error == pytest.approx(0.5 * (0.09 + 0.04) * (2.0 - 1.0 / 16.0), rel=1e-4)
    # The place is best where decoding gives the box itself.
    for shift in (-0.1, 0.1):
        other = _saying(_silent(), 1, 1, 2, place + shift, place, 0.0, 0.0, 0.0, 0.0, 0.0)
        assert float(loss([other], [head], [_target(BOX)])["box"]) > at_best


@pytest.mark.parametrize(
    ("box", "oracle"), [("giou", generalized_box_iou_loss), ("ciou", complete_box_iou_loss)]
)
def test_overlaps_are_those_of_torchvision(box: str, oracle: object) -> None:
    rng = np.random.default_rng(2)
    head = _head()
    for _ in range(10):
        said = rng.normal(size=4) * 0.8
        output = _saying(_silent(), 1, 1, 2, *said, 0.0, 0.0, 0.0)
        found = decode([output], [head])[0].view(3, 4, 4, 7)[1, 1, 2, :4]
        corners = torch.cat([found[:2] - found[2:] / 2, found[:2] + found[2:] / 2])
        wanted = oracle(corners[None], torch.tensor([BOX]), reduction="sum")  # type: ignore[operator]
        got = YoloLoss(box=box)([output], [head], [_target(BOX)])["box"]
        assert float(got) == pytest.approx(float(wanted), rel=1e-4)


def _found_by(head: Yolo, target: Target) -> set[tuple[int, int, int]]:
    """Anchors that are to find something: those that the objectness pulls up."""
    output = _silent().requires_grad_()
    YoloLoss(box="giou")([output], [head], [target])["objectness"].backward()
    assert output.grad is not None
    pull = split_head(output.grad, head)[0, ..., 4]
    return {tuple(index.tolist()) for index in (pull < 0).nonzero()}


def test_the_anchor_of_the_most_similar_shape_finds_an_object() -> None:
    assert _found_by(_head(), _target(BOX)) == {(1, 1, 2)}
    assert _found_by(_head(), _target((0.0, 0.0, 8.0, 8.0))) == {(0, 0, 0)}
    assert _found_by(_head(), _target((20.0, 50.0, 60.0, 64.0))) == {(2, 3, 2)}


def test_yolov4_takes_every_anchor_that_is_similar_enough() -> None:
    # Against 16 x 16: 8 x 8 has a quarter of the area, 32 x 16 twice.
    assert _found_by(_head(iou_thresh=0.3), _target(BOX)) == {(1, 1, 2), (2, 1, 2)}
    assert _found_by(_head(iou_thresh=0.213), _target(BOX)) == {(0, 1, 2), (1, 1, 2), (2, 1, 2)}


def test_an_anchor_is_found_in_the_head_that_has_it_alone() -> None:
    coarse = _head()
    first = Yolo(0, 2, (0,), coarse.anchors_px, stride=8)
    second = Yolo(0, 2, (1, 2), coarse.anchors_px, stride=16)
    outputs = [torch.zeros(1, 7, 8, 8, requires_grad=True), torch.zeros(1, 14, 4, 4)]
    outputs[1].requires_grad_()
    losses = YoloLoss(box="giou")(outputs, [first, second], [_target(BOX)])
    losses["box"].backward()
    assert outputs[0].grad is None or float(outputs[0].grad.abs().sum()) == 0.0
    assert outputs[1].grad is not None
    assert float(outputs[1].grad[0, :4, 1, 2].abs().sum()) > 0.0


def test_a_box_that_overlaps_an_object_well_is_no_mistake() -> None:
    # The cell to the left says nearly the same box.
    beside = math.log(0.99 / 0.01)
    said = (beside, math.log(0.25 / 0.75), 0.0, 0.0, CERTAIN, 0.0, 0.0)
    output = _saying(_silent(), 1, 1, 1, *said)
    near = (26.0, 12.0, 42.0, 28.0)
    strict = YoloLoss()([output], [_head(ignore_thresh=0.99)], [_target(near)])
    lenient = YoloLoss()([output], [_head(ignore_thresh=0.5)], [_target(near)])
    assert float(strict["objectness"]) - float(lenient["objectness"]) == pytest.approx(12, rel=0.01)


def test_what_was_not_labelled_with_care_is_neither_right_nor_wrong() -> None:
    said = _saying(_silent(), 1, 1, 2, 0.0, 0.0, 0.0, 0.0, CERTAIN, 0.0, 0.0)
    careless = _target((20.0, 4.0, 60.0, 40.0), ignore=True)
    punished = YoloLoss()([said], [_head()], [_target()])
    passed = YoloLoss()([said], [_head()], [careless])
    assert float(punished["objectness"]) == pytest.approx(12.0, rel=0.01)
    assert float(passed["objectness"]) < 0.01
    assert float(passed["box"]) == 0.0


def test_losses_are_of_the_anchors_that_have_an_object_or_of_pictures_if_those_are_more() -> None:
    """With every logit of a class at 0, each of two classes costs log 2 an anchor."""
    three = _target(BOX, (0.0, 0.0, 8.0, 8.0), (20.0, 50.0, 60.0, 64.0))
    one, none = _target(BOX), _target()
    each = 2.0 * math.log(2.0)
    for targets, wanted in [
        ([three], each),
        ([one], each),
        ([one, none], each / 2.0),
        ([three, none], each),
        ([one, none, none, none], each / 4.0),
    ]:
        output = _silent().repeat(len(targets), 1, 1, 1)
        losses = YoloLoss()([output], [_head()], targets)
        assert float(losses["classification"]) == pytest.approx(wanted, rel=1e-5)


def test_label_smoothing_takes_from_yes_and_no_alike() -> None:
    said = _saying(_silent(), 1, 1, 2, 0.0, 0.0, 0.0, 0.0, CERTAIN, 2.0, -1.0)
    losses = YoloLoss(label_smoothing=0.1)([said], [_head()], [_target(BOX, labels=(0,))])

    def entropy(logit: float, wanted: float) -> float:
        p = 1.0 / (1.0 + math.exp(-logit))
        return -(wanted * math.log(p) + (1.0 - wanted) * math.log(1.0 - p))

    wanted = entropy(2.0, 0.95) + entropy(-1.0, 0.05)
    assert float(losses["classification"]) == pytest.approx(wanted, rel=1e-5)


def test_the_order_of_the_output_in_memory_does_not_matter() -> None:
    torch.manual_seed(0)
    output = torch.randn(2, 21, 4, 4)
    targets = [_target(BOX), _target((20.0, 50.0, 60.0, 64.0))]
    wanted = YoloLoss()([output], [_head()], targets)
    turned = output.contiguous(memory_format=torch.channels_last)
    assert turned.stride() != output.stride()
    for name, value in YoloLoss()([turned], [_head()], targets).items():
        assert float(value) == pytest.approx(float(wanted[name]), rel=1e-6)


def test_share_inside_other_boxes() -> None:
    boxes = torch.tensor([[0.0, 0.0, 4.0, 4.0], [10.0, 10.0, 12.0, 12.0], [2.0, 0.0, 4.0, 4.0]])
    others = torch.tensor([[2.0, 0.0, 9.0, 9.0], [0.0, 0.0, 1.0, 4.0]])
    assert inside(boxes, others).tolist() == [0.5, 0.0, 1.0]


def test_boxes_at_the_edge_and_without_area_do_no_harm() -> None:
    output = torch.randn(2, 21, 4, 4, requires_grad=True)
    targets = [_target((60.0, 60.0, 64.0, 64.0), (64.0, 64.0, 64.0, 64.0)), _target()]
    losses = YoloLoss()([output], [_head()], targets)
    total = sum(losses.values())
    assert isinstance(total, Tensor)
    total.backward()
    assert output.grad is not None
    assert bool(torch.isfinite(output.grad).all())


@pytest.mark.parametrize(("name", "cfg"), [("yolov3", "yolov3-tiny"), ("yolov4", "yolov4-tiny")])
def test_training_on_one_picture_finds_what_is_in_it(name: str, cfg: str) -> None:
    torch.manual_seed(1)
    detector = build(name, ["boat", "buoy"], cfg=cfg)
    image = torch.full((1, 3, 96, 128), 0.4) + 0.02 * torch.randn(1, 3, 96, 128)
    image[0, :, 40:60, 30:70] = 0.9
    image[0, 0, 20:32, 90:102] = 1.0
    wanted = torch.tensor([[30.0, 40.0, 70.0, 60.0], [90.0, 20.0, 102.0, 32.0]])
    target = Target(wanted, torch.tensor([0, 1]), torch.tensor([False, False]))
    optimiser = torch.optim.Adam(detector.module.parameters(), lr=1e-3)
    detector.module.train()
    for _ in range(60):
        loss = sum(detector.losses(image, [target]).values())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    # Statistics of a batch of one are those that it was trained with.
    with torch.no_grad():
        (found,) = detector.predict(image, 0.3)
    order = found.labels.argsort()
    assert found.labels[order].tolist() == [0, 1]
    assert float((found.boxes_xyxy_px[order] - wanted).abs().max()) < 4.0


def test_what_cannot_be_trained_is_said() -> None:
    with pytest.raises(InputError, match="unknown box loss 'l1'; known are mse, giou, ciou"):
        build("yolov4", ["boat"], cfg="yolov4-tiny", box_loss="l1")
    with pytest.raises(InputError, match="label smoothing must be"):
        build("yolov4", ["boat"], cfg="yolov4-tiny", label_smoothing=1.0)
    with pytest.raises(InputError, match="needs the name of a class"):
        build("yolov4", [])


def test_networks_with_new_coordinates_are_not_trained(tmp_path: object) -> None:
    text = (
        "[net]\nwidth=8\nheight=8\n[convolutional]\nfilters=6\nsize=1\nstride=8\n"
        "activation=logistic\n[yolo]\nanchors=10,20\nclasses=1\nscale_x_y=2\nnew_coords=1\n"
    )
    path = f"{tmp_path}/new.cfg"
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)
    detector = build("yolov4", ["boat"], cfg=path)
    assert isinstance(detector.module, DarknetModule)
    with pytest.raises(InputError, match="new_coords=1"):
        detector.losses(torch.zeros(1, 3, 8, 8), [_target()])
