"""Collections of features, written one at a time: what GeoJSON and MF-JSON have in common."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO


@contextmanager
def feature_writer(path: Path, members: str = "") -> Iterator[FeatureWriter]:
    """Write a FeatureCollection.

    Args:
        path: The file.
        members: JSON of what it has besides features, with a comma behind.
    """
    with path.open("w", encoding="utf-8") as file:
        file.write(f'{{"type": "FeatureCollection", {members}"features": [')
        yield FeatureWriter(file)
        file.write("\n]}\n")


class FeatureWriter:
    """Adds features to an open collection; see `feature_writer`."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._separator = "\n"

    def add(self, features: Iterable[str]) -> None:
        """Write features, each as JSON."""
        text = ",\n".join(features)
        if text:
            self._file.write(self._separator + text)
            self._separator = ",\n"
