"""One camera: projection, calibration, and its rotation over time."""
