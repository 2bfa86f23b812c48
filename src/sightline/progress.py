"""Callback for the progress of long work."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Told what is being done and what share of it is done, 0 to 1; NaN where nobody knows."""
