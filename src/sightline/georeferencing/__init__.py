"""Stage 3: a box in, a place on the earth with its covariance out."""
