"""What another package registers, or a user hands in as an object, works in every seam."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PACKAGE = Path(__file__).parent / "sightline_example"

# A white square drives over a plane that an affine map takes to metres: a truth in closed form.
WORLD = r"""
import json, sys
import numpy as np
import sightline
from sightline.errors import InputError
from sightline.formats import write_boxes, write_fixes
from sightline.geodesy import LocalPlane
from sightline.pipeline.track import TrackSettings
from sightline.types import Boxes, Fixes, Frame
from sightline.video import write_video

plane = LocalPlane(54.0, 10.0)
start_s = 1_717_236_000.0
seconds = np.arange(0.0, 12.0, 0.5)
x = 40.0 + 10.0 * seconds
y = 60.0 + 4.0 * seconds
corners = np.stack([x, y, x + 20.0, y + 20.0], axis=1)
east, north = 2.0 * (x + 10.0) + 5.0, 3.0 * (y + 20.0) - 7.0


def picture(i):
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    column, row = int(x[i]), int(y[i])
    image[row : row + 20, column : column + 20] = 255
    return Frame(i, start_s + float(seconds[i]), image)


write_video("world.mp4", map(picture, range(len(seconds))))
boxes = Boxes.of(corners, frame=np.arange(len(seconds)), time_utc_s=start_s + seconds)
write_boxes(boxes, "boxes.csv")
latitude, longitude = plane.to_geographic(east, north)
write_fixes(Fixes(start_s + seconds, latitude, longitude), "fixes.csv")
open("scene.toml", "w").write(
    "[camera]\nlatitude_deg = 54.0\nlongitude_deg = 10.0\nimage_size_px = [320, 240]\n"
    '[[recordings]]\nname = "one"\nboxes = "boxes.csv"\nfixes = "fixes.csv"\n'
)
scene = sightline.Scene.load("scene.toml")
"""

BY_NAME = """
model = sightline.fit(scene, model="example-affine")
model.save("model.safetensors")
model = sightline.load("model.safetensors")
detector, tracker, trajectory = "example-squares", "example-nearest", "example-straight"
"""

BY_OBJECT = """
from sightline_example import AFFINE, Nearest, Squares, Straight

model = sightline.fit(scene, model=AFFINE)
model.save("model.safetensors")
model = sightline.load("model.safetensors", model=AFFINE)
detector, tracker, trajectory = Squares(), Nearest(), Straight()
"""

TRACK = """
settings = TrackSettings(tracker=tracker, trajectory=trajectory)
tracks = sightline.track(
    "world.mp4", model, detector=detector, start_utc_s=start_s, settings=settings
)
(track,) = tracks
n = len(track)
error_m = np.hypot(track.east_m - east[:n], track.north_m - north[:n])
print(json.dumps({
    "model": model.model,
    "points": len(track),
    "error_m": float(error_m.max()),
    "sigma_m": float(np.sqrt(track.covariance_m2[0, 0, 0])),
}))
"""

UNKNOWN = """
for what in (
    lambda: sightline.fit(scene, model="nobody"),
    lambda: sightline.fit(scene, model="broken"),
    lambda: sightline.track("world.mp4", model, detector="nobody", start_utc_s=start_s),
    lambda: sightline.track(
        "world.mp4", model, detector=detector, start_utc_s=start_s,
        settings=TrackSettings(tracker="nobody"),
    ),
    lambda: TrackSettings(trajectory="nobody"),
):
    try:
        what()
    except InputError as error:
        print(error)
    else:
        print("not refused")
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed the package, as from anywhere else."""
    target = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source") / "sightline_example"
    for path in PACKAGE.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            copy = source / path.relative_to(PACKAGE)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    command = ["install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run(
        [sys.executable, "-m", "pip", *command, "--target", str(target), str(source)],
        check=True,
        capture_output=True,
    )
    return target


def run(code: str, installed: Path, folder: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize("how", [BY_NAME, BY_OBJECT], ids=["by name", "as objects"])
def test_detector_tracker_trajectory_and_model_of_another_package(
    how: str, installed: Path, tmp_path: Path
) -> None:
    found = json.loads(run(WORLD + how + TRACK, installed, tmp_path)[-1])
    assert found["model"] == "example-affine"
    assert found["points"] == 12
    # The square stands at whole pixels in the picture, 2 m to the right and 3 m down each.
    assert found["error_m"] < np.hypot(2.0, 3.0)
    assert found["sigma_m"] == 1.0


def test_unknown_names_list_those_that_are_registered(installed: Path, tmp_path: Path) -> None:
    said = run(WORLD + BY_NAME + UNKNOWN, installed, tmp_path)
    model, broken, detector, tracker, trajectory = said[-5:]
    assert "example-affine" in model
    assert "sightline-example registers it as sightline_example:NOTHING" in broken
    assert "example-squares" in detector
    assert "example-nearest" in tracker
    assert "example-straight" in trajectory
