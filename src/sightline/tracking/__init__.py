"""Stage 2: boxes in, boxes with a track id out."""

from sightline.tracking.image import ImageTracker, ImageTrackerSettings, iou
from sightline.tracking.tracker import Tracker

__all__ = ["ImageTracker", "ImageTrackerSettings", "Tracker", "iou"]
