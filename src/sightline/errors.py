"""Errors that the user can mend, all under one root."""

from __future__ import annotations

import os
from collections.abc import Iterable


class SightlineError(Exception):
    """Root of every expected error: one line that says what is wrong, where, and what mends it.

    The command line prints it and exits with status 2; anything else that is raised is a bug.

    Examples:
        >>> try:
        ...     sightline.load("scene.toml")
        ... except sightline.SightlineError as error:
        ...     print(type(error).__name__)
        ModelFileError
    """


class InputError(SightlineError):
    """A file, a table or an argument that cannot be used as it is.

    Examples:
        >>> sightline.Boxes.of([[652.0, 400.0, 640.0, 412.0]])
        Traceback (most recent call last):
        sightline.errors.InputError: box 1: (652, 400, 640, 412) is empty or reversed; expected \
x1 < x2 and y1 < y2 (upper left corner, lower right corner)
    """


class BrokenOffError(InputError):
    """A video or a stream that cannot be read further; what came before it was handed on.

    Who reads it keeps what there is, says this line, and ends with status 2.

    Attributes:
        tracks: What `sightline.track` had made until then.

    Examples:
        >>> issubclass(sightline.errors.BrokenOffError, sightline.InputError)
        True
    """

    tracks: Iterable[object] = ()


class OutputError(InputError):
    """A file that cannot be written: a full disk, no permission, a file where a folder has to be.

    Examples:
        >>> sightline.Tracks(()).write("harbour.csv/tracks.csv")
        Traceback (most recent call last):
        sightline.errors.OutputError: harbour.csv/tracks.csv: cannot be written: Not a directory
    """


class StoppedError(SightlineError):
    """Work that was asked to stop before there was anything to keep.

    Examples:
        >>> import threading
        >>> stop = threading.Event()
        >>> stop.set()
        >>> model = sightline.load("model.safetensors")
        >>> next(sightline.iter_tracks("harbour.csv", model, stop=stop))
        Traceback (most recent call last):
        sightline.errors.StoppedError: stopped before anything was seen
    """


class FitError(SightlineError):
    """Data from which a model cannot be learned: too few pairs, all in one place, no agreement.

    Examples:
        >>> scene = sightline.Scene.load("scene.toml")
        >>> sightline.compare(scene.select(["01"]))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        sightline.errors.FitError: ...leaving one recording out needs at least two recordings...
    """


class ModelFileError(InputError):
    """A model file that is damaged, of another kind, or of a newer format version.

    Examples:
        >>> sightline.load("harbour.csv")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        sightline.errors.ModelFileError: harbour.csv...
    """


def unknown_name(kind: str, name: str, known: list[str] | tuple[str, ...]) -> InputError:
    """An `InputError` for a name that is not among the known ones, which it lists.

    Args:
        kind: What is named, for example ``"model"``.
        name: The name that was given.
        known: The names that would have been right.
    """
    return InputError(f"unknown {kind} {name!r}; known are {', '.join(known)}")


def no_scene_file(path: str | os.PathLike[str]) -> InputError:
    """An `InputError` for a scene file that is not there."""
    return InputError(f"{path}: there is no such scene file")


def no_model_file(path: str | os.PathLike[str]) -> ModelFileError:
    """A `ModelFileError` for a model file that is not there."""
    return ModelFileError(f"{path}: there is no such model file; `sightline fit` writes one")
