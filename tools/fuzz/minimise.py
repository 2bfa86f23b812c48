"""The smallest input that still shows what a larger one shows."""

from __future__ import annotations

from collections.abc import Callable

Shows = Callable[[bytes], bool]


def minimised(content: bytes, shows: Shows, most_tries: int = 2000) -> bytes:
    """Leave out lines and then bytes, ever smaller pieces of them, while a fault still shows.

    Args:
        content: That shows it.
        shows: Whether another content shows it as well.
        most_tries: After so many the smallest so far is taken.
    """
    left = [most_tries]
    lines = _without(content.splitlines(keepends=True), lambda parts: shows(b"".join(parts)), left)
    small = b"".join(lines)
    parts = _without(
        [small[i : i + 1] for i in range(len(small))], lambda p: shows(b"".join(p)), left
    )
    return b"".join(parts)


def _without(
    parts: list[bytes], shows: Callable[[list[bytes]], bool], left: list[int]
) -> list[bytes]:
    """Parts without those that are not needed, by halving (delta debugging)."""
    size = max(len(parts) // 2, 1)
    while parts:
        at = 0
        while at < len(parts) and left[0] > 0:
            fewer = parts[:at] + parts[at + size :]
            left[0] -= 1
            if shows(fewer):
                parts = fewer
            else:
                at += size
        if size == 1 or left[0] <= 0:
            break
        size //= 2
    return parts
