"""Threads bounded by a setting, in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from sightline import limits
from sightline.errors import InputError

COUNT = """
import os, sys, numpy as np
from sightline import limits
limits.limit_threads(int(sys.argv[1]))
import cv2
from threadpoolctl import threadpool_info
import scipy.linalg
from sightline.detection import OnnxDetector, detector_by_name
from sightline.types import Frame
detector = detector_by_name("harbour")
detector.detect(Frame(0, 0.0, np.zeros((360, 640, 3), np.uint8)))
np.ones((600, 600)) @ np.ones((600, 600))
print(cv2.getNumThreads(), max(one["num_threads"] for one in threadpool_info()))
print(detector._network._session.get_session_options().intra_op_num_threads)
"""


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )


def test_each_library_takes_as_many_threads_as_it_may() -> None:
    done = run("-c", COUNT, "1")
    assert done.stdout.split() == ["1", "1", "1"], done.stderr


def test_processes_that_are_started_inherit_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SIGHTLINE_THREADS", *limits._OF_LIBRARIES):
        monkeypatch.setenv(name, "7")
    limits.limit_threads(2)
    assert limits.most_threads() == 2
    done = run("-c", "from sightline import limits; print(limits.most_threads())")
    assert done.stdout.strip() == "2"
    monkeypatch.setenv("SIGHTLINE_THREADS", "many")
    with pytest.raises(InputError, match="SIGHTLINE_THREADS=many: expected a number from 1"):
        limits.most_threads()


def test_no_threads_are_told() -> None:
    done = run("-m", "sightline", "--threads", "0", "detect", "none.mp4", "-o", "boxes.csv")
    assert done.returncode == 2
    assert "0 threads cannot be had" in done.stderr
    assert done.stderr.count("\n") == 1
