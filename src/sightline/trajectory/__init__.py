"""Stage 4: positions at irregular times in, a smooth track out."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from sightline.errors import unknown_name
from sightline.trajectory.base import TrajectoryMethod
from sightline.trajectory.paper import PaperChain
from sightline.trajectory.smoother import NoiseModel, RtsSmoother, SmoothedTrack

_METHODS: dict[str, type[PaperChain] | type[RtsSmoother]] = {
    "paper": PaperChain,
    "rts": RtsSmoother,
}

METHODS = tuple(_METHODS)
"""The names that `method` knows."""


def method(name: str, **settings: Any) -> TrajectoryMethod:
    """A trajectory method by its name.

    Args:
        name: ``"paper"`` (`PaperChain`) or ``"rts"`` (`RtsSmoother`).
        settings: Its attributes, where they differ from the defaults.

    Raises:
        InputError: The name or a setting is not known, or a setting is out of range.
    """
    if name not in _METHODS:
        raise unknown_name("trajectory method", name, METHODS)
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
