"""From a table of boxes to smooth tracks in files that maps and tables understand."""

import sys
from pathlib import Path

import sightline
from sightline.simulation import SimulationSettings, simulate


def main(folder: Path) -> None:
    simulated = simulate(
        folder / "harbour",
        SimulationSettings(seed=1, recordings=2, duration_s=30.0, video=False, clock="exact"),
    )
    scene = sightline.Scene.load(simulated.scene)
    model = sightline.fit(scene)

    # Boxes of all boats, as a detector saw them. A video is given in the same way:
    # sightline.track("harbour.mp4", model).
    tracks = sightline.track(scene["02"].detections(), model)
    for track in tracks:
        seconds = track.time_utc_s[-1] - track.time_utc_s[0]
        print(
            f"track {track.track_id}: {track.label or 'unnamed'}, {len(track)} points in "
            f"{seconds:.0f} s, {track.speed_mps.mean():.1f} m/s"
        )

    # The ending picks the format.
    for name in ("tracks.geojson", "tracks.gpx", "tracks.kml", "tracks.csv"):
        tracks.write(folder / name)
        print(f"written: {folder / name}")

    table = tracks.to_dataframe()
    print(table.groupby("track_id")["speed_mps"].describe().round(2).to_string())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
