from __future__ import annotations

from pathlib import Path

import pytest
from drawable import Drawable, copied, make


@pytest.fixture(scope="session")
def drawable_once(tmp_path_factory: pytest.TempPathFactory) -> Drawable:
    return make(tmp_path_factory.mktemp("drawable"))


@pytest.fixture
def drawable(drawable_once: Drawable, tmp_path: Path) -> Drawable:
    """A copy of the scene that may be drawn in."""
    return copied(drawable_once, tmp_path / "scene")
