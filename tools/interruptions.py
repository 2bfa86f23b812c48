"""Ends commands at many moments, with Ctrl-C and with kill -9, and looks at what they leave.

Each command is run once to its end, and then ended at moments spread over that time. After each,
what lies under the names of its results is to be whole, nothing else may have changed, and what is
said is at most one line. At last the same command is run again: it is to give what the first did,
and to have removed whatever the ones that were killed had left.

    .venv/bin/python tools/interruptions.py --moments 20
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import av
import pandas as pd
from safetensors import safe_open

COMMANDS: dict[str, tuple[str, ...]] = {
    "run": ("run", "scene.toml", "--model", "qkr", "-o", "results"),
    "track": (
        *("track", "01.mp4", "--model", "camera.safetensors", "--detector", "motion"),
        *("-o", "t.csv", "t.geojson", "t.gpx", "t.kml", "--json", "t.json"),
    ),
    "detect": ("detect", "01.mp4", "--detector", "motion", "-o", "b.csv", "--json", "b.json"),
    "fit": ("fit", "scene.toml", "-o", "m.safetensors", "--json", "m.json"),
    "show": (
        *("show", "01.mp4", "--model", "camera.safetensors", "--tracks", "kept.csv"),
        *("-o", "s.mp4", "--json", "s.json"),
    ),
    "count": ("count", "kept.csv", "--zones", "zones.geojson", "-o", "c.csv", "--json", "c.json"),
    "export": ("export", "kept.db", "-o", "e.csv", "-o", "e.geojson", "--json", "e.json"),
    "live": (
        *("live", "01.mp4", "--as-live", "--speed", "4", "--model", "camera.safetensors"),
        *("--detector", "motion", "--store", "l.db", "--log", "l.log"),
    ),
}
RESULTS = {
    "run": ("results",),
    "track": ("t.csv", "t.geojson", "t.gpx", "t.kml", "t.json"),
    "detect": ("b.csv", "b.json"),
    "fit": ("m.safetensors", "m.json"),
    "show": ("s.mp4", "s.json"),
    "count": ("c.csv", "c.json"),
    "export": ("e.csv", "e.geojson", "e.json"),
    # SQLite keeps what is not in the store yet beside it; who writes it holds a lock.
    "live": ("l.db", "l.db-lock", "l.db-wal", "l.db-shm", "l.log"),
}
SIGNALS = {"Ctrl-C": signal.SIGINT, "kill -9": signal.SIGKILL}

# Ends of files that are whole; tables are compared with those of the first run.
_LAST = {".gpx": "</gpx>\n", ".kml": "</kml>\n", ".html": "</html>", ".geojson": "]}\n"}
# Of a run: times of its making stand in them.
_MADE_ANEW = ("report.html", "map.png", *RESULTS["live"])
_ZONE = [[10.12, 54.30], [10.16, 54.30], [10.16, 54.34], [10.12, 54.34], [10.12, 54.30]]


@dataclass
class Ended:
    """How often commands ended in which way, and what was wrong."""

    ways: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


def make_data(folder: Path) -> None:
    """A small harbour with one video, and a model of its camera."""
    from sightline import Scene, fit
    from sightline.simulation import simulate
    from sightline.simulation.simulate import SimulationSettings

    settings = SimulationSettings(
        seed=3, recordings=2, duration_s=8.0, rate_hz=8.0, image_size_px=(640, 360)
    )
    made = simulate(folder, settings)
    fit(Scene.load(made.scene), "camera").save(folder / "camera.safetensors")
    zone = {"type": "Polygon", "coordinates": [_ZONE]}
    feature = {"type": "Feature", "properties": {"name": "harbour"}, "geometry": zone}
    text = json.dumps({"type": "FeatureCollection", "features": [feature]})
    (folder / "zones.geojson").write_text(text, encoding="utf-8")
    track, live = COMMANDS["track"], COMMANDS["live"]
    for arguments in (
        (*track[: track.index("-o")], "-o", "kept.csv"),
        (*live[: live.index("--store")], "--store", "kept.db"),
    ):
        process = start(arguments, folder)
        _, said = process.communicate(timeout=600)
        if process.returncode:
            raise RuntimeError(said)


def start(arguments: tuple[str, ...], folder: Path) -> subprocess.Popen[str]:
    """A command in a process of its own, which hears Ctrl-C even if this one does not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            [sys.executable, "-m", "sightline", *arguments],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        signal.signal(signal.SIGINT, before)


def content(folder: Path) -> dict[str, bytes]:
    """All files of a folder, hidden ones too."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def is_whole(path: Path, first: bytes | None) -> bool:
    """Whether a file could be read to its end: it is as the first run's, or well-formed."""
    data = path.read_bytes()
    if data == first:
        return True
    try:
        if path.suffix in (".json", ".geojson"):
            json.loads(data)
        elif path.suffix == ".csv":
            # A row that was cut has fewer cells, and a number that was cut no line after it.
            name = {"b.csv": "frame", "c.csv": "kind"}.get(path.name, "time_utc")
            return data.endswith(b"\n") and not pd.read_csv(path)[name].isna().any()
        elif path.suffix == ".log":
            return all(map(json.loads, data.decode().splitlines()))
        elif path.suffix == ".mp4":
            with av.open(path) as video:
                return sum(1 for _ in video.decode(video=0)) > 0
        elif path.suffix == ".db":
            with closing(sqlite3.connect(path)) as store:
                return store.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        elif path.suffix in (".db-lock", ".db-wal", ".db-shm"):
            return True
        elif path.suffix == ".safetensors":
            with safe_open(path, "numpy") as file:
                for name in file.keys():  # noqa: SIM118 - it is no mapping
                    file.get_tensor(name)
        elif path.suffix == ".png":
            return data.endswith(b"IEND\xaeB`\x82")
        return (
            data.decode(errors="replace")
            .rstrip("\n")
            .endswith(_LAST.get(path.suffix, "").rstrip("\n"))
        )
    except (ValueError, KeyError, OSError, sqlite3.Error):
        return False


def check_folder(
    name: str, folder: Path, inputs: dict[str, bytes], first: dict[str, bytes]
) -> list[str]:
    """What is wrong with a folder in which a command was ended."""
    wrong = []
    for file, data in content(folder).items():
        if any(part.startswith(".") and part.endswith(".unfinished") for part in Path(file).parts):
            continue
        if file in inputs:
            wrong += [f"{file} was changed"] if data != inputs[file] else []
        elif Path(file).parts[0] not in RESULTS[name]:
            wrong.append(f"{file} is left")
        elif not is_whole(folder / file, first.get(file)):
            wrong.append(f"{file} is half")
    wrong += [f"{file} is gone" for file in inputs if not (folder / file).exists()]
    return wrong


def end_at(
    name: str,
    sent: signal.Signals,
    folder: Path,
    ready: Callable[[subprocess.Popen[str]], None],
) -> tuple[int, str]:
    """Status of a command that got a signal, and what it said on standard error.

    Args:
        name: Of the command.
        sent: The signal.
        folder: Where it runs.
        ready: Waits for the moment.
    """
    process = start(COMMANDS[name], folder)
    ready(process)
    process.send_signal(sent)
    _, said = process.communicate(timeout=300)
    return process.returncode, said


def wrong_end(status: int, said: str, sent: signal.Signals) -> str:
    """What is wrong with the way in which a command ended; empty where nothing is."""
    if "Traceback" in said and "sightline/cli" in said:
        return f"a traceback: {said[-200:]}"
    if len(said.splitlines()) > 1 and "Traceback" not in said:
        return f"more than a line: {said}"
    usual = (0, -9) if sent == signal.SIGKILL else (0, 130, -2, 1)
    return "" if status in usual else f"status {status}: {said[-200:]}"


def way(status: int, said: str) -> str:
    """The way in which a command ended, in a word or two."""
    if "Traceback" in said:
        return "before it began"
    if said.startswith("stopped:"):
        return "wrote what there was"
    return {0: "had ended", 130: "stopped", -9: "killed", -2: "before it began"}.get(status, "?")


def try_command(name: str, data: Path, moments: int, seed: int) -> dict[str, Ended]:
    """End a command at moments that are spread over its time, in each way."""
    rng = random.Random(f"{name} {seed}")  # noqa: S311
    out = {}
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "work"
        shutil.copytree(data, folder)
        inputs = content(folder)
        begun = time.monotonic()
        process = start(COMMANDS[name], folder)
        _, said = process.communicate(timeout=600)
        took_s = time.monotonic() - begun
        if process.returncode:
            raise RuntimeError(f"{name}: {said}")
        first = content(folder)
        for label, sent in SIGNALS.items():
            ended = out[label] = Ended()
            for k in range(moments):
                for result in RESULTS[name]:
                    shutil.rmtree(folder / result, ignore_errors=True)
                    (folder / result).unlink(missing_ok=True)
                moment_s = took_s * (k + rng.random()) / moments
                status, said = end_at(name, sent, folder, lambda _: time.sleep(moment_s))  # noqa: B023
                ended.ways[way(status, said)] += 1
                wrong = check_folder(name, folder, inputs, first)
                wrong += [what for what in [wrong_end(status, said, sent)] if what]
                ended.wrong += [f"{name}, {label} after {moment_s:.2f} s: {what}" for what in wrong]
            process = start(COMMANDS[name], folder)
            _, said = process.communicate(timeout=600)
            again = content(folder)
            same = {file for file in first if not file.endswith(_MADE_ANEW)}
            kept = {file for file in {*again} ^ {*first} if not file.endswith(_MADE_ANEW)}
            if process.returncode or kept:
                ended.wrong.append(f"{name} again: {process.returncode} {said} {sorted(again)}")
            elif any(again[file] != first[file] for file in same):
                ended.wrong.append(f"{name} again: gives something else")
    return out


def main() -> None:
    """Try all commands, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("commands", nargs="*", default=list(COMMANDS))
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as parent:
        data = Path(parent) / "data"
        make_data(data)
        print("| command | ended by | moments | how it ended | wrong |\n|---|---|---|---|---|")
        for name in options.commands:
            for label, ended in try_command(name, data, options.moments, options.seed).items():
                ways = ", ".join(f"{count} {what}" for what, count in sorted(ended.ways.items()))
                print(
                    f"| {name} | {label} | {options.moments} | {ways} | {len(ended.wrong)} |",
                    flush=True,
                )
                wrong += ended.wrong
    print(*wrong, sep="\n")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
