"""The campaign tries what it says, notices what it is for, and stays the same by its seed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pynmea2
import pytest
from fuzz.campaign import make_input
from fuzz.examples import make_examples
from fuzz.minimise import minimised
from fuzz.readers import READERS
from fuzz.texts import AIS, SENTENCES

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="the campaign forks")

PLANTED = """
import ctypes, gc, json, os, subprocess, sys, threading, time
from fuzz.isolation import Limits, call_apart
from sightline.errors import InputError

def raises(): [][1]
def refuses(): raise InputError("line 3: no time")
def hangs(): time.sleep(60)
def hangs_in_c(): ctypes.CDLL(None).sleep(60)
def hangs_at_work():
    while True: pass
def hogs(): kept = b"x" * 130_000_000
def asks_for_more_than_there_is(): bytearray(2**40)
def crashes(): ctypes.string_at(0)
def leaves(): os._exit(3)
def exits(): sys.exit(0)
def starts(): subprocess.run(["true"])
def fetches():
    import socket
    try:
        socket.create_connection(("127.0.0.1", 9), timeout=1)
    except OSError:
        raise InputError("nobody answers")
def fails_in_a_thread():
    one = threading.Thread(target=raises); one.start(); one.join()
def fails_where_nobody_hears():
    class Odd:
        def __del__(self): raises()
    Odd()
def complains_for_ever(): raise InputError("x" * 10_000)
def reads(): return 1
def collects(): gc.collect()

class Threaded:
    # Garbage that waits for a thread, which a fork does not have.
    def __init__(self):
        self.cycle, self.parent = self, os.getpid()
    def __del__(self):
        if os.getpid() != self.parent: time.sleep(60)

gc.collect()
gc.disable()
Threaded()
calls = [value for name, value in list(globals().items()) if type(value) is type(raises)
         and name not in ("call_apart",)]
limits = Limits(seconds=1.0, memory_mb=100.0)
print(json.dumps({call.__name__: call_apart(call, limits).end for call in calls}))
"""


def _run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    paths = [str(ROOT / "tools"), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@pytest.mark.slow
def test_what_goes_wrong_is_noticed(tmp_path: Path) -> None:
    done = _run("-c", PLANTED, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    ends = json.loads(done.stdout)
    assert ends.pop("reads") == "read"
    assert ends.pop("collects") == "read"
    assert ends.pop("refuses") == "refused"
    assert ends == {
        "raises": "IndexError",
        "hangs": "hang",
        "hangs_in_c": "hang",
        "hangs_at_work": "hang",
        "hogs": "memory",
        "asks_for_more_than_there_is": "memory",
        "crashes": "killed by SIGSEGV",
        "leaves": "left with status 3",
        "exits": "SystemExit",
        "starts": "asks for subprocess.Popen",
        "fetches": "asks for socket.getaddrinfo",
        "fails_in_a_thread": "in a thread IndexError",
        "fails_where_nobody_hears": "ignored IndexError",
        "complains_for_ever": "a message too long to read",
    }


@pytest.mark.slow
def test_three_hundred_inputs_are_read_or_refused(tmp_path: Path) -> None:
    done = _run("-m", "fuzz", "--count", "300", "--seed", "0", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = {line[:27].strip(): line[27:].split() for line in done.stdout.splitlines()[1:-1]}
    assert set(rows) == {*(reader.name for reader in READERS), "all"}
    assert rows["all"][0] == "300"
    for name, (tried, read, refused, findings, *_) in rows.items():
        assert int(tried) > 0, name
        assert int(tried) == int(read) + int(refused), name
        assert findings == "0"
    # Spoilt so far that everything is refused at the door would try nothing.
    assert 60 < int(rows["all"][1]) < 240


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples")
    make_examples(folder)
    return folder


def test_an_input_depends_on_its_seed_and_number_alone(examples: Path) -> None:
    numbers = range(3 * len(READERS))
    forward = {i: make_input(5, i, examples, READERS) for i in numbers}
    for i in reversed(numbers):
        assert make_input(5, i, examples, READERS) == forward[i]
    other = [make_input(6, i, examples, READERS).content for i in numbers]
    assert sum(a == forward[i].content for i, a in enumerate(other)) < len(numbers) / 4


def test_examples_are_the_same_each_time(examples: Path, tmp_path: Path) -> None:
    make_examples(tmp_path)
    names = [path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()]
    assert len(names) > 40
    different = [n for n in names if (tmp_path / n).read_bytes() != (examples / n).read_bytes()]
    assert different == []


def test_spoilt_sentences_pass_their_checksum(examples: Path) -> None:
    content = (examples / "log.nmea").read_bytes()
    rng = np.random.default_rng(0)
    for mutator in SENTENCES[:8]:
        spoilt = mutator(rng, content)
        assert spoilt != content
        for line in spoilt.decode().splitlines():
            body, _, digits = line[1:].partition("*")
            assert pynmea2.NMEASentence.checksum(body) == int(digits, 16), line
    assert AIS[0](rng, (examples / "one.nmea").read_bytes()) != (examples / "one.nmea").read_bytes()


def test_what_does_not_matter_is_left_out() -> None:
    content = b"first\nsecond, with a fault, and more\nthird\n" * 20
    assert minimised(content, lambda part: b"fault" in part) == b"fault"
    assert minimised(content, lambda part: part.count(b"\n") >= 3) == b"\n\n\n"
