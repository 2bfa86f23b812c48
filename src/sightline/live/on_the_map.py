"""The newest picture of a camera as it lies on the map, made when somebody asks for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.overlay.rectified import Rectifier, webp
from sightline.overlay.water_view import WaterView
from sightline.types import FloatArray

# A camera that turns by less moves the picture by a pixel or so; to lay it anew takes a while.
_STEP_RAD = 1e-3


@dataclass(frozen=True, eq=False)
class Newest:
    """A picture and how its camera lay.

    Attributes:
        image_bgr: (H, W, 3), masked.
        rotation_rad: (3,) by which the scene has turned about the camera's axes since the fit; NaN
            where that is not known.
    """

    image_bgr: NDArray[np.uint8]
    rotation_rad: FloatArray


class PictureOnMap:
    """Lays the newest picture onto the map.

    Args:
        model: Of the camera; without one nothing is shown.
        newest: Gives the newest picture; None before there is one.
        water_level_m: Where the model needs it.
    """

    def __init__(
        self,
        model: Georeferencer,
        newest: Callable[[], Newest | None],
        water_level_m: float | None = None,
    ) -> None:
        self._model, self._newest = model, newest
        self._above_m = float(model.above_m(water_level_m))
        self._lock = threading.Lock()
        self._known: tuple[tuple[float, ...], Rectifier] | None = None

    @property
    def possible(self) -> bool:
        """Whether the model has a camera that stands still."""
        return self._model.camera is not None and not self._model.moving

    def about(self) -> dict[str, object] | None:
        """Corners of the picture and how far it reaches; None where there is none."""
        made = self._made()
        return None if made is None else made[0].about()

    def picture(self) -> bytes | None:
        """The newest picture as WebP with transparent parts; None where there is none."""
        made = self._made()
        return None if made is None else webp(made[0].rectified(made[1].image_bgr))

    def _made(self) -> tuple[Rectifier, Newest] | None:
        newest, camera = self._newest(), self._model.camera
        if newest is None or camera is None or self._model.moving:
            return None
        turned = np.nan_to_num(newest.rotation_rad)
        turned = np.round(turned / _STEP_RAD) * _STEP_RAD
        key = tuple(turned.tolist())
        # Two that ask at once wait for each other, and neither does it twice.
        with self._lock:
            if self._known is None or self._known[0] != key:
                view = WaterView.of(camera, self._above_m, turned)
                try:
                    self._known = key, Rectifier.of(view, self._model.plane)
                except InputError:
                    # A camera that looks up for a moment sees no water.
                    return None
            return self._known[1], newest
