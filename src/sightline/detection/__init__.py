"""Stage 1: frames in, boxes out."""
