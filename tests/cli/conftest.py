from __future__ import annotations

import shutil
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from sightline import Scene, fit
from sightline.cli import main
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.types import Frame
from sightline.video import write_video

SIZE_PX = (640, 360)
START_UTC_S = 1_700_000_000.0


@dataclass(frozen=True)
class Outcome:
    """What somebody at the shell sees of a command."""

    status: int
    out: str
    err: str


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """No command asks anything of the network."""

    def refuse(*_: object) -> None:
        raise AssertionError("something asked for the network")

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.fixture
def sightline(capfd: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """The command line, called in this process; what it raises apart from its exit gets out."""

    def call(*arguments: object) -> Outcome:
        capfd.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert isinstance(stopped.value.code, int)
        return Outcome(stopped.value.code, out, err)

    return call


@pytest.fixture(scope="session")
def made_harbour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A harbour that others only copy: boxes, clocks, a log, a scene, models, a small video."""
    folder = tmp_path_factory.mktemp("made") / "harbour"
    made = simulate(
        folder,
        SimulationSettings(
            video=False, recordings=3, duration_s=20.0, seed=1, image_size_px=SIZE_PX
        ),
    )
    for name in ("camera", "qkr"):
        fit(Scene.load(made.scene), name).save(folder / f"{name}.safetensors")
    write_video(folder / "boat.mp4", frames())
    (folder / "frames").mkdir()
    for frame in frames():
        cv2.imwrite(str(folder / "frames" / f"{frame.index:03d}.png"), frame.image_bgr)
    times = "".join(f"{frame.index},{frame.time_utc_s}\n" for frame in frames())
    (folder / "frames.csv").write_text("frame,utc\n" + times)
    return folder


def frames() -> Iterator[Frame]:
    """A dark boat, somebody in it, that crosses a grey sea from left to right in four seconds."""
    width, height = SIZE_PX
    sea = np.random.default_rng(0).integers(150, 160, (height, width, 3), dtype=np.uint8)
    for index in range(40):
        image = sea.copy()
        left = 100 + 8 * index
        image[235:255, left : left + 50] = 20
        image[225:235, left + 20 : left + 32] = 20
        yield Frame(index, START_UTC_S + 0.1 * index, image)


@pytest.fixture
def harbour(made_harbour: Path, tmp_path: Path) -> Path:
    """A copy of the harbour, to be spoilt and written to."""
    folder = tmp_path / "harbour"
    shutil.copytree(made_harbour, folder, ignore=shutil.ignore_patterns("truth*"))
    return folder
