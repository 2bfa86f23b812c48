"""Trackers by name."""

from __future__ import annotations

from collections.abc import Callable

from sightline._plugins import loaded, registered
from sightline.errors import unknown_name
from sightline.tracking.tracker import Tracker

ENTRY_POINT_GROUP = "sightline.trackers"


def tracker_by_name(name: str | Tracker | Callable[[], Tracker]) -> Tracker:
    """A tracker by its entry point's name, or an object, which is reset.

    Args:
        name: A name that a package registers under the entry point group ``sightline.trackers``
            (it names a callable without arguments), such a callable, or an object.

    Raises:
        InputError: The name is not known; the message lists those that are.
    """
    if isinstance(name, str):
        others = registered(ENTRY_POINT_GROUP)
        if name not in others:
            raise unknown_name("tracker", name, sorted(others))
        made: Tracker = loaded(others[name])()
        return made
    if isinstance(name, Tracker) and not isinstance(name, type):
        name.reset()
        return name
    return name()
