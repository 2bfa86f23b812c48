"""Frames with times, from files, folders and streams."""
