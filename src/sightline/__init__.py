"""Smooth, georeferenced tracks from the video of one camera that nobody calibrated.

>>> scene = sightline.Scene.load("scene.toml")
>>> model = sightline.fit(scene)
>>> tracks = sightline.track("harbour.csv", model)  # a table of boxes; or a video
>>> tracks.write("tracks.geojson")
>>> report = sightline.evaluate(tracks, fixes="target.gpx")
>>> round(report.coverage.p95, 1)
1.0
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING, Any

from sightline.errors import FitError, InputError, ModelFileError, SightlineError

if TYPE_CHECKING:
    from sightline.georeferencing.georeferencer import Georeferencer
    from sightline.georeferencing.georeferencer import load_model as load
    from sightline.georeferencing.models import MODELS
    from sightline.pipeline.check import check
    from sightline.pipeline.evaluate import compare, evaluate
    from sightline.pipeline.fit_unlabelled import fit_scene as fit
    from sightline.pipeline.run import run
    from sightline.pipeline.track import iter_tracks, track
    from sightline.scene import Scene
    from sightline.tracks import Tracks
    from sightline.types import Boxes, Fixes, Positions, Track

    __version__: str

# Where the names are that bring scikit-learn, video and readers along: on first use.
_LATER = {
    "fit": "sightline.pipeline.fit_unlabelled:fit_scene",
    "MODELS": "sightline.georeferencing.models",
    "Georeferencer": "sightline.georeferencing.georeferencer",
    "load": "sightline.georeferencing.georeferencer:load_model",
    "check": "sightline.pipeline.check",
    "compare": "sightline.pipeline.evaluate",
    "evaluate": "sightline.pipeline.evaluate",
    "iter_tracks": "sightline.pipeline.track",
    "run": "sightline.pipeline.run",
    "track": "sightline.pipeline.track",
    "Scene": "sightline.scene",
    "Tracks": "sightline.tracks",
    "Boxes": "sightline.types",
    "Fixes": "sightline.types",
    "Positions": "sightline.types",
    "Track": "sightline.types",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # Reading it takes longer than all else here.
        from importlib.metadata import version

        return version("sightline")
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _LATER[name].partition(":")
    value = getattr(_import_module(module), attribute or name)
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
    "check",
    "compare",
    "evaluate",
    "fit",
    "iter_tracks",
    "load",
    "run",
    "track",
]
