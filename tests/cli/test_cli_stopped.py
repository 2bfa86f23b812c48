"""Commands that are ended from outside: nothing is half, and what there is to keep is kept."""

from __future__ import annotations

import io
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import av
import numpy as np
import pytest
from interruptions import start

from sightline.formats import read_boxes, read_tracks, write_tracks
from sightline.types import Frame
from sightline.video import write_video

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name == "nt", reason="needs the signals of Unix"),
]

AT_MOST_S = 300.0
START_UTC_S = 1_700_000_000.0
STREAM = "tcp://127.0.0.1:{port}"


FRAMES = 120


def film() -> Iterator[Frame]:
    """A dark boat that crosses a grey sea in twelve seconds."""
    sea = np.random.default_rng(0).integers(150, 160, (360, 640, 3), dtype=np.uint8)
    for index in range(FRAMES):
        image = sea.copy()
        left = 60 + 4 * index
        image[235:255, left : left + 50] = 20
        image[225:235, left + 20 : left + 32] = 20
        yield Frame(index, START_UTC_S + 0.1 * index, image)


@pytest.fixture(scope="session")
def made_stream(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    write_video(path, film())
    out = io.BytesIO()
    with av.open(str(path)) as source, av.open(out, "w", format="mpegts") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    return out.getvalue()


@pytest.fixture
def transport_stream(made_stream: bytes, harbour: Path) -> bytes:
    """A film as a camera sends it; the clock in the harbour tells its times, however it comes."""
    rows = "".join(f"{i},{START_UTC_S + 0.1 * i}\n" for i in range(FRAMES))
    (harbour / "film.csv").write_text("frame,utc\n" + rows)
    return made_stream


@contextmanager
def camera(data: bytes, end: str) -> Iterator[int]:
    """A stream that ends, is reset or falls silent."""
    over = threading.Event()

    def send() -> None:
        client = None
        while client is None:
            if over.is_set():
                return
            with suppress(TimeoutError):
                client, _ = server.accept()
        with client:
            piece = len(data) // 40 + 1
            for first in range(0, len(data), piece):
                try:
                    client.sendall(data[first : first + piece])
                except ConnectionError:
                    return
                over.wait(0.02)
            if end == "silent":
                over.wait()
            if end == "reset":
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        sender = threading.Thread(target=send, daemon=True)
        sender.start()
        yield server.getsockname()[1]
        over.set()
        sender.join(timeout=AT_MOST_S)


def wait_for(process: subprocess.Popen[str], path: Path) -> None:
    """Until a file is there."""
    last = time.monotonic() + AT_MOST_S
    while not path.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < last
        time.sleep(0.01)


def wait_until_idle(process: subprocess.Popen[str]) -> None:
    """Until a command has dealt with all that it was sent, and only waits."""
    stat, last = Path(f"/proc/{process.pid}/stat"), time.monotonic() + AT_MOST_S
    if not stat.exists():
        pytest.skip("only Linux tells how much a process computes")
    ticks = -100
    while True:
        time.sleep(2.0)
        now = sum(map(int, stat.read_text().rpartition(")")[2].split()[11:13]))
        if now - ticks < 10:
            return
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < last
        ticks = now


def unfinished(path: Path) -> Path:
    return path.with_name(f".{path.name}.unfinished") / path.name


def track(harbour: Path, source: object, out: Path) -> tuple[str, ...]:
    model = ("--model", harbour / "camera.safetensors", "--detector", "motion")
    model += ("--clock", harbour / "film.csv") if (harbour / "film.csv").exists() else ()
    return tuple(map(str, ("track", source, *model, "-o", out)))


@pytest.mark.parametrize(
    ("end", "status", "said"),
    [
        ("ends", 2, "error: {s}: breaks off after "),
        ("reset", 2, "error: {s}: breaks off after "),
        ("silent", 0, "stopped: {s}: what was tracked until then is written"),
    ],
)
def test_a_stream_leaves_what_was_tracked(
    harbour: Path, tmp_path: Path, transport_stream: bytes, end: str, status: int, said: str
) -> None:
    out = tmp_path / "t.csv"
    with camera(transport_stream, end) as port:
        stream = STREAM.format(port=port)
        process = start(track(harbour, stream, out), tmp_path)
        if end == "silent":
            wait_for(process, unfinished(out))
            wait_until_idle(process)
            process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=AT_MOST_S)
    assert err.startswith(said.format(s=stream)), err
    assert (process.returncode, err.count("\n")) == (status, 1)
    (boat,) = read_tracks(out)
    # A detector of what moves needs some of the first of twelve seconds, a decoder of the last.
    assert boat.time_utc_s[0] < START_UTC_S + 4.0
    assert boat.time_utc_s[-1] > START_UTC_S + 8.0


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_search_is_ended_and_its_boxes_are_written(
    tmp_path: Path, made_stream: bytes, sent: signal.Signals
) -> None:
    """A stream that falls silent stands in for a film that goes on for hours."""
    out = tmp_path / "b.csv"
    with camera(made_stream, "silent") as port:
        stream = STREAM.format(port=port)
        process = start(("detect", stream, "--detector", "motion", "-o", str(out)), tmp_path)
        wait_for(process, unfinished(out))
        wait_until_idle(process)
        process.send_signal(sent)
        said, err = process.communicate(timeout=AT_MOST_S)
    assert err == f"stopped: {stream}: the boxes until then are written\n"
    assert process.returncode == 0
    assert len(read_boxes(out)) > 10
    assert "boxes: " in said


@pytest.mark.parametrize(("sent", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_while_a_stream_is_being_opened(
    harbour: Path, tmp_path: Path, sent: signal.Signals, status: int
) -> None:
    """A camera that takes the call and says nothing is never open."""
    out = tmp_path / "t.csv"
    write_tracks([], out)
    before = out.read_bytes()
    with camera(b"", "silent") as port:
        process = start(track(harbour, STREAM.format(port=port), out), tmp_path)
        wait_for(process, unfinished(out))
        process.send_signal(sent)
        assert process.communicate(timeout=AT_MOST_S) == ("", "stopped\n")
    assert process.returncode == status
    assert out.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["harbour", "t.csv"]


def test_twice_is_at_once(harbour: Path, tmp_path: Path, transport_stream: bytes) -> None:
    out = tmp_path / "t.csv"
    with camera(transport_stream, "silent") as port:
        process = start(track(harbour, STREAM.format(port=port), out), tmp_path)
        wait_for(process, unfinished(out))
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=AT_MOST_S)
    assert process.returncode == 130
    assert not out.exists()


@pytest.mark.parametrize("module", ["typer", "numpy", "pandas", "scipy.optimize", "av"])
def test_while_a_library_is_loaded(harbour: Path, tmp_path: Path, module: str) -> None:
    """The library that is loaded next asks to stop, and makes an error of its own of it."""
    code = f"""
        import os, signal, sys
        signal.signal(signal.SIGINT, signal.default_int_handler)

        class Interrupting:
            def find_spec(self, name, *_):
                if name == {module!r}:
                    try:
                        os.kill(os.getpid(), signal.SIGINT)
                        for _ in range(1000000): pass
                    except KeyboardInterrupt as error:
                        raise ImportError("cannot be loaded") from error

        sys.meta_path.insert(0, Interrupting())
        from sightline.__main__ import main
        main()
    """
    lines = "\n".join(line[8:] for line in code.splitlines())
    command = track(harbour, harbour / "boat.mp4", tmp_path / "t.csv")
    done = subprocess.run(
        [sys.executable, "-c", lines, *command],
        capture_output=True,
        text=True,
        timeout=AT_MOST_S,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "stopped\n")
    assert [path.name for path in tmp_path.iterdir()] == ["harbour"]


@pytest.mark.parametrize("name", ["run", "fit", "track", "detect"])
def test_what_is_killed_leaves_nothing_half_and_starts_anew(
    harbour: Path, tmp_path: Path, name: str
) -> None:
    """In the middle of the work, whose hidden folder is there, and no result."""
    out = tmp_path / "results" / "out.csv"
    scene = str(harbour / "scene.toml")
    command = {
        "run": ("run", scene, "--model", "qkr", "-o", str(out)),
        "fit": ("fit", scene, "--model", "qkr", "-o", str(out)),
        "track": track(harbour, harbour / "boat.mp4", out),
        "detect": ("detect", str(harbour / "boat.mp4"), "--detector", "motion", "-o", str(out)),
    }[name]
    process = start(command, tmp_path)
    while not unfinished(out).parent.exists() and process.poll() is None:
        time.sleep(0.001)
    process.kill()
    process.communicate(timeout=AT_MOST_S)
    assert {path.name for path in out.parent.iterdir()} <= {unfinished(out).parent.name, out.name}
    process = start(command, tmp_path)
    _, err = process.communicate(timeout=AT_MOST_S)
    assert (process.returncode, err) == (0, "")
    assert [path.name for path in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize(
    ("closed", "status", "err"),
    [
        (">&-", 0, ""),
        (">&- 2>&-", 0, ""),
        ("</dev/null 1<&0", 2, "error: the output cannot be written: Bad file descriptor\n"),
        (">/dev/full", 2, "error: the output cannot be written: No space left on device\n"),
        ("| true", 0, ""),
    ],
)
@pytest.mark.parametrize("command", ["--version", "--help", "evaluate t.csv --fixes target.gpx"])
def test_standard_output_that_is_not_there(
    harbour: Path, tmp_path: Path, command: str, closed: str, status: int, err: str
) -> None:
    """What is printed is lost; no file takes the number of the stream, and nothing else fails."""
    if "full" in closed and not Path("/dev/full").exists():
        pytest.skip("only Linux has a device that is always full")
    boxes, model = harbour / "boxes" / "01.csv", harbour / "camera.safetensors"
    clock = harbour / "clock" / "01.csv"
    if command.startswith("evaluate"):
        made = ("track", boxes, "--model", model, "--clock", clock, "-o", harbour / "t.csv")
        start(tuple(map(str, made)), tmp_path).communicate(timeout=AT_MOST_S)
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f"{sys.executable} -m sightline {command} {closed}"],
        cwd=harbour,
        capture_output=True,
        text=True,
        timeout=AT_MOST_S,
        check=False,
    )
    assert (done.returncode, done.stderr) == (status, err)
