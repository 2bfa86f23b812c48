"""Stage 2: boxes in, boxes with a track id out."""
