"""Plugins: detectors, trackers, trajectory methods and models that other packages register."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from sightline.errors import InputError


def registered(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by their names; none is imported before it is used.

    Args:
        group: ``"sightline.models"`` or the like.
    """
    return {point.name: point for point in entry_points(group=group)}


def loaded(point: EntryPoint) -> Any:
    """Load the object that an entry point names.

    Raises:
        InputError: It cannot be imported; the message names the package that registered it.
    """
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        owner = point.dist.name if point.dist is not None else "a package"
        raise InputError(
            f"{point.name!r}: {owner} registers it as {point.value}, which cannot be imported "
            f"({error}); install that package anew"
        ) from error
