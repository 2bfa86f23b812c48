"""YOLOX-nano: its published weights, its losses, and what it learns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sightline.detection import OnnxDetector, _onnxruntime
from sightline.detection.classes import COCO
from sightline.errors import InputError
from sightline.training import yolox
from sightline.training.architecture import Target, build
from sightline.training.export import export_onnx
from sightline.types import Frame

CLASSES = ("boat", "sailboat")
WIDTH = 0.125


def random_network(classes: int, width: float = WIDTH) -> yolox.YoloxNetwork:
    """A network whose biases are not zero, so that none can be mistaken for another."""
    torch.manual_seed(3)
    network = yolox.YoloxNetwork(classes, width)
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name.endswith("bias"):
                value.uniform_(-0.5, 0.5)
    network.eval()
    return network


class Published(torch.nn.Module):  # type: ignore[misc]
    """The outputs that published files have: raw boxes, then scores."""

    def __init__(self, network: yolox.YoloxNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Any) -> Any:
        boxes, something, kinds, cells = self.network(images)
        stride = cells[:, 2:]
        middle = (0.5 * (boxes[..., :2] + boxes[..., 2:]) - cells[:, :2]) / stride
        size = ((boxes[..., 2:] - boxes[..., :2]) / stride).log()
        return torch.cat([middle, size, something.sigmoid()[..., None], kinds.sigmoid()], dim=-1)


def published_file(path: Path, network: yolox.YoloxNetwork) -> Path:
    torch.onnx.export(
        Published(network),
        (torch.zeros(1, 3, 64, 96),),
        str(path),
        input_names=["images"],
        output_names=["output"],
        dynamo=False,
    )
    return path


def decoded(raw: np.ndarray[Any, Any], cells: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Corners of boxes, as the authors write them down: offsets in strides, logarithms of sides."""
    middle = raw[:, :2] * cells[:, 2:] + cells[:, :2]
    size = np.exp(raw[:, 2:4]) * cells[:, 2:]
    return np.concatenate([middle - size / 2, middle + size / 2], axis=1)


def check_same_as_runtime(path: Path, own: yolox.YoloxNetwork, width: int, height: int) -> None:
    """What the network finds is what ONNX Runtime finds with the file, on the same noise."""
    rng = np.random.default_rng(0)
    picture = rng.uniform(0.0, 255.0, (1, 3, height, width)).astype(np.float32)
    session = _onnxruntime.load().InferenceSession(str(path), providers=["CPUExecutionProvider"])
    raw = session.run(None, {"images": picture})[0][0]
    with torch.no_grad():
        boxes, something, kinds, cells = own.eval()(torch.from_numpy(picture))
    wanted = decoded(raw, cells.numpy())
    size = np.maximum(wanted[:, 2:] - wanted[:, :2], 1.0).max()
    assert np.abs(boxes[0].numpy() - wanted).max() < 1e-4 * size
    assert np.abs(something[0].sigmoid().numpy() - raw[:, 4]).max() < 1e-4
    assert np.abs(kinds[0].sigmoid().numpy() - raw[:, 5:]).max() < 1e-4


def test_weights_of_a_published_file_give_its_outputs(tmp_path: Path) -> None:
    path = published_file(tmp_path / "published.onnx", random_network(len(COCO)))
    own = yolox.YoloxNetwork(len(COCO), WIDTH)
    yolox.load_onnx_weights(own, path, COCO)
    check_same_as_runtime(path, own, 96, 64)


def test_the_published_weights_give_their_outputs(data_dir: Path) -> None:
    path = data_dir / "weights" / "yolox_nano.onnx"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    own = yolox.YoloxNetwork(len(COCO))
    yolox.load_onnx_weights(own, path, COCO)
    check_same_as_runtime(path, own, 416, 416)


def test_classes_begin_with_the_row_of_cocos_boat(tmp_path: Path) -> None:
    given = random_network(len(COCO))
    path = published_file(tmp_path / "published.onnx", given)
    own = build("yolox-nano", (*CLASSES, "gull"), weights=str(path), width=WIDTH).module
    boat = COCO.index("boat")
    for mine, theirs in zip(own.heads, given.heads, strict=True):
        for row in (0, 1):
            assert torch.equal(mine.kind_output.weight[row], theirs.kind_output.weight[boat])
            assert torch.equal(mine.kind_output.bias[row], theirs.kind_output.bias[boat])
        assert not torch.equal(mine.kind_output.weight[2], theirs.kind_output.weight[boat])


@pytest.mark.parametrize(
    ("content", "what"),
    [(None, "is not there"), (b"no network", "no whole ONNX file"), ("other", "another network")],
)
def test_a_file_of_something_else_is_refused(
    tmp_path: Path, content: bytes | str | None, what: str
) -> None:
    path = tmp_path / "weights.onnx"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        published_file(path, random_network(len(COCO), width=0.25))
    with pytest.raises(InputError, match=what) as caught:
        build("yolox-nano", CLASSES, weights=str(path), width=WIDTH)
    assert "\n" not in str(caught.value)


def test_a_width_of_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="not positive"):
        build("yolox-nano", CLASSES, width=0.0)


def test_a_frozen_backbone_stays_as_it_is() -> None:
    trainable = build("yolox-nano", CLASSES, width=WIDTH, frozen=True)
    before = {name: value.clone() for name, value in trainable.module.state_dict().items()}
    learned = [one for one in trainable.module.parameters() if one.requires_grad]
    optimizer = torch.optim.SGD(learned, lr=0.1)
    losses = trainable.losses(torch.rand(1, 3, 64, 64), [target((8.0, 8.0, 40.0, 30.0))])
    sum(losses.values()).backward()
    optimizer.step()
    changed = {
        name.split(".")[0]
        for name, value in trainable.module.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert "heads" in changed
    assert not changed & {"stem", "stage4", "stage8", "stage16", "stage32"}


def target(*boxes: tuple[float, ...], ignore: bool = False) -> Target:
    count = len(boxes)
    return Target(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        torch.zeros(count, dtype=torch.int64),
        torch.full((count,), ignore),
    )


def test_losses_are_finite_without_any_box() -> None:
    trainable = build("yolox-nano", CLASSES, width=WIDTH)
    losses = trainable.losses(torch.rand(2, 3, 64, 64), [target(), target()])
    assert set(losses) == {"box", "something", "class"}
    assert all(torch.isfinite(value) for value in losses.values())
    assert losses["box"] == losses["class"] == 0.0


def test_nothing_is_taught_where_nothing_is_said() -> None:
    trainable = build("yolox-nano", CLASSES, width=WIDTH)
    images = torch.rand(1, 3, 64, 64)
    whole = (0.0, 0.0, 64.0, 64.0)
    open_everywhere = trainable.losses(images, [target(whole, ignore=True)])
    assert sum(open_everywhere.values()) == 0.0


def test_each_box_gets_cells_of_its_own_near_its_middle() -> None:
    network = random_network(2)
    with torch.no_grad():
        boxes, something, kinds, cells = network(torch.rand(1, 3, 96, 96) * 255.0)
    wanted = target((8.0, 8.0, 24.0, 20.0), (18.0, 10.0, 34.0, 22.0), (60.0, 50.0, 90.0, 80.0))
    cell, box, _ = yolox.assign(boxes[0], something[0], kinds[0], cells, wanted)
    assert len(cell) == len(set(cell.tolist()))
    assert set(box.tolist()) == {0, 1, 2}
    middle = cells[cell, :2] + 0.5 * cells[cell, 2:]
    own = wanted.boxes_xyxy_px[box]
    reach = torch.maximum(2.5 * cells[cell, 2:], 0.5 * (own[:, 2:] - own[:, :2]))
    assert ((middle - 0.5 * (own[:, :2] + own[:, 2:])).abs() <= reach).all()


@pytest.mark.slow
def test_it_learns_a_white_box_and_the_file_finds_it(tmp_path: Path) -> None:
    torch.manual_seed(0)
    trainable = build("yolox-nano", CLASSES, width=WIDTH)
    rng = np.random.default_rng(1)

    def sample() -> tuple[Any, Target]:
        x, y = rng.integers(4, 60, 2)
        image = torch.full((3, 96, 96), 0.35) + 0.02 * torch.randn(3, 96, 96)
        image[:, y : y + 16, x : x + 24] = 0.95
        return image, target((float(x), float(y), x + 24.0, y + 16.0))

    optimizer = torch.optim.AdamW(trainable.module.parameters(), lr=2e-3)
    for _ in range(150):
        images, targets = zip(*(sample() for _ in range(4)), strict=True)
        loss = sum(trainable.losses(torch.stack(images), targets).values())
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trainable.module.parameters(), 10.0)
        optimizer.step()
    path = tmp_path / "own.onnx"
    assert export_onnx(trainable, path, size_px=(96, 96)) < 1e-4
    image, wanted = sample()
    pixels = (image.clamp(0.0, 1.0) * 255.0).byte().permute(1, 2, 0).numpy()
    found = OnnxDetector(path).detect(Frame(0, 0.0, np.ascontiguousarray(pixels[..., ::-1])))
    assert len(found)
    truth = wanted.boxes_xyxy_px[0].numpy()
    assert np.abs(found.xyxy_px[np.argmax(found.confidence)] - truth).max() < 4.0
