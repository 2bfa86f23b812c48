"""Atomic files: they appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sightline.errors import InputError


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Temporary path beside ``path`` that replaces it when the block ends well.

    The temporary file lies in the same folder, so that the replacement is one step of the file
    system, and ends in the same suffix, so that libraries that pick a format by it are not misled.
    Missing parent folders are made. If the block raises, what it wrote and the folders that were
    made for it are removed, and an older file under the final name stays as it was.

    A symbolic link stays, and what it leads to is replaced. A device or a pipe (``/dev/stdout``)
    cannot be replaced; it is written to when the block ends well.

    Args:
        path: Where the file is to be.

    Yields:
        Where to write it: an empty file that exists already.

    Raises:
        InputError: The operating system refuses (disk full, no permission, ``path`` is a folder).
    """
    # os.path answers where pathlib raises: for a name that is too long, or a folder that is closed.
    if os.path.isdir(path):
        raise InputError(f"{path}: cannot be written, it is a folder; give the name of a file")
    if os.path.exists(path) and not os.path.isfile(path):
        with _poured_into(Path(path)) as elsewhere:
            yield elsewhere
        return
    final = Path(os.path.realpath(path))
    new_folders = [folder for folder in final.parents if not os.path.exists(folder)]
    temporary: Path | None = None
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{final.stem[:40]}-", suffix=final.suffix, dir=final.parent
        )
        os.close(handle)
        temporary = Path(name)
        # mkstemp makes files private; the result is to be as readable as any other new file.
        temporary.chmod(0o666 & ~_umask())
        yield temporary
        temporary.replace(final)
        new_folders.clear()
    except OSError as error:
        if not _concerns(error, final, temporary):
            raise
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        for folder in new_folders:
            # Others may have put something there meanwhile.
            with suppress(OSError):
                folder.rmdir()


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
        except OSError as error:
            raise InputError(f"{special}: cannot be written: {error.strerror or error}") from error


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current


def _concerns(error: OSError, final: Path, temporary: Path | None) -> bool:
    """Whether an error is of this file: reading another file in the block may fail as well."""
    if error.filename is None or temporary is None:
        return True
    named = Path(os.fsdecode(error.filename))
    return named in (final, temporary, final.parent) or named in final.parents
