"""Learn where a camera stands and how it looks, then ask where boxes lie on the earth."""

import sys
from pathlib import Path

import sightline
from sightline.simulation import SimulationSettings, simulate
from sightline.types import ellipses


def main(folder: Path) -> None:
    # A harbour with a known truth; with a recording of your own, write a scene file instead.
    simulated = simulate(folder / "harbour", SimulationSettings(seed=1, video=False, clock="exact"))
    scene = sightline.Scene.load(simulated.scene)

    model = sightline.fit(scene, model="camera+gpr")
    for parameter in model.report.parameters:
        known = "" if parameter.determined else "  (not determined by the data)"
        print(f"{parameter.name:12} {parameter.value:9.2f} ± {parameter.sigma:.2f}{known}")
    for statement in model.report.statements:
        print(statement)

    model.save(folder / "model.safetensors")
    model = sightline.load(folder / "model.safetensors")

    # x1, y1, x2, y2 in pixels: one box near the camera, one further off, one in the sky.
    width, height = scene.image_size_px
    boxes = [
        [0.45 * width, 0.60 * height, 0.55 * width, 0.70 * height],
        [0.48 * width, 0.50 * height, 0.52 * width, 0.54 * height],
        [0.48 * width, 0.05 * height, 0.52 * width, 0.09 * height],
    ]
    where = model.locate(boxes, source="annotator")
    ellipse = ellipses(where.covariance_m2, probability=0.95)
    for i in range(len(where)):
        if not where.known[i]:
            print("no position: the box lies at or above the horizon, or too near to it")
            continue
        print(
            f"{where.latitude_deg[i]:.6f} {where.longitude_deg[i]:.6f}, "
            f"{where.range_m[i]:.0f} m away, with 95 % within an ellipse of "
            f"{ellipse.semi_major_m[i]:.1f} x {ellipse.semi_minor_m[i]:.1f} m"
            + (", extrapolated" if where.extrapolated[i] else "")
        )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
