"""What is known of the moments in which boxes were seen, besides the boxes."""

from __future__ import annotations

from dataclasses import dataclass

from sightline.camera.rotation import Turns
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.platform import Platform
from sightline.types import Boxes, Positions
from sightline.water import WaterLevels


@dataclass(frozen=True, eq=False)
class Conditions:
    """How the camera lay, and how high the water stood.

    Attributes:
        turns: How the camera lay against that of the model; None: as for it. Boxes are levelled
            by it before they are placed.
        water: How high the water stood; None where it is taken to stand still.
    """

    turns: Turns | None = None
    water: WaterLevels | None = None

    def level(self, boxes: Boxes) -> Boxes:
        """Boxes as the camera of the model would have seen them, those of which that is known."""
        return boxes if self.turns is None else self.turns.level(boxes)

    def locate(
        self,
        boxes: Boxes,
        model: Georeferencer,
        platform: Platform | None = None,
        *,
        until_then: bool = False,
    ) -> Positions:
        """Where boxes lie from which the turns of the camera were taken off.

        Args:
            boxes: With their times.
            model: Says where a box lies.
            platform: What the camera stands on, where that moves.
            until_then: Whether that was where its fixes until each time tell.

        Raises:
            InputError: The water levels say nothing of a time, or do not fit the model.
        """
        if platform is not None:
            pose = platform.pose(boxes.time_utc_s, model.plane, until_then=until_then)
            return model.locate(boxes.xyxy_px, boxes.source, pose=pose)
        level_m = None if self.water is None else self.water.at(boxes.time_utc_s)
        positions = model.locate(boxes.xyxy_px, boxes.source, level_m)
        if self.turns is None:
            return positions
        return self.turns.widened(positions, boxes.time_utc_s, model.above_m(level_m))
