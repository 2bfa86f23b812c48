"""A scene to be drawn in, and who draws."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image
from web_browser import Browser

from sightline.labelling.drawing import Drawing
from sightline.simulation import SimulationSettings, simulate
from sightline.web.draw_server import DrawServer
from sightline.web.workbench import Workbench

SCENE = """\
[camera]
name = "dock"
latitude_deg = {latitude_deg}
longitude_deg = {longitude_deg}
image_size_px = [1280, 720]
compensate_rotation = false

[[recordings]]
name = "01"
video = "01.mp4"
start_utc = 2024-06-01T10:00:00Z
fixes = "target.gpx"
{more}"""

Box = tuple[float, float, float, float]


def harbour(folder: Path, *, duration_s: float = 40.0, rate_hz: float = 10.0) -> Path:
    """A simulated harbour with a video and a log, and the folder that has its truth."""
    settings = SimulationSettings(seed=5, recordings=1, duration_s=duration_s, rate_hz=rate_hz)
    simulate(folder, settings)
    return folder


def undrawn(made: Path, folder: Path, more: str = "") -> Path:
    """A scene of the harbour in which nobody has drawn yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("01.mp4", "target.gpx"):
        (folder / name).symlink_to(made / name)
    path = folder / "scene.toml"
    text = SCENE.format(latitude_deg=54.3233, longitude_deg=10.1394, more=more)
    path.write_text(text, encoding="utf-8")
    return path


def truth(made: Path) -> dict[int, Box]:
    """Boxes of the boat that is logged, by their frames: the simulation's own."""
    with (made / "truth-boxes" / "01.csv").open(encoding="utf-8") as file:
        return {
            int(row["frame"]): tuple(float(row[name]) for name in ("x1", "y1", "x2", "y2"))
            for row in csv.DictReader(file)
            if row["track_id"] == "1"
        }


@contextmanager
def served(scene: Path, *, annotator: str = "ada", **options) -> Iterator[DrawServer]:
    """The page of a scene's only recording."""
    drawing = Drawing(scene, annotator=annotator)
    server = DrawServer("127.0.0.1:0")
    try:
        server.serve(Workbench(scene, drawing, **options))
        yield server
    finally:
        server.close()
        drawing.close()


class Hand:
    """Draws in a page, as somebody with a mouse, or with keys alone, would."""

    def __init__(self, page: Browser) -> None:
        self.page = page

    def stage(self, x: float, y: float) -> tuple[float, float]:
        """Where on the screen a pixel of the picture is."""
        place = self.page.evaluate(
            "(() => { const bounds = document.getElementById('stage').getBoundingClientRect(),"
            f" at = sightline.stage.toCss([{x}, {y}]);"
            " return [bounds.x + at[0], bounds.y + at[1]]; })()"
        )
        return place[0], place[1]

    def box(self) -> Box | None:
        found = self.page.evaluate("sightline.stage.box")
        return None if found is None else tuple(found)

    def status(self) -> str:
        return self.page.evaluate("document.getElementById('status').textContent")

    def press_button(self, name: str) -> None:
        """Click a button where it is."""
        x, y = self.page.evaluate(
            f"(() => {{ const one = document.getElementById({name!r});"
            " one.scrollIntoView({block: 'nearest'}); const b = one.getBoundingClientRect();"
            " return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        self.page.click(x, y)

    def go_to(self, frame: int) -> None:
        """By the key and the number."""
        self.page.press("g")
        self.page.type(str(frame))
        self.page.press("Enter")
        self.page.until(f"sightline.state.frame === {frame} && sightline.state.shown")

    def drag_box(self, box: Box) -> None:
        """With the mouse, zoomed in until a pixel of the picture is some of the screen."""
        x1, y1, x2, y2 = box
        self.page.press("0")
        middle = self.stage(0.5 * (x1 + x2), 0.5 * (y1 + y2))
        for _ in range(30):
            scale = self.page.evaluate("sightline.stage.scale")
            if scale * (x2 - x1) > 250 or scale > 6:
                break
            self.page.call(
                "Input.dispatchMouseEvent",
                type="mouseWheel",
                x=middle[0],
                y=middle[1],
                deltaX=0,
                deltaY=-100,
            )
            self.page.until(f"sightline.stage.scale > {scale}")
        start, end = self.stage(x1, y1), self.stage(x2, y2)
        self.page.drag(start, (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])), end)

    def key_box(self, box: Box) -> None:
        """With keys alone: a new box, and each of its edges to its place."""
        self.page.press("b")
        for part, index, keys in (
            ("all", 0, ("ArrowLeft", "ArrowRight")),
            ("all", 1, ("ArrowUp", "ArrowDown")),
            ("right", 2, ("ArrowLeft", "ArrowRight")),
            ("lower", 3, ("ArrowUp", "ArrowDown")),
            ("left", 0, ("ArrowLeft", "ArrowRight")),
            ("upper", 1, ("ArrowUp", "ArrowDown")),
        ):
            while self.page.evaluate("sightline.state.part") != part:
                self.page.press("e")
            for step, modifiers in ((10.0, {"ctrl": True}), (1.0, {}), (0.25, {"shift": True})):
                off = box[index] - self.box()[index]
                for _ in range(round(abs(off) / step - (0.0 if step == 0.25 else 0.499))):
                    self.page.press(keys[int(off > 0)], **modifiers)

    def accept(self) -> None:
        """Enter, and wait until the box is in the table."""
        frame = self.page.evaluate("sightline.state.frame")
        self.page.press("Enter")
        self.page.until(
            "!sightline.state.busy && sightline.state.boxes.some("
            f"one => one.frame === {frame} && one.accepted)"
        )
        self.page.until("sightline.state.shown")


def small_scene(folder: Path) -> Path:
    """Six pictures of 64 x 48 px, a second apart, and a log beside them."""
    (folder / "frames").mkdir()
    noise = np.random.default_rng(0)
    for frame in range(6):
        rough = noise.integers(0, 255, (6, 8, 3), dtype=np.uint8)
        picture = Image.fromarray(rough).resize((64, 48), Image.Resampling.BICUBIC)
        picture.save(folder / "frames" / f"{frame:06d}.png")
    times = [f"2024-06-01T10:00:{second:02d}Z" for second in range(6)]
    clock = ["frame,utc", *(f"{frame},{time}" for frame, time in enumerate(times))]
    (folder / "clock.csv").write_text("\n".join(clock), encoding="utf-8")
    log = ["time_utc,latitude_deg,longitude_deg"]
    log += [f"{time},{54.3243 + 1e-5 * i:.6f},10.1394" for i, time in enumerate(times)]
    (folder / "log.csv").write_text("\n".join(log), encoding="utf-8")
    path = folder / "scene.toml"
    lines = ["[camera]", "latitude_deg = 54.3233", "longitude_deg = 10.1394", "[[recordings]]"]
    lines += ['name = "01"', 'frames = "frames"', 'clock = "clock.csv"', 'fixes = "log.csv"']
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
