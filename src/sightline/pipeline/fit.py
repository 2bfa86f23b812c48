"""Fit a georeferencer to a scene with drawn boxes or control points."""

from __future__ import annotations

from collections.abc import Mapping

from sightline.georeferencing.fit import FitSettings
from sightline.georeferencing.fit import fit as fit_inputs
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.models import DEFAULT_MODEL, ModelType, model_type
from sightline.georeferencing.paper.model import PAPER_MODELS
from sightline.progress import Progress
from sightline.scene import Scene
from sightline.scene.correspondences import collect
from sightline.threads import on_one_thread
from sightline.types import Boxes


@on_one_thread
def fit(
    scene: Scene,
    model: str | ModelType = DEFAULT_MODEL,
    *,
    seed: int = 0,
    extra: Mapping[str, Boxes] | None = None,
    progress: Progress | None = None,
) -> Georeferencer:
    """Fit a georeferencer to a scene.

    Args:
        scene: Its recordings' boxes and logs, and its control points.
        model: One of `MODELS`, or a model type. The paper's learn from boxes alone, ours from
            control points too.
        seed: Of whatever is random in the fit.
        extra: Further boxes of the logged target; see `collect`.
        progress: Told which recording's frames are observed.

    Raises:
        InputError: The model's name is not known, or a file of the scene cannot be used.
        FitError: There are too few pairs, all in one place, or no camera explains them.
    """
    kind = model_type(model)
    inputs = collect(scene, extra=extra, pictures=kind.name not in PAPER_MODELS, progress=progress)
    return fit_inputs(inputs, FitSettings(model=kind, seed=seed))
