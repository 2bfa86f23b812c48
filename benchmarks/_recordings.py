"""Where the recordings are that benchmarks read."""

from __future__ import annotations

import os
import sys
from pathlib import Path

DATA = Path(os.environ.get("SIGHTLINE_DATA", Path(__file__).parents[2] / "shared" / "data"))


def challenge_scene(given: str | None = None) -> Path:
    """The scene file that is given, or that of the recordings where they are at hand.

    Ends the benchmark with a line, and not as a failure, where there is none.
    """
    path = Path(given) if given is not None else DATA / "tracks-at-sea" / "scene.toml"
    if not path.is_file():
        print("skipped: the recordings are not here; give the path of their scene file")
        sys.exit(0)
    return path


def other_cameras(given: str | None = None) -> Path:
    """The folder of boxes and places before other cameras: the given one, or the one at hand.

    Ends the benchmark with a line, and not as a failure, where there is none.
    """
    path = Path(given) if given is not None else DATA / "cameras"
    if not path.is_dir():
        print("skipped: the other cameras are not here; give the path of their folder")
        sys.exit(0)
    return path
