"""What other packages register: detectors, trackers, trajectory methods and models by name."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points


def registered(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by their names; nothing of them is imported before it is used.

    Args:
        group: ``"sightline.models"`` or the like.
    """
    return {point.name: point for point in entry_points(group=group)}
