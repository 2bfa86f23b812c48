from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path
from typing import Any

import pytest

from sightline import atomic
from sightline.atomic import atomic_folder, atomic_path
from sightline.errors import InputError, OutputError


def write_half_and_raise(target: Path, error: Exception) -> None:
    with atomic_path(target) as path:
        path.write_text("half")
        raise error


def test_the_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "new" / "result.json"
    with atomic_path(target) as path:
        path.write_text("whole")
        assert path.suffix == ".json"
        assert not target.exists()
    assert target.read_text() == "whole"
    assert [p.name for p in target.parent.iterdir()] == ["result.json"]


def test_the_file_is_as_readable_as_any_other(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    with atomic_path(tmp_path / "atomic") as path:
        path.write_text("")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_an_exception_leaves_none_of_the_folders_that_were_made(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    with pytest.raises(ZeroDivisionError):
        write_half_and_raise(tmp_path / "old" / "new" / "newer" / "a.csv", ZeroDivisionError())
    assert list((tmp_path / "old").iterdir()) == []


def test_an_exception_leaves_the_older_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "result.csv"
    target.write_text("older")
    with pytest.raises(ZeroDivisionError):
        write_half_and_raise(target, ZeroDivisionError())
    assert target.read_text() == "older"
    assert list(tmp_path.iterdir()) == [target]


def test_a_full_disk_is_one_line_that_names_the_file(tmp_path: Path) -> None:
    target = tmp_path / "result.csv"
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(InputError, match=r"result\.csv: cannot be written: No space left"):
        write_half_and_raise(target, full)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_write_that_the_system_refuses(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No space left"), atomic_path(tmp_path / "a"):
        Path("/dev/full").write_text("x")


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder"), atomic_path(tmp_path):
        pass


def test_a_file_in_the_way_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    inside = tmp_path / "plain" / "result.csv"
    with pytest.raises(InputError, match="cannot be written"), atomic_path(inside):
        pass


def test_a_failure_of_another_file_stays_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a"):
        (tmp_path / "elsewhere" / "missing").read_text()


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path: Path) -> None:
    target, link = tmp_path / "there" / "result.json", tmp_path / "link.json"
    target.parent.mkdir()
    target.write_text("old")
    link.symlink_to(target)
    with atomic_path(link) as path:
        path.write_text("new")
        assert target.read_text() == "old"
    assert link.is_symlink()
    assert target.read_text() == "new"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_pipe_is_written_to_and_never_replaced(tmp_path: Path) -> None:
    """As ``--json /dev/stdout`` needs it; and /dev/null must remain what it is."""
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    with atomic_path(pipe) as path:
        path.write_text("whole")
    reader.join(timeout=10.0)
    assert read == ["whole"]
    assert pipe.is_fifo()
    assert [p.name for p in tmp_path.iterdir()] == ["pipe.json"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_pipe_gets_nothing_of_what_fails(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    with pytest.raises(ZeroDivisionError):
        write_half_and_raise(pipe, ZeroDivisionError())
    assert pipe.is_fifo()


def test_a_folder_that_may_not_be_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system names the hidden folder, whose name nobody was told."""
    mkdir = Path.mkdir

    def refuse(path: Path, *arguments: Any, **named: Any) -> None:
        if path.name.startswith("."):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        mkdir(path, *arguments, **named)

    monkeypatch.setattr(Path, "mkdir", refuse)
    with (
        pytest.raises(InputError, match=r"new/a\.csv: cannot be written: Permission denied"),
        atomic_path(tmp_path / "new" / "a.csv"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def killed_while_writing(target: Path, how: str = "atomic_path") -> None:
    """A process that is killed with half of its result written."""
    code = f"""
        import os, signal
        from sightline.atomic import {how}
        with {how}({str(target)!r}) as path:
            file = path if {how == "atomic_path"} else path / "a.csv"
            file.write_text("half")
            (file.parent / "beside-journal").write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=False)
    assert done.returncode == -signal.SIGKILL


@pytest.mark.skipif(os.name == "nt", reason="needs kill -9")
@pytest.mark.parametrize("how", ["atomic_path", "atomic_folder"])
def test_what_a_killed_run_leaves_is_hidden_and_goes_with_the_next(
    tmp_path: Path, how: str
) -> None:
    target = tmp_path / "new" / "result.csv"
    killed_while_writing(target, how)
    assert [path.name for path in target.parent.iterdir()] == [".result.csv.unfinished"]
    if how == "atomic_path":
        with atomic_path(target) as path:
            assert sorted(p.name for p in path.parent.iterdir()) == ["lock", "result.csv"]
            assert path.read_bytes() == b""
            path.write_text("whole")
        assert target.read_text() == "whole"
    else:
        with atomic_folder(target) as folder:
            assert list(folder.iterdir()) == []
            (folder / "a.csv").write_text("whole")
        assert (target / "a.csv").read_text() == "whole"
    assert [path.name for path in target.parent.iterdir()] == ["result.csv"]


def test_a_second_run_into_the_same_goal_is_refused(tmp_path: Path) -> None:
    target, link = tmp_path / "result.csv", tmp_path / "link.csv"
    link.symlink_to(target)
    with atomic_path(target) as path:
        path.write_text("first")
        for same in (target, link, tmp_path / "x" / ".." / "result.csv"):
            with (
                pytest.raises(InputError, match="another run is writing it"),
                atomic_path(same),
            ):
                pass
        assert path.read_text() == "first"
    assert target.read_text() == "first"


def test_a_second_run_into_the_same_folder_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "results" / "a"
    with atomic_folder(target) as folder:
        (folder / "a.csv").write_text("first")
        with pytest.raises(InputError, match="another run is writing it"), atomic_folder(target):
            pass
        target.mkdir()
        with pytest.raises(InputError, match="another run is writing it"), atomic_folder(target):
            pass
    assert [path.name for path in target.iterdir()] == ["a.csv"]


def test_a_run_that_fails_removes_nothing_of_another(tmp_path: Path) -> None:
    """Both made ``results``; the one that fails is the one that made it first."""

    def fail() -> None:
        with atomic_folder(tmp_path / "results" / "b") as failing:
            (failing / "half.csv").write_text("half")
            with atomic_folder(tmp_path / "results" / "a") as folder:
                (folder / "a.csv").write_text("whole")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    left = [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))]
    assert left == ["results", "results/a", "results/a/a.csv"]


def test_a_folder_that_exists_keeps_what_is_not_replaced(tmp_path: Path) -> None:
    target = tmp_path / "results"
    (target / "tracks").mkdir(parents=True)
    for name in ("mine.txt", "tracks/mine.csv", "tracks/a.csv"):
        (target / name).write_text("older")
    with atomic_folder(target) as folder:
        (folder / "tracks").mkdir()
        (folder / "tracks" / "a.csv").write_text("new")
        assert (target / "tracks" / "a.csv").read_text() == "older"
    contents = {path.name: path.read_text() for path in target.rglob("*") if path.is_file()}
    assert contents == {"mine.txt": "older", "mine.csv": "older", "a.csv": "new"}
    assert [path.name for path in tmp_path.iterdir()] == ["results"]


def test_a_folder_does_not_replace_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "boxes").mkdir()
    drawn = tmp_path / "boxes" / "01.csv"
    drawn.write_text("drawn by hand")
    os.link(drawn, tmp_path / "linked.csv")
    with (
        pytest.raises(InputError, match=r"boxes/01\.csv: is read by this command"),
        atomic_folder(tmp_path / "boxes", inputs=[tmp_path / "linked.csv"]) as folder,
    ):
        (folder / "01.csv").write_text("proposed")
    assert drawn.read_text() == "drawn by hand"


def test_results_lie_in_a_folder_beside_which_nothing_can_be_put(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "mounted"
    target.mkdir()
    monkeypatch.setattr("os.access", lambda *_: False)
    with atomic_folder(target) as folder:
        assert target in folder.parents
        (folder / "a.csv").write_text("whole")
    assert [path.name for path in target.iterdir()] == ["a.csv"]


def test_what_somebody_put_in_the_way_is_not_removed(tmp_path: Path) -> None:
    hidden = tmp_path / ".result.csv.unfinished"
    hidden.mkdir()
    (hidden / "mine.txt").write_text("mine")
    with (
        pytest.raises(InputError, match="is in the way, and nothing that a run has left"),
        atomic_path(tmp_path / "result.csv"),
    ):
        pass
    assert (hidden / "mine.txt").read_text() == "mine"


def test_a_disk_without_locks_tells_nobody_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then both write, each in a folder of its own, and the later one stays."""

    def refuse(_: int) -> bool:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(atomic, "locked", refuse)
    target = tmp_path / "result.csv"
    with atomic_path(target) as first:
        first.write_text("first")
        with atomic_path(target) as second:
            second.write_text("second")
        assert target.read_text() == "second"
    assert target.read_text() == "first"
    assert list(tmp_path.iterdir()) == [target]


def test_the_content_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "result.csv"
    there: list[bool] = []
    sync = os.fsync

    def watch(handle: int) -> None:
        there.append(target.exists())
        sync(handle)

    monkeypatch.setattr("os.fsync", watch)
    with atomic_path(target) as path:
        path.write_text("whole")
    # The file before, the folder that names it after.
    assert there == [False, True]


def test_a_disk_that_is_full_when_it_is_asked_keeps_the_older_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a disk of the network says it: when the file is put there, not when it is written."""
    target = tmp_path / "result.csv"
    target.write_text("older")

    def refuse(_: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr("os.fsync", refuse)
    with (
        pytest.raises(OutputError, match=r"result\.csv: cannot be written: Disk quota exceeded"),
        atomic_path(target) as path,
    ):
        path.write_text("new")
    assert target.read_text() == "older"
    assert list(tmp_path.iterdir()) == [target]


def test_a_long_name_has_room_for_what_hides_it(tmp_path: Path) -> None:
    names = [f"{letter}{'é' * 120}.csv" for letter in "ab"]
    with atomic_path(tmp_path / names[0]) as first, atomic_path(tmp_path / names[1]) as second:
        first.write_text("first")
        second.write_text("second")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict(
        zip(names, ("first", "second"), strict=True)
    )


def test_who_waits_writes_after_the_other(tmp_path: Path) -> None:
    """What is read inside of the block is what the other has left."""
    target = tmp_path / "count"
    target.write_text("0")

    def add() -> None:
        for _ in range(20):
            with atomic_path(target, wait_s=30.0) as path:
                path.write_text(str(int(target.read_text()) + 1))

    threads = [threading.Thread(target=add) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert target.read_text() == "80"


def test_who_has_waited_long_enough_is_refused(tmp_path: Path) -> None:
    with (
        atomic_path(tmp_path / "one") as path,
        pytest.raises(InputError, match="another run is writing it"),
        atomic_path(tmp_path / "one", wait_s=0.05),
    ):
        path.write_text("never")
