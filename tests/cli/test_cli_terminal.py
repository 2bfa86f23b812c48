"""Names of others reach a terminal as text."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from sightline.cli import common

NAME = "a\x1b]0;owned\x07\x1b[2J[red]b[bold]\\\u202e:warning:"
SHOWN = r"a\x1b]0;owned\x07\x1b[2J[red]b[bold]\\u202e:warning:"


def test_an_error_shows_control_characters_and_sends_none(tmp_path: Path) -> None:
    path = tmp_path / f"{NAME}.csv"
    path.write_text("frame,x1,y1,x2\n")
    done = subprocess.run(
        [sys.executable, "-m", "sightline", "evaluate", str(path), "--fixes", str(path)],
        capture_output=True,
        env={**os.environ, "NO_COLOR": "1", "PYTHONIOENCODING": "utf-8"},
        check=False,
    )
    assert done.returncode == 2
    said = (done.stderr + done.stdout).decode()
    assert not set("\x1b\x07\u202e") & set(said)
    assert SHOWN in said
    assert said.count("\n") == 1


def test_a_name_that_is_no_text_can_be_said(tmp_path: Path) -> None:
    """Names of files are bytes, and need not be text in any encoding."""
    path = os.path.join(os.fsencode(tmp_path), b"a\xff.csv")
    try:
        with open(path, "w") as file:
            file.write("frame\n")
    except OSError:
        pytest.skip("this file system takes only names that are text")
    done = subprocess.run(
        [sys.executable, "-m", "sightline", "evaluate", path, "--fixes", path],
        capture_output=True,
        check=False,
    )
    assert done.returncode == 2
    assert rb"a\udcff.csv" in done.stderr


@pytest.mark.parametrize("colours", [True, False])
def test_lines_and_warnings_are_text(monkeypatch: pytest.MonkeyPatch, colours: bool) -> None:
    shown = io.StringIO()
    system = "truecolor" if colours else None
    console = Console(file=shown, force_terminal=colours, color_system=system, width=200)
    monkeypatch.setattr(common, "stdout", console)
    monkeypatch.setattr(common, "stderr", console)
    common.say(NAME)
    common.say_aside("warning:", f"{NAME}\nsecond", "yellow")
    common.warn(NAME)
    text = shown.getvalue()
    assert text.splitlines()[0] == SHOWN
    assert "\u202e" not in text
    assert f"{SHOWN} second" in text
    # The colour of the first word is the program's own.
    assert text.count("\x1b") == (text.count("\x1b[1;33m") + text.count("\x1b[0m"))
    assert ("\x1b[1;33mwarning:" in text) == colours
