"""An archive on processes of this machine and on two Ray nodes, of which one is killed.

    python benchmarks/archive.py --recordings 200

Simulates short recordings, tracks them with the local engine on one process and on all processors,
then on a cluster of two nodes on this machine, while a worker and later a node are killed; compares
the tracks row by row, and counts that each recording is there once. Then tasks that do nothing:
what one costs, and the memory of the driver.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import resource
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
from pyarrow import dataset

from sightline import Scene, fit
from sightline.fleet import read_fleet, run_batch
from sightline.fleet.engines import Engine, LocalEngine
from sightline.simulation.simulate import SimulationSettings, simulate

MODEL_RECORDINGS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--duration", type=float, default=20.0, help="of each, seconds")
    parser.add_argument("--empty", type=int, nargs="*", default=[200, 2000, 20000])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fleet = make(folder, options.recordings, options.duration)
        processors = len(os.sched_getaffinity(0))
        times = {}
        for workers in sorted({1, processors}):
            times[workers] = timed(fleet, folder / f"local-{workers}", LocalEngine(workers))
            print(f"local, {workers} processes: {times[workers]:.1f} s", flush=True)
        share = times[1] / (times[processors] * processors)
        print(f"  {share:.0%} of linear in processes")
        if importlib.util.find_spec("ray") is None:
            print("Ray is not installed: pip install 'sightline[ray]'")
        else:
            on_ray(fleet, folder, f"local-{processors}")
    for count in options.empty:
        empty(count)


def make(folder: Path, recordings: int, duration_s: float) -> Path:
    """A fleet file of two cameras that share a model."""
    made = simulate(
        folder / "harbour",
        SimulationSettings(video=False, recordings=recordings, duration_s=duration_s, seed=1),
    )
    scene = Scene.load(made.scene)
    names = [recording.name for recording in scene.recordings]
    fit(scene.select(names[:MODEL_RECORDINGS])).save(folder / "model.safetensors")
    text = ""
    for camera, part in (("one", names[::2]), ("two", names[1::2])):
        rows = "".join(
            f'  {{ source = "harbour/detections/{n}.csv", clock = "harbour/clock/{n}.csv", '
            'log = "harbour/target.gpx" },\n'
            for n in part
        )
        text += f'[[cameras]]\nname = "{camera}"\nmodel = "model.safetensors"\n'
        text += f"recordings = [\n{rows}]\n"
    path = folder / "fleet.toml"
    path.write_text(text)
    return path


def timed(fleet: Path, output: Path, engine: Engine) -> float:
    known = read_fleet(fleet)
    begin = time.monotonic()
    result = run_batch(known, output, lambda: engine, retries=5)
    assert not result.failed, result.failed
    return time.monotonic() - begin


def rows(output: Path) -> pd.DataFrame:
    table = dataset.dataset(output / "tracks", partitioning="hive").to_table().to_pandas()
    names = dataset.dataset(output / "tracks").files
    assert len(names) == len({tuple(Path(one).parts[-3:]) for one in names})
    return table.sort_values(["camera", "time_utc", "track_id", "latitude_deg"], ignore_index=True)


def on_ray(fleet: Path, folder: Path, beside: str) -> None:
    from ray.cluster_utils import Cluster

    from sightline.fleet.ray_engine import RayEngine

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    engine = RayEngine(cluster.address)
    killer = threading.Thread(target=kill, args=(cluster, second, folder / "ray"), daemon=True)
    killer.start()
    taken_s = timed(fleet, folder / "ray", engine)
    cluster.shutdown()
    same = rows(folder / "ray").equals(rows(folder / beside))
    count = len(list((folder / "ray" / "finished").rglob("*.json")))
    print(f"Ray, two nodes of one processor, a worker and a node killed: {taken_s:.1f} s")
    print(f"  {count} recordings finished; tracks equal to the local engine's: {same}")


def kill(cluster: object, node: object, output: Path) -> None:
    """Kill a process that tracks once some are finished, and a node later."""
    finished = output / "finished"
    wait_for(finished, 10)
    for pid in workers():
        os.kill(pid, signal.SIGKILL)
        print(f"  worker {pid} killed", flush=True)
        break
    wait_for(finished, 30)
    cluster.remove_node(node, allow_graceful=False)  # type: ignore[attr-defined]
    print("  a node killed", flush=True)


def wait_for(folder: Path, count: int) -> None:
    while len(list(folder.rglob("*.json"))) < count:
        time.sleep(0.1)


def workers() -> Iterator[int]:
    """Processes of Ray that are at work on a task."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if path.read_bytes().startswith(b"ray::attempt"):
                yield int(path.parent.name)
        except OSError:
            continue


def nothing(number: int) -> int:
    return number


def empty(count: int) -> None:
    engine = LocalEngine()
    begin = time.monotonic()
    done = sum(1 for _ in engine.map(nothing, range(count)))
    taken_s = time.monotonic() - begin
    assert done == count
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(
        f"{count} tasks that do nothing: {1000.0 * taken_s / count:.2f} ms each, "
        f"driver at most {memory:.0f} MB"
    )


if __name__ == "__main__":
    main()
