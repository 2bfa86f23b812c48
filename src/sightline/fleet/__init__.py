"""Many cameras and archives of recordings: which there are, and work on all of them."""

from sightline.fleet.archive import BatchResult, run_batch
from sightline.fleet.config import Fleet, FleetCamera, FleetRecording, read_fleet

__all__ = [
    "BatchResult",
    "Fleet",
    "FleetCamera",
    "FleetRecording",
    "read_fleet",
    "run_batch",
]
