"""How far tracks are from a log that they never saw."""

import sys
from pathlib import Path

import sightline
from sightline.simulation import SimulationSettings, simulate


def main(folder: Path) -> None:
    simulated = simulate(
        folder / "harbour", SimulationSettings(seed=1, duration_s=30.0, video=False, clock="exact")
    )
    scene = sightline.Scene.load(simulated.scene)

    # What a model is scored on, it must not have learned from.
    model = sightline.fit(scene.without(["03"]))
    tracks = sightline.track(scene["03"].detections(), model)

    report = sightline.evaluate(tracks, fixes=folder / "harbour" / "target.gpx")
    print(f"{report.ape.n} points compared, {report.ape.rmse:.2f} m RMSE")
    print(f"{100 * report.ape.per_range:.1f} % of the range")
    print(f"{100 * report.coverage.p95:.0f} % of the 95 % ellipses hold the log's position")
    report.write(folder / "report.json")
    print(f"written: {folder / 'report.json'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
