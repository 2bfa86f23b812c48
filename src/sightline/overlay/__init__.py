"""What was found drawn into the video: boxes, places on the water, and a map in the corner."""

from sightline.overlay.picture import Found, Overlay, OverlaySettings
from sightline.overlay.show import Footage, Shown, show_picture, show_video, tracks_of

__all__ = [
    "Footage",
    "Found",
    "Overlay",
    "OverlaySettings",
    "Shown",
    "show_picture",
    "show_video",
    "tracks_of",
]
