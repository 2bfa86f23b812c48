"""Watch a synthetic harbour live: boats with and without AIS move on a map in the browser.

    python examples/live_demo.py [DIR] [--seconds 600] [--serve 127.0.0.1:8080]

Everything is made here: a harbour, a camera that is fitted to boxes and a log of two recordings of
it, and a server that streams it as a camera would, with what its boats broadcast by AIS.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import sightline
from sightline.simulation import SimulationSettings, simulate

SEED = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path("sightline-live-demo"))
    parser.add_argument("--seconds", type=float, default=600.0, help="how long it is watched")
    parser.add_argument("--serve", default="127.0.0.1:8080", help="where the page is")
    parser.add_argument("--pictures", default="127.0.0.1:8090", help="where the camera is")
    parser.add_argument("--ais", default="127.0.0.1:10110", help="where AIS is")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)

    # No picture is needed to learn the camera: boxes that somebody drew, and a log.
    settings = SimulationSettings(seed=SEED, recordings=2, duration_s=90.0, video=False)
    made = simulate(given.folder / "harbour", settings)
    model = sightline.fit(sightline.Scene.load(made.scene), model="camera")
    model.save(given.folder / "model.safetensors")

    today, pictures = given.folder / "today", f"http://{given.pictures}/"
    options = f"--no-video --overwrite --seed {SEED} --recordings 1 --rate 10".split()
    options += ["--duration", str(given.seconds), "--serve", pictures]
    camera = start("simulate", "-o", str(today), *options, "--serve-ais", f"tcp://{given.ais}")
    watching = None
    try:
        wait_for(pictures)
        options = ["--model", str(given.folder / "model.safetensors"), "--name", "demo"]
        options += ["--store", str(given.folder / "tracks.db"), "--serve", given.serve]
        watching = start("live", pictures, *options, "--ais", f"tcp://{given.ais}")
        wait_for(f"http://{given.serve}/api/moment")
        print(f"open http://{given.serve}/ in a browser; Ctrl-C ends it", flush=True)
        camera.wait()
    except KeyboardInterrupt:
        pass
    finally:
        for one in (watching, camera):
            if one is not None and one.poll() is None:
                one.terminate()
                one.wait(10.0)


def start(*command: str) -> subprocess.Popen[bytes]:
    """Start a command of sightline."""
    return subprocess.Popen([sys.executable, "-m", "sightline", *command])  # noqa: S603


def wait_for(address: str) -> None:
    """Return as soon as somebody answers at an address, or after half a minute."""
    for _ in range(300):
        try:
            with urllib.request.urlopen(address, timeout=1.0):  # noqa: S310
                return
        except OSError:
            time.sleep(0.1)
    sys.exit(f"nobody answers at {address}")


if __name__ == "__main__":
    main()
