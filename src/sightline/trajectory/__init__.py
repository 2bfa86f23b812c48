"""Stage 4: positions at irregular times in, a smooth track out."""
