"""Atomic files and folders: they appear whole or not at all.

What is being written lies in a hidden folder beside its goal, ``.NAME.unfinished``, that the
process holds a lock on. The lock dies with the process, so a folder that can be locked is what a
killed run has left, and is emptied by whoever writes to the same goal next; one that cannot be
locked belongs to a run that is still at work, and a second one into the same goal is refused.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sightline.errors import InputError, OutputError, SightlineError

_LOCK = "lock"
_UNFINISHED = ".unfinished"
_LONGEST_NAME_BYTES = 200
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL)
_NO_SYNC = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
_ATTEMPTS = 100
_PAUSE_S = 0.02


@contextmanager
def atomic_path(path: str | os.PathLike[str], *, wait_s: float = 0.0) -> Iterator[Path]:
    """Temporary path beside ``path`` that replaces it when the block ends well.

    The temporary file lies in a hidden folder beside the final one, so that the replacement is one
    step of the file system, and what a library leaves beside its file goes with the folder. It has
    the final name, so that libraries that pick a format by it are not misled. Missing parent
    folders are made. If the block raises, what it wrote and the folders that were made for it are
    removed, and an older file under the final name stays as it was. The content is on the disk
    before it has the final name: not even a loss of power leaves an empty file.

    A symbolic link stays, and what it leads to is replaced. A device or a pipe (``/dev/stdout``)
    cannot be replaced; it is written to when the block ends well.

    Nobody else writes the file while the block lasts, so what is read in it is what is replaced.

    Args:
        path: Where the file is to be.
        wait_s: How long to wait for somebody else who is writing to it.

    Yields:
        Where to write it: an empty file that exists already.

    Raises:
        OutputError: The operating system refuses (disk full, no permission).
        InputError: ``path`` is a folder, or somebody else is writing to it.
    """
    # os.path answers where pathlib raises: for a name that is too long, or a folder that is closed.
    if os.path.isdir(path):
        raise InputError(f"{path}: cannot be written, it is a folder; give the name of a file")
    if os.path.exists(path) and not os.path.isfile(path):
        with _poured_into(Path(path)) as elsewhere:
            yield elsewhere
        return
    final = Path(os.path.realpath(path))
    work = _hidden(final)
    try:
        with _made_folders(final.parent), own_folder(work, path, wait_s) as folder:
            temporary = folder / final.name
            temporary.touch()
            yield temporary
            _to_disk(temporary)
            temporary.replace(final)
            _folder_to_disk(final.parent)
    except OSError as error:
        if not _concerns(error, final, work):
            raise
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


@contextmanager
def atomic_folder(
    path: str | os.PathLike[str], *, inputs: Iterable[str | os.PathLike[str]] = ()
) -> Iterator[Path]:
    """Working folder whose files take their places in ``path`` when the block ends well.

    It lies beside ``path``; or in it, where nothing can be put beside it or that is another disk.
    A folder that is new appears in one step; in one that exists files of the same name are
    replaced, each in one step, and others stay. If the block raises, the working folder is
    removed, and nothing else is but folders that were made for it and are empty.

    Args:
        path: The folder for the results.
        inputs: Files that must not be replaced, since the results are made of them.

    Yields:
        An empty folder.

    Raises:
        OutputError: The operating system refuses.
        InputError: ``path`` is a file, a file would take the place of a folder or the reverse, an
            input would be replaced, or somebody else is writing to ``path``.
    """
    if os.path.exists(path) and not os.path.isdir(path):
        raise InputError(f"{path}: is a file; give a folder for the results")
    goal = Path(os.path.realpath(path))
    work = _beside_or_in(goal)
    try:
        with _made_folders(goal.parent), own_folder(work, path) as folder:
            made = folder / "files"
            made.mkdir()
            try:
                yield made
            except SightlineError as error:
                raise as_placed(error, made, path) from error
            _take_places(made, goal, inputs)
            _folder_to_disk(goal.parent)
    except OSError as error:
        if error.filename is None or not _concerns(error, goal, work):
            raise
        what = "cannot be written to" if os.path.isdir(path) else "cannot be made"
        raise OutputError(f"{path}: {what}: {error.strerror or error}") from error


def as_placed(error: Exception, work: Path, goal: str | os.PathLike[str]) -> Exception:
    """An error that names a file of a working folder, with the name that it would have had."""
    if not isinstance(error, SightlineError) or str(work) not in str(error):
        return error
    return type(error)(str(error).replace(str(work), os.fspath(goal)))


def same_file(one: str | os.PathLike[str], other: str | os.PathLike[str]) -> bool:
    """Whether two paths lead to one file: through links of either kind, or where it will be."""
    if os.path.realpath(one) == os.path.realpath(other):
        return True
    try:
        return os.path.samefile(one, other)
    except OSError:
        return False


def check_places(places: Iterable[Path], inputs: Iterable[str | os.PathLike[str]] = ()) -> None:
    """Raise where files cannot take their places in a folder.

    Args:
        places: The files.
        inputs: Files that must not be replaced.

    Raises:
        InputError: A place is a folder, one that it lies in is a file, or it is an input.
    """
    kept = [path for path in inputs if os.path.exists(path)]
    for final in places:
        if final.is_dir():
            raise InputError(f"{final}: is a folder, where a file has to go")
        if final.parent.exists() and not final.parent.is_dir():
            raise InputError(f"{final.parent}: is a file, where a folder has to go")
        if any(same_file(final, path) for path in kept):
            raise InputError(f"{final}: is read by this command; give another folder")


def _take_places(made: Path, goal: Path, inputs: Iterable[str | os.PathLike[str]]) -> None:
    """Move all files of a folder into another, or the folder where that is new."""
    files = sorted(path for path in made.rglob("*") if not path.is_dir())
    places = [(path, goal / path.relative_to(made)) for path in files]
    # All that can be known to fail does so before anything takes its place.
    check_places([final for _, final in places], inputs)
    if not goal.exists():
        made.rename(goal)
        return
    for path, final in places:
        final.parent.mkdir(parents=True, exist_ok=True)
        path.replace(final)


def _hidden(goal: Path) -> Path:
    """The folder in which what will be at ``goal`` is written."""
    name = goal.name
    if len(os.fsencode(name)) > _LONGEST_NAME_BYTES:
        name = f"{name[:40]}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:16]}"
    return goal.with_name(f".{name}{_UNFINISHED}")


def _beside_or_in(goal: Path) -> Path:
    if goal.is_dir():
        same_disk = goal.parent.stat().st_dev == goal.stat().st_dev
        if goal == goal.parent or not same_disk or not os.access(goal.parent, os.W_OK | os.X_OK):
            return goal / f".results{_UNFINISHED}"
    return _hidden(goal)


@contextmanager
def _made_folders(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; if the block raises, those made that are empty go again."""
    new = [one for one in (folder, *folder.parents) if not os.path.exists(one)]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            # It is a file.
            raise NotADirectoryError(
                errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder)
            ) from error
        yield
    except BaseException:
        for one in new:
            # Others may have put something there meanwhile.
            with suppress(OSError):
                one.rmdir()
        raise


@contextmanager
def own_folder(folder: Path, goal: str | os.PathLike[str], wait_s: float = 0.0) -> Iterator[Path]:
    """A folder that nobody else has while the block lasts: empty before, removed after.

    Args:
        folder: Its path; its parent exists.
        goal: What is written in it, for messages.
        wait_s: How long to wait for somebody else who has it.

    Raises:
        InputError: Somebody else has it, or it is none that this function made.
    """
    lock = _taken(folder, goal, time.monotonic() + wait_s)
    if lock is None:
        # This disk knows no locks: then nobody can be told apart, and everybody takes a new one.
        folder = Path(tempfile.mkdtemp(suffix=_UNFINISHED, prefix=folder.stem, dir=folder.parent))
    try:
        _empty(folder)
        yield folder
    finally:
        with suppress(OSError):
            _empty(folder)
            # In this order: a folder that holds anything holds its lock as well.
            (folder / _LOCK).unlink(missing_ok=True)
            folder.rmdir()
        if lock is not None:
            os.close(lock)


def _taken(folder: Path, goal: str | os.PathLike[str], until_s: float) -> int | None:
    """The lock of a folder, which is made; None where the disk knows no locks."""
    lock = folder / _LOCK
    attempts = 0
    while attempts < _ATTEMPTS:
        attempts += 1
        try:
            folder.mkdir()
        except FileExistsError:
            if _foreign(folder):
                raise InputError(
                    f"{folder}: is in the way, and nothing that a run has left; rename it"
                ) from None
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:
            # Whoever had the folder has just removed it.
            continue
        try:
            if not locked(handle):
                if time.monotonic() < until_s:
                    os.close(handle)
                    time.sleep(_PAUSE_S)
                    attempts = 0
                    continue
                raise InputError(
                    f"{goal}: another run is writing it; wait for that, or give another name"
                )
            if lock.exists() and os.path.samestat(os.fstat(handle), lock.stat()):
                return handle
        except OSError as error:
            os.close(handle)
            if error.errno in _NO_LOCKS:
                with suppress(OSError):
                    lock.unlink()
                    folder.rmdir()
                return None
            raise
        except InputError:
            os.close(handle)
            raise
        os.close(handle)
    raise InputError(f"{goal}: other runs are writing it; give another name")


def _foreign(folder: Path) -> bool:
    """Whether a path is in the way that is no working folder: without a lock these are empty."""
    if folder.is_symlink() or not folder.is_dir():
        return folder.exists() or folder.is_symlink()
    names = {path.name for path in folder.iterdir()}
    return bool(names) and _LOCK not in names


if sys.platform == "win32":
    import msvcrt

    def locked(handle: int) -> bool:
        """Whether a file could be locked, until it is closed or the process ends."""
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except PermissionError:
            return False
        return True

else:
    import fcntl

    def locked(handle: int) -> bool:
        """Whether a file could be locked, until it is closed or the process ends."""
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        if path.name == _LOCK:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _to_disk(path: Path) -> None:
    with path.open("r+b") as file:
        _synchronise(file.fileno())


def _folder_to_disk(folder: Path) -> None:
    # Elsewhere a folder cannot be opened. What it holds is on the disk already.
    if sys.platform != "win32":
        with suppress(OSError):
            handle = os.open(folder, os.O_RDONLY)
            try:
                _synchronise(handle)
            finally:
                os.close(handle)


def _synchronise(handle: int) -> None:
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise


@contextmanager
def _poured_into(special: Path) -> Iterator[Path]:
    """Temporary path whose content is copied to a device or a pipe when the block ends well."""
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / f"whole{special.suffix}"
        temporary.touch()
        yield temporary
        try:
            with temporary.open("rb") as source, special.open("wb") as target:
                shutil.copyfileobj(source, target)
        except BrokenPipeError:
            # Whoever read it has read enough.
            raise
        except OSError as error:
            raise OutputError(f"{special}: cannot be written: {error.strerror or error}") from error


def _concerns(error: OSError, final: Path, work: Path) -> bool:
    """Whether an error is of this file: reading another file in the block may fail as well."""
    if isinstance(error, ConnectionError | TimeoutError):
        return False
    if error.filename is None:
        return True
    # FFmpeg is told that a name is one of a file.
    named = Path(os.fsdecode(error.filename).removeprefix("file:"))
    return named in (final, work, final.parent) or work in named.parents or named in final.parents
