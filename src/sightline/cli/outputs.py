"""Outputs of a command: which files they may be, and that one that fails spoils no other."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from sightline.atomic import same_file
from sightline.errors import InputError, OutputError, SightlineError

if TYPE_CHECKING:
    from types import TracebackType

T = TypeVar("T")
Item = TypeVar("Item", contravariant=True)

_PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")


def keep_apart(
    outputs: Iterable[Path | None], inputs: Iterable[str | os.PathLike[str] | None]
) -> None:
    """Raise InputError where an output would overwrite an input, or another output.

    Files are the same through links of either kind. A picture in a folder that is read is an input
    as well.

    Raises:
        InputError: An output is an input or another output, or it can be no file.
    """
    written = [path for path in outputs if path is not None]
    read = [_without_scheme(path) for path in inputs if path is not None]
    for i, path in enumerate(written):
        check_place(path)
        for source in read:
            picture = os.path.isdir(source) and path.suffix.lower() in _PICTURES
            if same_file(path, source) or (picture and same_file(path.parent, source)):
                raise InputError(f"{path}: is read by this command; give the result another name")
        for other in written[:i]:
            # A device may take several: /dev/null.
            special = os.path.exists(path) and not os.path.isfile(path)
            if same_file(path, other) and not special:
                raise InputError(f"{path}: is given for two results; give each its own name")


def check_place(path: Path) -> None:
    """Raise where no file can be, however much room there is.

    Raises:
        OutputError: A folder on the way is a file, or a name is too long.
    """
    for folder in path.absolute().parents:
        try:
            if os.path.lexists(folder):
                if not folder.is_dir():
                    raise OutputError(f"{path}: cannot be written: {os.strerror(errno.ENOTDIR)}")
                break
        except OSError:
            break
    try:
        os.lstat(path)
    except FileNotFoundError:
        return
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _without_scheme(path: str | os.PathLike[str]) -> str:
    """The path of a file that was given as an address, ``file:harbour.mp4``."""
    text = os.fspath(path)
    if text.lower().startswith("file:"):
        text = text[len("file:") :]
        text = text[2:] if text.startswith("//") else text
    return text


class Attempts:
    """Results that are written one by one: what fails is told at the end, and spoils no other."""

    def __init__(self) -> None:
        self.failed: list[Exception] = []

    @contextmanager
    def one(self) -> Iterator[None]:
        """Write one result in the block; what it raises is kept."""
        try:
            yield
        except Exception as error:
            self.failed.append(error)

    def check(self) -> None:
        """Raise what was kept: a bug as it is, else one line for all.

        Raises:
            OutputError: Results could not be written.
        """
        bugs = [one for one in self.failed if not isinstance(one, SightlineError | OSError)]
        if bugs:
            raise bugs[0]
        if len(self.failed) == 1:
            raise self.failed[0]
        if self.failed:
            raise OutputError("; ".join(map(str, self.failed))) from self.failed[0]


class Writer(Protocol[Item]):
    """What takes the items of a result, one at a time."""

    def add(self, item: Item, /) -> None:
        """Write an item."""
        ...


class _AbandonedError(Exception):
    """Thrown into the writers of files that are not to appear."""


class Outputs(Generic[Item]):
    """Files that are written at the same time; one that fails is closed, and the others go on.

    They appear with `finish`. Where the block ends without it, none does.
    """

    def __init__(
        self,
        open_writer: Callable[[Path], AbstractContextManager[Writer[Item]]],
        attempts: Attempts,
    ) -> None:
        """Take what opens a file.

        Args:
            open_writer: The file appears when its context ends well.
            attempts: Is given what fails.
        """
        self._open_writer = open_writer
        self._attempts = attempts
        self._open: dict[Path, tuple[ExitStack, Writer[Item]]] = {}
        self.written: list[Path] = []

    def __enter__(self) -> Outputs[Item]:
        return self

    def __exit__(self, *_: object) -> None:
        for path in list(self._open):
            self._abandon(path, _AbandonedError())

    @property
    def any_open(self) -> bool:
        """Whether there is a file that can still be written."""
        return bool(self._open)

    def open(self, paths: Sequence[Path]) -> None:
        """Open files.

        Raises:
            InputError: One cannot be asked for as it is, or none can be written.
        """
        failed: list[Exception] = []
        for path in paths:
            stack = ExitStack()
            try:
                self._open[path] = (stack, stack.enter_context(self._open_writer(path)))
            except (OutputError, OSError) as error:
                failed.append(error)
        if failed and len(failed) == len(paths):
            raise failed[0]
        self._attempts.failed += failed

    def add(self, item: Item) -> None:
        """Write an item to each file.

        Raises:
            OutputError: None can be written any more.
        """
        for path, (_, writer) in list(self._open.items()):
            try:
                writer.add(item)
            except Exception as error:
                self._attempts.failed.append(self._abandon(path, error))
        if not self._open:
            self._attempts.check()

    def finish(self) -> None:
        """Let the files appear."""
        for path in list(self._open):
            with self._attempts.one():
                stack, _ = self._open.pop(path)
                stack.close()
                self.written.append(path)

    def _abandon(self, path: Path, error: Exception) -> Exception:
        """Close a file that is not to appear; returns what is to be told of it."""
        stack, _ = self._open.pop(path)
        kind: type[Exception] = type(error)
        traceback: TracebackType | None = error.__traceback__
        try:
            stack.__exit__(kind, error, traceback)
        except Exception as told:
            return told
        return error
