"""Darknet networks in PyTorch, against NumPy, OpenCV's reader and another detector's boxes."""

from __future__ import annotations

import bz2
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import cv2
import torch
from torch import nn
from torchvision.ops import box_iou

from sightline.errors import InputError
from sightline.training.darknet.cfg import Network, parse, published, read_cfg
from sightline.training.darknet.module import DarknetModule, decode
from sightline.training.darknet.weights import Weights, read_weights, write_weights
from sightline.training.darknet_family import build, from_files
from sightline.video import frames

Array = np.ndarray[Any, Any]

EPSILON = 1e-5


def _convolve(x: Array, kernels: Array, stride: int, pad: int, groups: int) -> Array:
    """(C, H, W) by (F, C / groups, k, k), the sum written out."""
    filters, depth, size, _ = kernels.shape
    x = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    rows, columns = ((side - size) // stride + 1 for side in x.shape[1:])
    out = np.zeros((filters, rows, columns))
    for f in range(filters):
        first = f // (filters // groups) * depth
        for r in range(rows):
            for c in range(columns):
                window = x[
                    first : first + depth,
                    r * stride : r * stride + size,
                    c * stride : c * stride + size,
                ]
                out[f, r, c] = (window * kernels[f]).sum()
    return out


def _normalise(x: Array, scale: Array, shift: Array, mean: Array, variance: Array) -> Array:
    column = (slice(None), None, None)
    x = (x - mean[column]) / np.sqrt(variance[column] + EPSILON)
    return x * scale[column] + shift[column]


def _pool(x: Array, size: int, stride: int) -> Array:
    """Darknet's: as many rows as `(H - 1) // stride + 1`, the lesser half of the padding above."""
    _, height, width = x.shape
    offset = (size - 1) // 2
    rows, columns = (height - 1) // stride + 1, (width - 1) // stride + 1
    out = np.full((len(x), rows, columns), -np.inf)
    for r in range(rows):
        for c in range(columns):
            top, left = r * stride - offset, c * stride - offset
            seen = x[:, max(top, 0) : top + size, max(left, 0) : left + size]
            out[:, r, c] = seen.max(axis=(1, 2))
    return out


HEAD = "[convolutional]\nfilters=6\nsize=1\nactivation=linear\n[yolo]\nanchors=4,5\nclasses=1\n"


def _net(sections: str, side: int = 8) -> Network:
    return parse(f"[net]\nwidth={side}\nheight={side}\nchannels=4\n{sections}{HEAD}", source="test")


def _outputs(network: Network, x: Array, seed: int = 3) -> tuple[list[Array], DarknetModule]:
    """What comes out of each layer but the head."""
    torch.manual_seed(seed)
    module = DarknetModule(network).eval()
    for part in module.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.running_mean.normal_()
            part.running_var.uniform_(0.2, 2.0)
            nn.init.normal_(part.weight)
            nn.init.normal_(part.bias)
    seen: list[Array] = []
    last = len(network.layers) - 2
    for layer in module.layers[:last]:
        layer.register_forward_hook(lambda *given: seen.append(given[2][0].detach().numpy()))
    head = module.layers[last]
    head.register_forward_pre_hook(lambda _, given: seen.append(given[0][0].detach().numpy()))
    with torch.no_grad():
        module(torch.from_numpy(x[None].astype(np.float32)))
    return seen, module


PICTURE = np.random.default_rng(0).normal(size=(4, 8, 8))

ACTIVATIONS = {
    "linear": lambda x: x,
    "leaky": lambda x: np.where(x > 0, x, 0.1 * x),
    "relu": lambda x: np.maximum(x, 0),
    "logistic": lambda x: 1 / (1 + np.exp(-x)),
    "mish": lambda x: x * np.tanh(np.log1p(np.exp(x))),
    "swish": lambda x: x / (1 + np.exp(-x)),
}


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(("size", "stride", "groups"), [(3, 1, 1), (3, 2, 2), (5, 1, 4), (1, 1, 1)])
def test_convolutions_are_those_of_numpy(
    activation: str, size: int, stride: int, groups: int
) -> None:
    network = _net(
        f"[convolutional]\nbatch_normalize=1\nfilters=8\nsize={size}\nstride={stride}\npad=1\n"
        f"groups={groups}\nactivation={activation}\n"
    )
    seen, module = _outputs(network, PICTURE)
    learned = module.dump().layers[0]
    assert learned.scales is not None
    assert learned.means is not None
    assert learned.variances is not None
    wanted = _convolve(PICTURE, learned.kernels.astype(float), stride, size // 2, groups)
    wanted = _normalise(wanted, learned.scales, learned.biases, learned.means, learned.variances)
    np.testing.assert_allclose(seen[0], ACTIVATIONS[activation](wanted), atol=2e-5)


@pytest.mark.parametrize(
    ("size", "stride"), [(2, 2), (2, 1), (3, 1), (3, 2), (5, 1), (9, 1), (13, 1)]
)
def test_pools_are_padded_as_darknet_does(size: int, stride: int) -> None:
    seen, _ = _outputs(_net(f"[maxpool]\nsize={size}\nstride={stride}\n"), PICTURE)
    np.testing.assert_allclose(seen[0], _pool(PICTURE, size, stride), atol=1e-6)


COPY = "[convolutional]\nfilters=4\nsize=3\npad=1\nactivation=linear\n"


def test_routes_join_and_split_channels() -> None:
    seen, _ = _outputs(_net(COPY + COPY + "[route]\nlayers=-1,0\n"), PICTURE)
    np.testing.assert_array_equal(seen[2], np.concatenate([seen[1], seen[0]]))
    split = "[route]\nlayers=-1,-2\ngroups=2\ngroup_id=1\n"
    seen, _ = _outputs(_net(COPY + COPY + split), PICTURE)
    np.testing.assert_array_equal(seen[2], np.concatenate([seen[1][2:], seen[0][2:]]))


def test_shortcuts_add_the_channels_that_both_have() -> None:
    seen, _ = _outputs(_net(COPY + COPY + "[shortcut]\nfrom=-2\nactivation=leaky\n"), PICTURE)
    np.testing.assert_allclose(seen[2], ACTIVATIONS["leaky"](seen[1] + seen[0]), atol=1e-6)
    fewer = COPY.replace("filters=4", "filters=3")
    seen, _ = _outputs(_net(fewer + COPY + "[shortcut]\nfrom=0\n"), PICTURE)
    np.testing.assert_allclose(seen[2][:3], seen[1][:3] + seen[0], atol=1e-6)
    np.testing.assert_array_equal(seen[2][3], seen[1][3])
    seen, _ = _outputs(_net(COPY + fewer + "[shortcut]\nfrom=0\n"), PICTURE)
    np.testing.assert_allclose(seen[2], seen[1] + seen[0][:3], atol=1e-6)


def test_upsampling_repeats_pixels() -> None:
    down = "[convolutional]\nfilters=4\nsize=3\nstride=2\npad=1\nactivation=linear\n"
    seen, _ = _outputs(_net(down + "[upsample]\nstride=2\nscale=0.5\n"), PICTURE)
    np.testing.assert_array_equal(seen[1], 0.5 * seen[0].repeat(2, axis=1).repeat(2, axis=2))


@pytest.mark.parametrize("scale", [1.0, 1.2, 2.0])
def test_heads_say_boxes_by_the_formula_of_the_paper(scale: float) -> None:
    network = parse(
        "[net]\nwidth=64\nheight=32\n[convolutional]\nfilters=14\nsize=1\nstride=8\n"
        "activation=linear\n[yolo]\nmask=0,2\nanchors=4,5, 8,9, 16,17\nclasses=2\n"
        f"scale_x_y={scale}\n",
        source="head",
    )
    raw = np.random.default_rng(1).normal(size=(1, 14, 4, 8)).astype(np.float32)
    found = decode([torch.from_numpy(raw)], network.heads)[0].numpy().reshape(2, 4, 8, 7)
    for anchor, (width, height) in enumerate([(4.0, 5.0), (16.0, 17.0)]):
        for row, column in [(0, 0), (3, 7), (2, 5)]:
            tx, ty, tw, th, *certain = raw[0, 7 * anchor : 7 * anchor + 7, row, column]
            sx, sy = (1 / (1 + np.exp(-t)) * scale - 0.5 * (scale - 1) for t in (tx, ty))
            wanted = [8 * (column + sx), 8 * (row + sy), width * np.exp(tw), height * np.exp(th)]
            wanted += [1 / (1 + np.exp(-t)) for t in certain]
            np.testing.assert_allclose(found[anchor, row, column], wanted, rtol=1e-5)


def test_heads_with_new_coordinates_square_the_sides() -> None:
    network = parse(
        "[net]\nwidth=8\nheight=8\n[convolutional]\nfilters=6\nsize=1\nstride=8\n"
        "activation=logistic\n[yolo]\nanchors=10,20\nclasses=1\nscale_x_y=2\nnew_coords=1\n",
        source="head",
    )
    raw = torch.tensor([0.5, 0.75, 0.25, 0.5, 0.9, 0.8]).view(1, 6, 1, 1)
    found = decode([raw], network.heads)[0, 0].tolist()
    assert found == pytest.approx([8 * 0.5, 8 * 1.0, 10 * 0.25, 20 * 1.0, 0.9, 0.8])


def _real(data_dir: Path) -> tuple[Path, Path]:
    folder = data_dir / "weights"
    return folder / "yolo-fastest-1.1-xl.cfg", folder / "yolo-fastest-1.1-xl.weights"


# Rows of OpenCV 4.14's reader of these files, for the picture below: the surest cells of either
# head, x, y, width and height as shares of the input, and the objectness.
OPENCV = {
    (0, 15): (0.46445411, 0.45492506, 0.75383294, 1.07810271, 0.67189533),
    (0, 16): (0.46955001, 0.45725980, 0.78444815, 1.13022757, 0.66696358),
    (0, 18): (0.53117543, 0.49621227, 0.70409393, 1.11166036, 0.57885420),
    (1, 59): (0.46336579, 0.44745955, 0.91393977, 1.07967758, 0.38891041),
    (1, 62): (0.53207165, 0.45596579, 0.89358515, 1.04434526, 0.29115742),
}


def test_real_weights_give_what_opencv_gives(data_dir: Path) -> None:
    cfg, weights = _real(data_dir)
    network = read_cfg(cfg)
    module = DarknetModule(network).eval()
    module.load(read_weights(weights, network))
    for part in module.modules():
        if isinstance(part, nn.BatchNorm2d):
            # OpenCV's; Darknet's own is 1e-5.
            part.eps = 1e-6
    c, i, j = np.meshgrid(np.arange(3), np.arange(96), np.arange(128), indexing="ij")
    picture = 0.5 + 0.5 * np.sin(0.11 * (c + 1) * i + 0.07 * (c + 2) * j)
    with torch.no_grad():
        outputs = module(torch.from_numpy(picture[None].astype(np.float32)))
    shares = np.array([128.0, 96.0, 128.0, 96.0, 1.0])
    for (number, row), wanted in OPENCV.items():
        head = network.heads[number]
        found = decode([outputs[number]], [head])[0, :, :5].numpy() / shares
        # OpenCV goes through the cells first, and through the anchors of each.
        found = found.reshape(len(head.mask), -1, 5).transpose(1, 0, 2).reshape(-1, 5)
        np.testing.assert_allclose(found[row], wanted, atol=5e-6)


def test_real_weights_find_the_cars_that_another_detector_found(data_dir: Path) -> None:
    """OTVision's own detections (YOLOv5s) of the same clip are the truth."""
    content = json.loads(bz2.decompress((data_dir / "otvision" / "Cars-Truck.otdet").read_bytes()))
    # Both were trained on the 80 classes of COCO.
    numbered = content["metadata"]["detection"]["model"]["classes"]
    names = [numbered[str(number)] for number in range(80)]
    detector = from_files(*_real(data_dir), names)
    vehicles = ("car", "truck", "bus")
    found = 0
    for frame in frames(data_dir / "otvision" / "Cars-Truck.mp4", start_utc_s=0.0):
        if frame.index % 20:
            continue
        canvas = np.zeros((608, 800, 3), np.uint8)
        canvas[:600] = cv2.cvtColor(frame.image_bgr, cv2.COLOR_BGR2RGB)
        picture = torch.from_numpy(canvas.transpose(2, 0, 1)[None].astype(np.float32) / 255.0)
        with torch.no_grad():
            (ours,) = detector.predict(picture, 0.3)
        wanted = torch.tensor(
            [
                (d["x"] - d["w"] / 2, d["y"] - d["h"] / 2, d["x"] + d["w"] / 2, d["y"] + d["h"] / 2)
                for d in content["data"][str(frame.index + 1)]["detections"]
                if d["confidence"] > 0.6 and d["class"] in vehicles
            ]
        )
        kept = torch.tensor([names[label] in vehicles for label in ours.labels])
        overlap = box_iou(wanted, ours.boxes_xyxy_px[kept]).amax(dim=1)
        assert overlap.min() > 0.5
        found += len(wanted)
    assert found >= 10


def test_weights_go_through_the_module_bit_by_bit(data_dir: Path, tmp_path: Path) -> None:
    cfg, weights = _real(data_dir)
    network = read_cfg(cfg)
    read = read_weights(weights, network)
    module = DarknetModule(network)
    module.load(read)
    write_weights(tmp_path / "again.weights", module.dump(seen=read.header.seen), network)
    assert (tmp_path / "again.weights").read_bytes() == weights.read_bytes()


def test_the_networks_of_the_papers_have_the_parameters_that_are_known() -> None:
    for name, millions in [("yolov3", 61.9), ("yolov4", 64.4)]:
        module = DarknetModule(published(name))
        count = sum(parameter.numel() for parameter in module.parameters())
        assert round(count / 1e6, 1) == millions


def test_pretrained_weights_are_taken_over_but_for_the_heads(tmp_path: Path) -> None:
    torch.manual_seed(0)
    coco = DarknetModule(published("yolov4-tiny"))
    path = write_weights(tmp_path / "coco.weights", coco.dump())
    detector = build("yolov4", ["boat"], cfg="yolov4-tiny", weights=str(path))
    wanted, got = coco.dump().layers, detector.darknet.dump().layers
    for index in wanted:
        same = wanted[index].kernels.shape == got[index].kernels.shape
        assert same == (index not in detector.network.head_convolutions)
        if same:
            np.testing.assert_array_equal(wanted[index].kernels, got[index].kernels)


def test_names_that_are_not_as_many_as_classes_are_refused(data_dir: Path) -> None:
    with pytest.raises(InputError, match="tells 80 classes apart, and 1 names were given"):
        from_files(*_real(data_dir), ["boat"])


def test_a_new_network_finds_nothing() -> None:
    torch.manual_seed(0)
    detector = build("yolov3", ["boat"], cfg="yolov3-tiny")
    detector.module.eval()
    with torch.no_grad():
        (found,) = detector.predict(torch.rand(1, 3, 64, 64), 0.3)
    assert len(found.scores) == 0


def test_header_counts_the_pictures_that_were_seen() -> None:
    weights = DarknetModule(_net("[maxpool]\nsize=2\n")).dump(seen=640)
    assert isinstance(weights, Weights)
    assert weights.header.seen == 640
