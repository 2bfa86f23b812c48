"""Programs of others that receive what is published: where they are, and how they are run.

`SIGHTLINE_CLIENTS` names folders in which they are looked for before ``PATH``, for example the
``bin`` of a virtual environment with taky and movingpandas, and ``node_modules/.bin``.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


def client(name: str, how: str) -> str:
    """The program, or the test is skipped, and says how it can be had."""
    folders = os.environ.get("SIGHTLINE_CLIENTS", "")
    found = shutil.which(name, path=os.pathsep.join([folders, os.environ.get("PATH", "")]))
    if found is None:
        pytest.skip(f"{name} is not installed ({how}; SIGHTLINE_CLIENTS names its folder)")
    return found


@contextmanager
def running(
    *command: str | Path, port: int, folder: Path, environment: dict[str, str] | None = None
) -> Iterator[None]:
    """A server, from when it listens until the block ends."""
    with (folder / "server.log").open("wb") as log:
        server = subprocess.Popen(
            [str(part) for part in command],
            cwd=folder,
            stdout=log,
            stderr=log,
            env={**os.environ, **(environment or {})},
        )
        try:
            until(lambda: listens(port) or server.poll() is not None, 60.0)
            if server.poll() is not None:
                said = (folder / "server.log").read_text(errors="replace")[-500:]
                pytest.skip(f"{command[0]} does not start here: {said}")
            yield
        finally:
            server.terminate()
            server.wait(20.0)


def listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as made:
        return int(made.getsockname()[1])


def until(condition: Callable[[], bool], most_s: float = 20.0) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s, "it did not come to that"
        time.sleep(0.05)
