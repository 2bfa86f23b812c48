"""Many cameras and archives of recordings: which there are, and work on all of them."""

from sightline.fleet.archive import BatchResult, run_batch
from sightline.fleet.config import (
    Fleet,
    FleetCamera,
    FleetRecording,
    FusedFleet,
    TracksOfCamera,
    read_fleet,
    read_fused_fleet,
)
from sightline.fleet.fused import fuse_fleet

__all__ = [
    "BatchResult",
    "Fleet",
    "FleetCamera",
    "FleetRecording",
    "FusedFleet",
    "TracksOfCamera",
    "fuse_fleet",
    "read_fleet",
    "read_fused_fleet",
    "run_batch",
]
