"""A call in a process of its own, with limits of time and memory, and what became of it."""

from __future__ import annotations

import faulthandler
import gc
import json
import math
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sightline.errors import SightlineError

READ, REFUSED = "read", "refused"

HANG = "hang"

_MOST_TEXT = 20_000
_LONGEST_LINE = 3_000
_OWN = Path(__file__)
_STATUS = Path("/proc/self/status")
# What starts a program or asks for the network, as Python's audit hooks name it.
_FORBIDDEN = (
    *("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.startfile", "pty.spawn"),
    *("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto"),
    *("pickle.find_class", "marshal.loads", "ctypes.dlopen"),
)
_HARMLESS = ("marshal.loads", "ctypes.dlopen")
"""What importing a module does as well."""


@dataclass(frozen=True)
class Limits:
    """What a process may take.

    Attributes:
        seconds: Of the processor's time, and from its start to its end.
        memory_mb: Resident, at its largest.
        patience: So many times as long it may last from its start to its end, where other work
            has the processor.
    """

    seconds: float = 10.0
    memory_mb: float = 1536.0
    patience: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """What became of a call.

    Attributes:
        end: `READ`, `REFUSED`, or what went wrong, in a few words that stay the same for the
            same fault.
        detail: The line of a refusal, or the traceback.
        seconds: How long it took.
        peak_mb: Largest resident memory.
    """

    end: str
    detail: str
    seconds: float
    peak_mb: float

    @property
    def is_finding(self) -> bool:
        """Whether neither was read nor refused."""
        return self.end not in (READ, REFUSED)


def call_apart(call: Callable[[], object], limits: Limits) -> Outcome:
    """Call a function in a forked process.

    Args:
        call: What is called; it may raise `SightlineError`.
        limits: What it may take.
    """
    reading, writing = os.pipe()
    began = time.monotonic()
    # What was garbage before is no matter of the child's: its end may wait for threads (as that of
    # a network does), and a fork has none of them.
    gc.freeze()
    child = os.fork()
    if not child:
        os.close(reading)
        _in_child(call, limits, writing)
    gc.unfreeze()
    os.close(writing)
    parts = []
    while part := os.read(reading, 65536):
        parts.append(part)
    os.close(reading)
    _, status, usage = os.wait4(child, 0)
    seconds, peak_mb = time.monotonic() - began, usage.ru_maxrss / 1024.0
    end, detail = _told(b"".join(parts), status)
    if end in (READ, REFUSED) and peak_mb > limits.memory_mb:
        end = "memory"
        detail = f"{peak_mb:.0f} MB at the largest; {detail}"
    return Outcome(end, detail, seconds, peak_mb)


def _told(said: bytes, status: int) -> tuple[str, str]:
    text = said.decode("utf-8", "replace")
    head, _, rest = text.rpartition("\x1e")
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        if number in (signal.SIGALRM, signal.SIGXCPU):
            return HANG, text
        return f"killed by {signal.Signals(number).name}", text
    try:
        answer = json.loads(rest)
    except ValueError:
        return f"left with status {os.waitstatus_to_exitcode(status)}", text
    return str(answer["end"]), "\n".join(part for part in (answer["detail"], head) if part)


def _in_child(call: Callable[[], object], limits: Limits, writing: int) -> None:
    """Call, tell by the pipe how it ended, and leave; never returns."""
    end, detail = "harness", ""
    try:
        # By the kernel, which also ends what does not come back to Python.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, limits.patience * limits.seconds)
        silent = os.open(os.devnull, os.O_RDWR)
        for standard in (0, 1, 2):
            os.dup2(silent, standard)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - ends with us
        sys.stderr = open(2, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        faulthandler.enable(writing)
        # What hangs says where before it is ended.
        faulthandler.dump_traceback_later(0.9 * limits.patience * limits.seconds, file=writing)
        _limit_memory(limits)
        _limit_processor(limits)
        seen = _watch()
        end, detail = _ended(call)
        if seen:
            end, detail = seen[0]
    except BaseException:
        detail = traceback.format_exc()
    answer = json.dumps({"end": end, "detail": detail[-_MOST_TEXT:]})
    os.write(writing, b"\x1e" + answer.encode("ascii", "replace"))
    os._exit(0)


def _limit_processor(limits: Limits) -> None:
    """What the process has used before the call does not count; the kernel counts whole seconds."""
    used_s = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
    most_s = math.ceil(used_s + limits.seconds)
    resource.setrlimit(resource.RLIMIT_CPU, (most_s, most_s + 1))


def _limit_memory(limits: Limits) -> None:
    """Twice what may be used, and what is mapped already: what asks for more is told so."""
    mapped_kb = 0
    for line in _STATUS.read_text().splitlines() if _STATUS.exists() else []:
        if line.startswith("VmSize:"):
            mapped_kb = int(line.split()[1])
    most = int(mapped_kb * 1024 + 2.0 * limits.memory_mb * 2**20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _watch() -> list[tuple[str, str]]:
    """Note what is raised where nobody catches it, and what asks for a program or the network."""
    seen: list[tuple[str, str]] = []

    def audit(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _FORBIDDEN and event not in _HARMLESS:
            stack = "".join(traceback.format_stack()[:-1])
            seen.append((f"asks for {event}", f"{str(arguments)[:500]}\n{stack[-_MOST_TEXT:]}"))

    def unraisable(what: Any) -> None:
        trace = "".join(traceback.format_exception(what.exc_value))
        seen.append((f"ignored {signature(what.exc_value)}", trace))

    def of_thread(what: Any) -> None:
        trace = "".join(traceback.format_exception(what.exc_value))
        seen.append((f"in a thread {signature(what.exc_value)}", trace))

    sys.addaudithook(audit)
    sys.unraisablehook = unraisable
    threading.excepthook = of_thread
    return seen


def _ended(call: Callable[[], object]) -> tuple[str, str]:
    try:
        call()
    except SightlineError as error:
        line = str(error)
        if len(line) > _LONGEST_LINE:
            return "a message too long to read", line[:_MOST_TEXT]
        return REFUSED, line
    except MemoryError:
        return "memory", traceback.format_exc()
    except BaseException as error:
        return signature(error), traceback.format_exc()
    return READ, ""


def signature(error: BaseException) -> str:
    """The kind of an error and the last line of the project that it passed."""
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        path = Path(frame.f_code.co_filename)
        if path != _OWN and ("sightline" in path.parts or "fuzz" in path.parts):
            place = f" at {path.name}:{line}"
    return f"{type(error).__name__}{place}"
