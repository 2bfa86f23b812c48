"""A simulated scene without boxes, and what a hand would draw in it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from sightline.formats import write_fixes
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, SimulatedCamera
from sightline.types import Boxes

CAMERA = SimulatedCamera(
    height_m=7.0,
    pitch_deg=4.0,
    roll_deg=0.8,
    heading_deg=30.0,
    focal_length_px=1000.0,
    k1=-0.12,
    k2=0.01,
)
RATE_HZ = 0.5


@dataclass(frozen=True, eq=False)
class Drawable:
    """A scene without boxes, whose pictures are black, and what a hand would draw in them.

    Attributes:
        scene: The scene file.
        hand: By frame, the box that a hand draws, a pixel off or so.
        truth: By frame, the true box.
        count: How many frames there are.
    """

    scene: Path
    hand: dict[int, tuple[float, float, float, float]]
    truth: dict[int, tuple[float, float, float, float]]
    count: int

    @property
    def table(self) -> Path:
        """Where the boxes go."""
        return self.scene.parent / "boxes" / "dock.csv"


def by_frame(boxes: Boxes) -> dict[int, tuple[float, float, float, float]]:
    rows = zip(boxes.frame.tolist(), boxes.xyxy_px.tolist(), strict=True)
    return {number: (box[0], box[1], box[2], box[3]) for number, box in rows}


def make(folder: Path) -> Drawable:
    """Write the scene."""
    settings = HarbourSettings(duration_s=120.0, camera=CAMERA, gulls=0)
    harbour = Harbour.random(21, settings)
    times = harbour.times(RATE_HZ)
    (folder / "frames").mkdir()
    black = cv2.imencode(".png", np.zeros((720, 1280, 3), np.uint8))[1].tobytes()
    for number in range(times.size):
        (folder / "frames" / f"{number:06d}.png").write_bytes(black)
    clock = pd.DataFrame({"frame": np.arange(times.size), "utc": times})
    clock.to_csv(folder / "clock.csv", index=False)
    write_fixes(harbour.fixes(), folder / "fixes.csv")
    scene = folder / "scene.toml"
    scene.write_text(
        "# By hand.\n[camera]\n"
        f"latitude_deg = {harbour.plane.latitude_deg}\n"
        f"longitude_deg = {harbour.plane.longitude_deg}\n"
        "image_size_px = [1280, 720]\n\n"
        '[[recordings]]\nname = "dock"\nframes = "frames"\nclock = "clock.csv"\n'
        'fixes = "fixes.csv"\n',
        encoding="utf-8",
    )
    hand = by_frame(harbour.boxes(times, noise=BoxNoise(std_px=1.0, source="hand")))
    low, high = np.zeros(4), np.array([1280.0, 720.0, 1280.0, 720.0])
    inside = {n: tuple(np.clip(box, low, high).round(2).tolist()) for n, box in hand.items()}
    return Drawable(scene, inside, by_frame(harbour.boxes(times)), times.size)


def copied(made: Drawable, folder: Path) -> Drawable:
    """The same scene in another folder, to be drawn in; its pictures are links."""
    shutil.copytree(made.scene.parent, folder, copy_function=_linked)
    scene = folder / "scene.toml"
    text = scene.read_text(encoding="utf-8")
    scene.unlink()
    scene.write_text(text, encoding="utf-8")
    return Drawable(scene, made.hand, made.truth, made.count)


def _linked(source: str, goal: str) -> None:
    Path(goal).hardlink_to(source)


def rows(path: Path) -> list[tuple[object, ...]]:
    """The frame, the lower edge and the annotator of each row of a table."""
    table = pd.read_csv(path, keep_default_na=False)
    return list(table[["frame", "y2", "annotator"]].itertuples(index=False, name=None))
