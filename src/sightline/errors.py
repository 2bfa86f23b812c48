"""Errors that the user can mend, all under one root."""

from __future__ import annotations

import os


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

    Examples:
        >>> issubclass(sightline.errors.BrokenOffError, sightline.InputError)
        True
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
