"""Smooth, georeferenced tracks from the video of one camera that nobody calibrated."""
