from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest
from pond import SIZE_PX, picture

from sightline.scene import Scene

# Only `make test-train` installs what trains.
if importlib.util.find_spec("torch") is None:
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Three recordings of six frames with a boat each; of the last there are no boxes."""
    rng = np.random.default_rng(3)
    lines = ["[camera]", 'name = "pond"', f"image_size_px = [{SIZE_PX[0]}, {SIZE_PX[1]}]"]
    for name in ("a", "b", "c"):
        rows = ["frame,x1,y1,x2,y2,annotator"]
        for frame in range(6):
            x, y = int(rng.integers(20, 190)), int(rng.integers(30, 120))
            box = (x, y, x + 40, y + 18)
            path = tmp_path / "frames" / name / f"{frame:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), picture([box], frame)[..., ::-1])
            rows.append(",".join(str(value) for value in (frame, *box)) + ",eye")
        (tmp_path / "clock").mkdir(exist_ok=True)
        stamps = [f"{frame},2024-05-01T10:00:{frame:02d}Z" for frame in range(6)]
        (tmp_path / "clock" / f"{name}.csv").write_text("\n".join(["frame,utc", *stamps]) + "\n")
        lines += ["[[recordings]]", f'name = "{name}"', f'frames = "frames/{name}"']
        lines += [f'clock = "clock/{name}.csv"']
        if name != "c":
            (tmp_path / "boxes").mkdir(exist_ok=True)
            (tmp_path / "boxes" / f"{name}.csv").write_text("\n".join(rows) + "\n")
            lines.append(f'boxes = "boxes/{name}.csv"')
    path = tmp_path / "scene.toml"
    path.write_text("\n".join(lines) + "\n")
    return Scene.load(path)
