"""The grammar of `.cfg` and the files of weights; nothing here needs torch."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.training.darknet.cfg import (
    PUBLISHED,
    Network,
    format_cfg,
    parse,
    published,
    read_cfg,
)
from sightline.training.darknet.weights import (
    Header,
    LayerWeights,
    Weights,
    read_pretrained,
    read_weights,
    write_weights,
)

NET = "[net]\nwidth=64\nheight=32\nchannels=3\n"
CONVOLUTION = "[convolutional]\nbatch_normalize=1\nfilters=8\nsize=3\nstride=2\npad=1\n"
HEAD = "[convolutional]\nfilters=14\nsize=1\nactivation=linear\n"
YOLO = "[yolo]\nmask=0,2\nanchors=4,5, 8,9, 16,17\nclasses=2\nnum=3\n"
SMALL = NET + CONVOLUTION + "activation=leaky\n" + HEAD + YOLO


def _random(network: Network, seed: int = 0) -> Weights:
    rng = np.random.default_rng(seed)
    layers = {}
    for index, layer in network.convolutions:
        vectors = [rng.normal(size=layer.filters).astype(np.float32) for _ in range(4)]
        kernels = rng.normal(size=layer.weights_shape).astype(np.float32)
        if layer.batch_normalize:
            layers[index] = LayerWeights(*vectors[:3], np.abs(vectors[3]), kernels)
        else:
            layers[index] = LayerWeights(vectors[0], None, None, None, kernels)
    return Weights(Header(seen=12345), layers)


@pytest.mark.parametrize(
    ("name", "file_bytes", "strides"),
    [
        # Sizes of the files that their authors published for COCO.
        ("yolov3", 248_007_048, [32, 16, 8]),
        ("yolov3-tiny", 35_434_956, [32, 16]),
        ("yolov4", 257_717_640, [8, 16, 32]),
        ("yolov4-tiny", 24_251_276, [32, 16]),
    ],
)
def test_published_networks_have_as_many_numbers_as_their_published_weights(
    name: str, file_bytes: int, strides: list[int]
) -> None:
    network = published(name)
    assert Header().size + 4 * network.count == file_bytes
    assert [head.stride for head in network.heads] == strides
    assert network.stride == 32
    assert network.classes == 80


def test_other_classes_change_the_heads_and_nothing_else() -> None:
    network = published("yolov4")
    one = network.with_classes(1)
    # A head's convolution has 3 (5 + C) filters of as many inputs as the layer before has channels.
    inputs = [256, 512, 1024]
    assert network.count - one.count == sum(3 * 79 * (channels + 1) for channels in inputs)
    assert [one.layers[index].filters for index in sorted(one.head_convolutions)] == [18, 18, 18]
    assert one.with_classes(80) == network


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_network_survives_being_written_and_read(name: str) -> None:
    network = published(name).with_classes(3)
    again = parse(format_cfg(network), source="again")
    assert [replace(layer, line=0) for layer in again.layers] == [
        replace(layer, line=0) for layer in network.layers
    ]
    assert again.channels == network.channels
    assert again.size_px == network.size_px


def test_the_real_network_is_understood(data_dir: Path) -> None:
    folder = data_dir / "weights"
    network = read_cfg(folder / "yolo-fastest-1.1-xl.cfg")
    assert 20 + 4 * network.count == (folder / "yolo-fastest-1.1-xl.weights").stat().st_size
    assert [head.stride for head in network.heads] == [32, 16]
    assert network.heads[0].anchors_px[network.heads[0].mask[0]] == (115.0, 73.0)
    assert any(layer.groups > 1 for _, layer in network.convolutions)


def test_comments_blanks_and_the_short_names_of_sections_are_understood() -> None:
    text = SMALL.replace("[net]", "# a comment\n\n[network]").replace("[convolutional]", "[conv]")
    text = text.replace("filters=8", " filters = 8  ; eight")
    network = parse(text, source="small.cfg")
    assert network.channels == (8, 14, 14)
    assert network.layers[0] == replace(
        parse(SMALL, source="small.cfg").layers[0], line=network.layers[0].line
    )


WITH_ROUTE = NET + CONVOLUTION + "activation=mish\n" + CONVOLUTION + "activation=mish\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"begin with \[net\]"),
        ("[convolutional]\nfilters=3\n", r"begin with \[net\]"),
        ("width=3\n", r"line 1: width stands before any \[section\]"),
        ("[net\nwidth=3\n", r"line 1: \[net lacks its closing bracket"),
        ("[net]\nwidth\n", r"line 2: 'width' is neither"),
        ("[net]\nwidth=64\n", r"line 1, \[net\]: has no height"),
        ("[net]\nwidth=x\nheight=3\n", r"\[net\]: width=x is no whole number"),
        ("[net]\nwidth=64\nheight=0\n", r"height=0 must lie between 1 and"),
        (NET, r"has no \[yolo\]"),
        (
            SMALL + "[lstm]\nbatch_normalize=1\n",
            (
                r"line 21: unknown section \[lstm\]; known are \[net\], \[convolutional\], "
                r"\[shortcut\], \[route\], \[upsample\], \[maxpool\], \[dropout\], \[yolo\]"
            ),
        ),
        (SMALL.replace("leaky", "snake"), r"line 5, \[convolutional\]: unknown activation 'snake'"),
        (SMALL.replace("filters=14", "filters=15"), r"2 anchors and 2 classes need 14 filters"),
        (SMALL.replace("mask=0,2", "mask=0,3"), r"mask names anchors beyond the 3"),
        (SMALL.replace("4,5, ", "4, "), r"anchors must be pairs"),
        (SMALL.replace("4,5, ", "0,5, "), r"wider and higher than 0"),
        (SMALL.replace("classes=2", "classes=two"), r"classes=two is no whole number"),
        (SMALL.replace("width=64", "width=65"), r"multiples of the largest stride"),
        (SMALL + HEAD + YOLO.replace("classes=2", "classes=3"), r"need 16 filters"),
        (
            SMALL + HEAD.replace("14", "16") + YOLO.replace("classes=2", "classes=3"),
            r"line 25, \[yolo\]: has 3 classes, but the one in line 16 has 2",
        ),
        (SMALL.replace("stride=2", "stride=2\ngroups=2"), r"3 channels .* into 2 groups"),
        (SMALL.replace("stride=2", "stride_x=2\nstride_y=1"), r"stride_x and stride_y differ"),
        (SMALL.replace("stride=2", "stride=2\nantialiasing=1"), r"antialiasing=1 is not supported"),
        (NET + "[yolo]\nanchors=3,4\n", r"must stand behind a \[convolutional\]"),
        (WITH_ROUTE + "[route]\n", r"\[route\]: has no layers"),
        (WITH_ROUTE + "[route]\nlayers=-3\n", r"layers=-3 leads to no layer before it; .* layer 2"),
        (WITH_ROUTE + "[route]\nlayers=2\n", r"layers=2 leads to no layer"),
        (WITH_ROUTE + "[route]\nlayers=0,1\n", r"layer 1 gives 16 x 8, and layer 0 32 x 16"),
        (WITH_ROUTE + "[shortcut]\nfrom=0\n", r"layer 0 gives 32 x 16, .* cannot be added"),
        (
            WITH_ROUTE + "[shortcut]\nfrom=0\nweights_type=per_feature\n",
            r"weights_type=per_feature",
        ),
        (WITH_ROUTE + "[route]\nlayers=-1\ngroups=3\n", r"8 channels of layer 1 .* 3 groups"),
        (WITH_ROUTE + "[route]\nlayers=-1\ngroups=2\ngroup_id=2\n", r"less than groups=2"),
        (WITH_ROUTE + "[maxpool]\nsize=40\npadding=0\n", r"nothing is left of a picture"),
        (WITH_ROUTE + "[maxpool]\nsize=2\npadding=6\n", r"without a pixel"),
        (WITH_ROUTE + "[dropout]\nprobability=1\n", r"must be less than 1"),
        (WITH_ROUTE + "[dropout]\nprobability=much\n", r"probability=much is no number"),
    ],
)
def test_what_is_wrong_in_a_cfg_is_said_with_its_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as raised:
        parse(text, source="bad.cfg")
    assert "bad.cfg" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_cfg_that_is_no_text_or_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"missing\.cfg: cannot be read"):
        read_cfg(tmp_path / "missing.cfg")
    (tmp_path / "binary.cfg").write_bytes(b"\0\1\2")
    with pytest.raises(InputError, match=r"is no Darknet \.cfg"):
        read_cfg(tmp_path / "binary.cfg")
    with pytest.raises(InputError, match="known are yolov3, yolov3-tiny, yolov4, yolov4-tiny"):
        published("yolov9")


def test_weights_lie_in_a_file_in_darknets_order(tmp_path: Path) -> None:
    network = parse(SMALL, source="small.cfg")
    first, second = 8 * (4 + 27), 14 * (1 + 8)
    numbers = np.arange(first + second, dtype="<f4")
    header = struct.pack("<iiiq", 0, 2, 5, 2**33)
    (tmp_path / "small.weights").write_bytes(header + numbers.tobytes())
    weights = read_weights(tmp_path / "small.weights", network)
    assert weights.header == Header(0, 2, 5, 2**33)
    layer = weights.layers[0]
    assert layer.biases.tolist() == list(range(8))
    assert layer.scales is not None
    assert layer.means is not None
    assert layer.variances is not None
    assert (layer.scales[0], layer.means[0], layer.variances[0]) == (8, 16, 24)
    # Of a kernel the column changes fastest, then the row, the channel, the filter.
    assert layer.kernels.shape == (8, 3, 3, 3)
    assert layer.kernels[1, 0, 0, 0] == 32 + 27
    assert layer.kernels[0, 1, 0, 0] == 32 + 9
    assert layer.kernels[0, 0, 1, 0] == 32 + 3
    last = weights.layers[1]
    assert last.scales is None
    assert last.biases[0] == first
    assert last.kernels[0, 0, 0, 0] == first + 14


def test_old_files_count_pictures_in_four_bytes(tmp_path: Path) -> None:
    network = parse(SMALL, source="small.cfg")
    content = struct.pack("<iiii", 0, 1, 0, 77) + np.ones(network.count, "<f4").tobytes()
    (tmp_path / "old.weights").write_bytes(content)
    weights = read_weights(tmp_path / "old.weights", network)
    assert weights.header == Header(0, 1, 0, 77)
    write_weights(tmp_path / "again.weights", weights, network)
    assert (tmp_path / "again.weights").read_bytes() == content


def test_written_weights_are_read_back_bit_by_bit(tmp_path: Path) -> None:
    network = published("yolov4-tiny").with_classes(1)
    weights = _random(network)
    path = write_weights(tmp_path / "a.weights", weights, network)
    again = read_weights(path, network)
    assert again.header == weights.header
    for index, layer in weights.layers.items():
        for wanted, got in zip(layer.arrays, again.layers[index].arrays, strict=True):
            assert wanted.tobytes() == got.tobytes()


def test_the_real_weights_are_written_as_they_were_read(data_dir: Path, tmp_path: Path) -> None:
    source = data_dir / "weights" / "yolo-fastest-1.1-xl"
    network = read_cfg(source.with_name(source.name + ".cfg"))
    original = source.with_name(source.name + ".weights")
    write_weights(tmp_path / "copy.weights", read_weights(original, network), network)
    assert (tmp_path / "copy.weights").read_bytes() == original.read_bytes()


def test_weights_that_do_not_fit_are_told_with_both_counts(tmp_path: Path) -> None:
    network = parse(SMALL, source="small.cfg")
    path = tmp_path / "w.weights"
    three = write_weights(path, _random(network.with_classes(3)))
    said = rf"does not fit small\.cfg: expected {network.count} numbers, found \d+; .* classes=3 in"
    with pytest.raises(InputError, match=said):
        read_weights(three, network)
    content = path.read_bytes()
    path.write_bytes(content[:-4])
    with pytest.raises(InputError, match=rf"expected {network.count} numbers, found \d+$"):
        read_weights(path, network)
    path.write_bytes(content[:-3])
    with pytest.raises(InputError, match=r"is cut off"):
        read_weights(path, network)
    path.write_bytes(b"\0" * 10)
    with pytest.raises(InputError, match="ends within its header"):
        read_weights(path, network)
    path.write_bytes(b"\xff" * 200)
    with pytest.raises(InputError, match=r"its header says version -1\.-1"):
        read_weights(path, network)
    with pytest.raises(InputError, match="cannot be read"):
        read_weights(tmp_path / "missing.weights", network)
    damaged = struct.pack("<iiiq", 0, 2, 5, 0) + np.full(network.count, np.nan, "<f4").tobytes()
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"is damaged; layer 0 of small\.cfg"):
        read_weights(path, network)
    with pytest.raises(InputError, match="are not those of"):
        write_weights(tmp_path / "no.weights", _random(network.with_classes(3)), network)
    assert not (tmp_path / "no.weights").exists()


def test_pretrained_weights_for_other_classes_leave_the_heads_out(tmp_path: Path) -> None:
    network = parse(SMALL, source="small.cfg")
    path = write_weights(tmp_path / "coco.weights", _random(network.with_classes(80)))
    assert set(read_pretrained(path, network).layers) == {0}
    path = write_weights(tmp_path / "same.weights", _random(network))
    assert set(read_pretrained(path, network).layers) == {0, 1}


def test_weights_of_the_first_layers_are_told_by_their_name(tmp_path: Path) -> None:
    network = published("yolov4-tiny").with_classes(1)
    weights = _random(network)
    first = Weights(weights.header, {i: w for i, w in weights.layers.items() if i < 15})
    path = write_weights(tmp_path / "yolov4-tiny.conv.15", first)
    assert set(read_pretrained(path, network).layers) == {0, 1, 2, 4, 5, 7, 10, 12, 13}
    wrong = path.rename(tmp_path / "yolov4-tiny.conv.18")
    with pytest.raises(InputError, match=r"first 18 layers .* expected \d+ numbers, found \d+"):
        read_pretrained(wrong, network)


def test_weights_for_an_unknown_number_of_classes_are_refused(tmp_path: Path) -> None:
    network = parse(SMALL, source="small.cfg")
    numbers = np.ones(network.count + 1, "<f4")
    (tmp_path / "odd.weights").write_bytes(Header().pack() + numbers.tobytes())
    with pytest.raises(InputError, match="unknown number of classes") as raised:
        read_pretrained(tmp_path / "odd.weights", network)
    assert re.search(rf"found {len(numbers)} numbers; expected {network.count}", str(raised.value))
