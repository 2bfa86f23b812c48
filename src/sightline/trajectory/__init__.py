"""Stage 4: trajectory estimation, positions at irregular times in and a smooth track out."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from sightline._plugins import loaded, registered
from sightline.errors import unknown_name
from sightline.trajectory.base import TrajectoryMethod
from sightline.trajectory.paper import PaperChain
from sightline.trajectory.smoother import NoiseModel, RtsSmoother, SmoothedTrack

_METHODS: dict[str, type[PaperChain] | type[RtsSmoother]] = {
    "paper": PaperChain,
    "rts": RtsSmoother,
}

METHODS = tuple(_METHODS)
"""The names of the methods that ship."""

ENTRY_POINT_GROUP = "sightline.trajectories"


def method(name: str | TrajectoryMethod, **settings: Any) -> TrajectoryMethod:
    """A trajectory method by its name; an object is returned as it is.

    Args:
        name: ``"paper"`` (`PaperChain`) or ``"rts"`` (`RtsSmoother`), a name that another package
            registers under the entry point group ``sightline.trajectories`` (it names a callable
            that takes the settings), or an object.
        settings: Its attributes, where they differ from the defaults.

    Raises:
        InputError: The name or a setting is not known, or a setting is out of range.
    """
    if not isinstance(name, str):
        return name
    if name not in _METHODS:
        others = registered(ENTRY_POINT_GROUP)
        if name not in others:
            raise unknown_name("trajectory method", name, (*METHODS, *sorted(others)))
        made: TrajectoryMethod = loaded(others[name])(**settings)
        return made
    kind = _METHODS[name]
    known = [setting.name for setting in fields(kind)]
    for setting in settings:
        if setting not in known:
            raise unknown_name(f"setting of trajectory method {name!r}", setting, known)
    return kind(**settings)


__all__ = [
    "METHODS",
    "NoiseModel",
    "PaperChain",
    "RtsSmoother",
    "SmoothedTrack",
    "TrajectoryMethod",
    "method",
]
