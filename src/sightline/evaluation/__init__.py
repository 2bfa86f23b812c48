"""Stage 5: how far a track is from the log."""
