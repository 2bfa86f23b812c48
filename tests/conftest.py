from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings; the test is skipped where there is none."""
    named = os.environ.get("SIGHTLINE_DATA")
    folder = Path(named) if named else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(
            f"no real data: {folder} does not exist; set SIGHTLINE_DATA to the folder that has it"
        )
    return folder


# How long an example takes is the machine's affair; speed is measured in benchmarks/.
hypothesis.settings.register_profile("sightline", deadline=None)
hypothesis.settings.load_profile("sightline")
