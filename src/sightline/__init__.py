"""Smooth, georeferenced tracks from the video of one camera that nobody calibrated.

>>> scene = sightline.Scene.load("scene.toml")
>>> model = sightline.fit(scene)
>>> tracks = sightline.track("harbour.mp4", model)
>>> tracks.write("tracks.geojson")
>>> report = sightline.evaluate(tracks, fixes="target.gpx")
"""

from importlib import import_module as _import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

from sightline.errors import FitError, InputError, ModelFileError, SightlineError

if TYPE_CHECKING:
    from sightline.association.teach import fit_scene as fit
    from sightline.inference.georeferencer import MODELS, Georeferencer
    from sightline.inference.model_file import load_model as load
    from sightline.pipeline import compare, evaluate, iter_tracks, run, track
    from sightline.scene import Scene
    from sightline.tracks import Tracks
    from sightline.types import Boxes, Fixes, Positions, Track

__version__ = _version("sightline")

# Where the names are that bring scikit-learn, video and readers along: on first use.
_LATER = {
    "fit": "sightline.association.teach",
    **dict.fromkeys(("MODELS", "Georeferencer"), "sightline.inference.georeferencer"),
    "load": "sightline.inference.model_file",
    **dict.fromkeys(("compare", "evaluate", "iter_tracks", "run", "track"), "sightline.pipeline"),
    "Scene": "sightline.scene",
    "Tracks": "sightline.tracks",
    **dict.fromkeys(("Boxes", "Fixes", "Positions", "Track"), "sightline.types"),
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = _import_module(_LATER[name])
    value = getattr(module, {"load": "load_model", "fit": "fit_scene"}.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


__all__ = [
    "MODELS",
    "Boxes",
    "FitError",
    "Fixes",
    "Georeferencer",
    "InputError",
    "ModelFileError",
    "Positions",
    "Scene",
    "SightlineError",
    "Track",
    "Tracks",
    "__version__",
    "compare",
    "evaluate",
    "fit",
    "iter_tracks",
    "load",
    "run",
    "track",
]
