"""Nothing connects anywhere that nobody has named, nor leaves anything in a home."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sightline.types import Frame
from sightline.video import write_video

OFFLINE = Path(__file__).parents[1] / "offline.py"
WAIT_S = 12.0
"""ONNX Runtime 1.32 looks its maker up some 9 s after it was loaded."""


def offline(code: str, home: Path) -> subprocess.CompletedProcess[str]:
    """Code in a process of its own that dies where it asks for the network."""
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("ORT", "XDG"))
    }
    done = subprocess.run(
        [sys.executable, str(OFFLINE), code],
        # Who has switched this on for other programs has asked for nothing here.
        env={**kept, "HOME": str(home), "PROJ_NETWORK": "ON"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if done.returncode == 75:
        pytest.skip("this kernel does not let a process forbid itself the network (seccomp)")
    return done


pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or os.uname().machine not in ("x86_64", "aarch64"),
    reason="only on Linux a process can forbid itself the network (seccomp)",
)


@pytest.mark.parametrize(
    "code",
    [
        "socket.create_connection(('127.0.0.1', 9))",
        "socket.create_connection(('::1', 9))",
        "socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'.', ('127.0.0.1', 9))",
        "socket.getaddrinfo('sightline.invalid', 443)",
        "threading.Thread(target=socket.create_connection, args=[('127.0.0.1', 9)]).start()",
        "ctypes.CDLL(None).socket(2, 1, 0)",
    ],
    ids=["IPv4", "IPv6", "UDP", "name", "thread", "C"],
)
def test_who_asks_for_the_network_is_found_out(code: str, tmp_path: Path) -> None:
    done = offline(f"import ctypes, socket, threading; {code}", tmp_path)
    assert done.returncode == -signal.SIGSYS


def test_other_programs_are_not_started_and_files_are_seen(tmp_path: Path) -> None:
    code = "import os, subprocess\nsubprocess.run(['true'])"
    assert "PermissionError" in offline(code, tmp_path).stderr
    code = "import pathlib; (pathlib.Path.home() / 'here').touch()"
    assert offline(code, tmp_path).returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


def test_a_detector_in_python_leaves_nothing_in_a_home(tmp_path: Path) -> None:
    """Its library would leave an identifier there as soon as it is loaded."""
    code = "from sightline.detection import detector_by_name; detector_by_name('harbour')"
    done = offline(code, tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert list(tmp_path.iterdir()) == []


def a_minute() -> Iterator[Frame]:
    """Two small pictures a second of a boat on a grey sea."""
    sea = np.random.default_rng(0).integers(150, 160, (192, 320, 3), dtype=np.uint8)
    for index in range(121):
        image = sea.copy()
        image[120:126, index : index + 18] = 20
        yield Frame(index, 1_700_000_000.0 + 0.5 * index, image)


def test_no_command_connects_anywhere(made_harbour: Path, tmp_path: Path) -> None:
    """A minute of video is searched, a scene learned, tracked and reported; and then it waits."""
    write_video(tmp_path / "minute.mp4", a_minute())
    (tmp_path / "home").mkdir()
    boxes, scene = tmp_path / "boxes.csv", made_harbour / "scene.toml"
    lines = [
        ["detect", str(tmp_path / "minute.mp4"), "-o", str(boxes)],
        ["run", str(scene), "--model", "camera", "-o", str(tmp_path / "results")],
    ]
    code = f"""
import time
from sightline.cli import main
ended = []
for line in {lines!r}:
    try:
        main(line)
    except SystemExit as stopped:
        assert stopped.code == 0
        ended.append(time.monotonic())
time.sleep(max(0.0, ended[0] + {WAIT_S} - time.monotonic()))
"""
    done = offline(code, tmp_path / "home")
    assert done.returncode == 0, (done.returncode, done.stderr)
    assert "boxes in 121 frames" in done.stdout
    assert (tmp_path / "results" / "report.html").exists()
    left = [path for path in (tmp_path / "home").rglob("*") if path.is_file()]
    # Matplotlib keeps a list of the fonts that there are.
    assert [path for path in left if path.parent.name != "matplotlib"] == []
