"""What was found drawn into a picture: boxes, places on the water, and a map in the corner."""

from sightline.overlay.picture import (
    Found,
    Overlay,
    OverlaySettings,
    fixes_sigma_of,
    still_camera,
)

__all__ = ["Found", "Overlay", "OverlaySettings", "fixes_sigma_of", "still_camera"]
