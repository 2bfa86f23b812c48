"""Files that hold fixes, boxes and tracks: one module a format."""
