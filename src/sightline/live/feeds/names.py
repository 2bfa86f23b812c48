"""What a target is called where people read it."""

from __future__ import annotations

from sightline.moment import TargetState


def display_name(target: TargetState) -> str:
    """Its name, else its MMSI, else its number. A name is text from outside, never markup."""
    if target.name:
        return target.name
    return f"target {target.id}" if target.mmsi is None else f"MMSI {target.mmsi:09d}"
