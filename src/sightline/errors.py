"""The errors that are the user's to mend, all under one root."""

from __future__ import annotations

import os


class SightlineError(Exception):
    """Root of every expected error: one line that says what is wrong, where, and what mends it.

    The command line prints it and exits with status 2; anything else that is raised is a bug.
    """


class InputError(SightlineError):
    """A file, a table or an argument that cannot be used as it is."""


class FitError(SightlineError):
    """Data from which a model cannot be learned: too few pairs, all in one place, no agreement."""


class ModelFileError(InputError):
    """A model file that is damaged, of another kind, or of a newer format version."""


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
