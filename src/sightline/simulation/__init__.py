"""A synthetic harbour whose truth is known."""
