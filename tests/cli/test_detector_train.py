from __future__ import annotations

import sys
from pathlib import Path

import pytest

from sightline.cli.detector.train import train
from sightline.errors import InputError


def test_without_torch_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match=r'torch is not installed; run: pip install "sightline\['):
        train(tmp_path / "scene.toml", "harbour", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_unknown_architecture_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="known are yolov3, yolov4, efficientdet-d0, faster-rcnn"):
        train(tmp_path / "scene.toml", "yolov9", tmp_path / "out")
