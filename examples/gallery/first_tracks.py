"""What the workbench shows of a harbour: the tutorial's pictures, of frames of its video."""

import sys
import tempfile
from pathlib import Path

import cv2
import matplotlib.image
import numpy as np
from matplotlib.figure import Figure

import sightline
from sightline.formats import read_boxes
from sightline.labelling.fit_view import FitView
from sightline.overlay import Found, Overlay, OverlaySettings
from sightline.pipeline.fit_unlabelled import weigh_scene
from sightline.simulation import SimulationSettings, simulate
from sightline.types import Frame
from sightline.video.random_access import FramePictures

SEED, FRAME = 5, 162
BOX, LOG = (240, 176, 79), (255, 255, 255)


def save(folder: Path, name: str, image_rgb: np.ndarray) -> None:
    """As JPEG, small enough for a page."""
    coded = cv2.imencode(
        ".jpg", np.ascontiguousarray(image_rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 82]
    )[1]
    (folder / f"first-tracks-{name}.jpg").write_bytes(coded.tobytes())


def boxed(image_rgb: np.ndarray, box: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    x1, y1, x2, y2 = np.round(box).astype(int).tolist()
    return cv2.rectangle(image_rgb.copy(), (x1, y1), (x2, y2), colour, 1)


def around(image_rgb: np.ndarray, box: np.ndarray, height_px: int, size: tuple[int, int]):
    """The part around a box, so many pixels high, enlarged."""
    wide = round(height_px * size[0] / size[1])
    left = int(np.clip(0.5 * (box[0] + box[2]) - wide / 2, 0, image_rgb.shape[1] - wide))
    top = int(np.clip(0.5 * (box[1] + box[3]) - height_px / 2, 0, image_rgb.shape[0] - height_px))
    part = image_rgb[top : top + height_px, left : left + wide]
    return cv2.resize(part, size, interpolation=cv2.INTER_CUBIC), (left, top, size[0] / wide)


def main(folder: Path, duration_s: float = 40.0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as made:
        settings = SimulationSettings(seed=SEED, recordings=1, duration_s=duration_s, rate_hz=10.0)
        path = simulate(made, settings).scene
        boxes = read_boxes(path.parent / "boxes" / "01.csv")
        pictures = FramePictures(path.parent / "01.mp4")

        def rgb(frame: int) -> np.ndarray:
            return pictures.read(frame)[..., ::-1]

        # Nobody has drawn yet: what would recognition choose from?
        text = path.read_text(encoding="utf-8")
        undrawn = path.with_name("mine.toml")
        undrawn.write_text(text.replace('boxes = "boxes/01.csv"\n', ""), encoding="utf-8")
        candidates = weigh_scene(sightline.Scene.load(undrawn))[:2]
        rows = []
        for one in candidates:
            odds = one.probability / (1.0 - one.probability)
            print(f"{one.vessel}: odds {odds:.2g} : 1, clock {one.clock_offset_s:.1f} s ahead")
            shots = []
            for i in np.linspace(0, len(one.boxes) - 1, 5)[1:-1].round().astype(int):
                box = one.boxes.xyxy_px[i]
                drawn = boxed(rgb(int(one.boxes.frame[i])), box, BOX)
                part, (left, top, scale) = around(drawn, box, 96, (300, 169))
                x, y = ((one.place_px[i] - (left, top)) * scale).round().astype(int).tolist()
                cv2.drawMarker(part, (x, y), LOG, cv2.MARKER_CROSS, 16, 2)
                shots.append(part)
            rows.append(np.hstack(shots))
        save(folder, "whose", np.vstack(rows))

        # A box is drawn, and its lower edge mended in the magnifier.
        row = int(np.flatnonzero(boxes.frame >= min(FRAME, boxes.frame.max()))[0])
        frame, box = int(boxes.frame[row]), boxes.xyxy_px[row]
        picture = boxed(rgb(frame), box, BOX)
        near, _ = around(picture, box, 360, (900, 506))
        shown = near.copy()
        lower = np.array([box[0], box[3], box[2], box[3]])
        part, _ = around(picture, lower, 30, (300, 169))
        shown[8:177, 592:892] = part
        cv2.rectangle(shown, (592, 8), (892, 177), LOG, 1)
        save(folder, "box", shown)

        # The fit to the boxes, held against the picture and laid onto the map.
        scene = sightline.Scene.load(path)
        model = sightline.fit(scene, model="camera")
        view = FitView(scene["01"], model)
        time_utc_s = float(scene["01"].clock().time_utc_s([frame])[0]) - view.clock_offset_s
        overlay = Overlay(
            model,
            Found(fixes=scene["01"].fixes()),
            OverlaySettings(trail_s=0.0, rings=True, inset=False),
        )
        drawn = overlay.drawn(Frame(frame, time_utc_s, pictures.read(frame)))[..., ::-1]
        save(folder, "fit", around(drawn, box, 360, (900, 506))[0])
        rectifier = view.rectifier(time_utc_s)
        on_map = rectifier.rectified(pictures.read(frame))
        log = scene["01"].fixes()
        pictures.close()
    print(f"{model.report.rmse_m:.1f} m RMSE; on the map as far as {rectifier.furthest_m:.0f} m")
    (north, west), _, (south, east), _ = rectifier.corners_deg
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    chart = figure.subplots()
    chart.imshow(
        on_map[..., [2, 1, 0, 3]], extent=(west, east, south, north), interpolation="bilinear"
    )
    chart.plot(log.longitude_deg, log.latitude_deg, color="#d55e00", lw=1.5, label="log")
    chart.plot(*model.plane.to_geographic([0.0], [0.0])[::-1], "^", color="#333333", label="camera")
    chart.set(facecolor="#e9f1f6", xlabel="longitude, °", ylabel="latitude, °")
    chart.ticklabel_format(useOffset=False)
    chart.set_aspect(1.0 / np.cos(np.radians(north)))
    chart.legend(loc="upper left")
    figure.savefig(folder / "first-tracks-map.png", dpi=100)
    image = matplotlib.image.imread(folder / "first-tracks-map.png")[..., :3]
    (folder / "first-tracks-map.png").unlink()
    save(folder, "map", (255.0 * image).round().astype(np.uint8))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
