"""Smooth, georeferenced tracks from the video of one camera that nobody calibrated.

>>> scene = sightline.Scene.load("scene.toml")
>>> model = sightline.fit(scene)
>>> tracks = sightline.track("harbour.mp4", model)
>>> tracks.write("tracks.geojson")
>>> report = sightline.evaluate(tracks, fixes="target.gpx")
"""

from importlib.metadata import version as _version

from sightline.errors import FitError, InputError, ModelFileError, SightlineError
from sightline.inference.georeferencer import MODELS, Georeferencer, fit
from sightline.inference.model_file import load_model as load
from sightline.pipeline import compare, evaluate, iter_tracks, run, track
from sightline.scene import Scene
from sightline.tracks import Tracks
from sightline.types import Boxes, Fixes, Positions, Track

__version__ = _version("sightline")

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
