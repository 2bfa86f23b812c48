"""One camera: its projection, its calibration, and how it points over time."""
