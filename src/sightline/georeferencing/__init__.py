"""Stage 3: georeferencing of boxes, with models learned from boxes and logs."""
