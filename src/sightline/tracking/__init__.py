"""Stage 2: multi-object tracking, boxes in and boxes with a track id out."""

from sightline.tracking.image import ImageTracker, ImageTrackerSettings
from sightline.tracking.registry import tracker_by_name
from sightline.tracking.targets import TargetTracker, TrackerSettings
from sightline.tracking.tracker import Tracker
from sightline.tracking.world import WorldTracker, WorldTrackerSettings

__all__ = [
    "ImageTracker",
    "ImageTrackerSettings",
    "TargetTracker",
    "Tracker",
    "TrackerSettings",
    "WorldTracker",
    "WorldTrackerSettings",
    "tracker_by_name",
]
