"""What was found drawn into a picture: boxes, places on the water, and a map in the corner."""

from sightline.overlay.picture import (
    Found,
    Overlay,
    OverlaySettings,
    log_sigma_m,
    still_camera,
)

__all__ = ["Found", "Overlay", "OverlaySettings", "log_sigma_m", "still_camera"]
