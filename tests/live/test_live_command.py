from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from cameras import HttpCamera, free_port, http_camera

from sightline import Scene, fit
from sightline.cli import main
from sightline.live.config import read_live_config
from sightline.live.journal import Journal
from sightline.live.store import stored_tracks
from sightline.simulation.simulate import SimulationSettings, simulate

SIZE_PX = (640, 360)
START_UTC_S = 1_700_000_000.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fitted camera, and pictures of a dark boat that crosses a grey sea in four seconds."""
    made = tmp_path_factory.mktemp("live")
    settings = SimulationSettings(
        video=False, recordings=2, duration_s=20.0, seed=1, image_size_px=SIZE_PX
    )
    scene = simulate(made / "harbour", settings).scene
    fit(Scene.load(scene), "camera").save(made / "model.safetensors")
    (made / "frames").mkdir()
    rows = ["frame,utc"]
    sea = np.random.default_rng(0).integers(150, 160, (360, 640, 3), dtype=np.uint8)
    for index in range(60):
        image = sea.copy()
        left = 100 + 6 * index
        image[235:255, left : left + 50] = 20
        image[225:235, left + 20 : left + 32] = 20
        cv2.imwrite(str(made / "frames" / f"{index:03d}.png"), image)
        rows.append(f"{index},{START_UTC_S + 0.1 * index}")
    (made / "clock.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (made / "mask-small.png").write_bytes(
        cv2.imencode(".png", np.full((10, 10), 255, dtype=np.uint8))[1].tobytes()
    )
    (made / "password").write_text("operator:secret\n", encoding="utf-8")
    return made


class Live:
    """The command in a process of its own."""

    def __init__(
        self,
        *arguments: object,
        environment: dict[str, str] | None = None,
        new_session: bool = False,
    ) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sightline", "live", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **(environment or {})},
            start_new_session=new_session,
            # Where these tests run under nohup, it would be ignored in what they start as well.
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
        )

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        self.process.send_signal(number)
        return self.wait()

    def wait(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err


@pytest.fixture
def camera() -> Iterator[HttpCamera]:
    with http_camera("secret") as made:
        made.size_px = SIZE_PX
        yield made


def until(condition: Callable[[], bool], most_s: float = 40.0) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s, "it did not come to that"
        time.sleep(0.05)


@pytest.mark.slow
def test_a_recording_is_played_kept_and_exported(folder: Path, tmp_path: Path) -> None:
    store = tmp_path / "quay.db"
    options = ["--as-live", "--clock", folder / "clock.csv", "--speed", 2, "--detector", "motion"]
    live = Live(
        folder / "frames", "--model", folder / "model.safetensors", "--store", store, *options
    )
    status, out, err = live.wait()
    assert status == 0, err
    assert "Traceback" not in err
    assert "frames" in out
    tracks = list(stored_tracks(store))
    assert tracks[0].track_id == 1
    # How many frames were left out is the machine's affair.
    longest = max(tracks, key=len)
    assert START_UTC_S < longest.time_utc_s[0] < longest.time_utc_s[-1] < START_UTC_S + 6.0
    assert len(longest) > 5
    highest = max(track.track_id for track in tracks)
    again = Live(
        folder / "frames", "--model", folder / "model.safetensors", "--store", store, *options
    )
    assert again.wait()[0] == 0
    assert max(track.track_id for track in stored_tracks(store)) > highest


@pytest.mark.slow
def test_a_camera_is_watched_until_somebody_ends_it(
    folder: Path, tmp_path: Path, camera: HttpCamera
) -> None:
    address = f"http://127.0.0.1:{camera.port}/video"
    log, config = tmp_path / "log.jsonl", tmp_path / "live.toml"
    config.write_text(
        f'camera = "quay"\nmodel = "{folder / "model.safetensors"}"\n'
        f'[source]\naddress = "{address}"\ncredentials = "{folder / "password"}"\n'
        'silent_s = 1.0\nlongest_wait_s = 0.5\n[detector]\nname = "motion"\n'
        f'[store]\nfile = "quay.db"\n[log]\nfile = "log.jsonl"\n',
        encoding="utf-8",
    )
    live = Live("--config", config)

    def events() -> list[str]:
        lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
        return [json.loads(line)["event"] for line in lines]

    until(lambda: "connected" in events())
    camera.kill()
    until(lambda: "lost" in events())
    camera.start()
    until(lambda: "resumed" in events())
    begun_s = time.monotonic()
    status, out, err = live.end()
    # Three seconds are promised; an overloaded machine is given more.
    assert time.monotonic() - begun_s < 10.0
    assert status == 0, err
    assert "1 reconnections" in out
    said = out + err + log.read_text(encoding="utf-8")
    assert "secret" not in said
    assert b"secret" not in (tmp_path / "quay.db").read_bytes()
    assert "lost" in err
    assert "Traceback" not in err


@pytest.mark.slow
def test_credentials_may_come_from_the_environment(folder: Path, camera: HttpCamera) -> None:
    address = f"http://127.0.0.1:{camera.port}/video"
    arguments = (address, "--model", folder / "model.safetensors", "--check")
    told = {"SIGHTLINE_CREDENTIALS": "operator:secret"}
    status, out, err = Live(*arguments, environment=told).wait()
    assert status == 0, err
    assert "all is well" in out
    assert "640 x 360 px" in out
    status, out, err = Live(*arguments).wait()
    assert status == 2
    assert "401" in err


BAD_TABLES = [
    ("speed = 3", "unknown key speed; known are camera, model"),
    ("[source]\nrate = 3", "unknown key source.rate; known are address"),
    ("[source]\nsilent_s = -1", "source.silent_s"),
    ('[source]\nclock = "sun"', "source.clock"),
    ("[store]\nretention_days = 0", "store.retention_days"),
    ("camera = 3", "camera"),
    ("= 3", "is no TOML"),
    ('[feeds]\nnmea = ["harbour"]', "is no address"),
    ("[boundaries]\nspeed_mps = 0", "boundaries.speed_mps"),
    ('[boundaries]\nlines = "none.geojson"', "none.geojson"),
    ('[server]\naddress = "8080"', "expected HOST:PORT"),
]


@pytest.mark.parametrize(("text", "why"), BAD_TABLES, ids=[text for text, _ in BAD_TABLES])
def test_a_configuration_that_is_wrong_is_refused(
    text: str, why: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "live.toml"
    config.write_text(text + "\n", encoding="utf-8")
    model = str(folder / "model.safetensors")
    with pytest.raises(SystemExit) as stopped:
        main(["live", "rtsp://127.0.0.1:1/x", "--model", model, "--config", str(config)])
    err = capsys.readouterr().err
    assert stopped.value.code == 2
    assert why in err, err
    assert err.count("\n") == 1


def test_bad_input_is_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = ["--model", str(folder / "model.safetensors")]
    camera = "rtsp://operator:secret@127.0.0.1:1/x"
    frames = str(folder / "frames")
    (tmp_path / "notes.db").write_text("these are notes\n" * 20, encoding="utf-8")
    cases: list[tuple[list[str], str]] = [
        ([], "no source"),
        ([camera], "no model"),
        ([camera, "--model", str(tmp_path / "none")], "no such model file"),
        ([camera, "--model", str(folder / "clock.csv")], "clock.csv"),
        ([camera, *model, "--config", str(tmp_path / "no.toml")], "no such configuration"),
        ([camera, *model, "--serve", "8080"], "expected HOST:PORT"),
        ([camera, *model, "--detector", "nobody"], "nobody"),
        ([camera, *model, "--mask", str(folder / "mask-small.png")], "10 x 10 px"),
        ([camera, *model, "--credentials", str(tmp_path / "none")], "cannot be read"),
        ([camera, *model, "--store", str(tmp_path / "notes.db")], "is no store"),
        ([camera, *model, "--clips", str(tmp_path / "notes.db")], "clips cannot be kept there"),
        ([camera, *model, "--log", str(tmp_path / "a" / "b")], "cannot be written"),
        (
            [camera, *model, "--serve", "127.0.0.1:0", "--basemap", str(folder / "clock.csv")],
            "is no map of tiles",
        ),
        ([camera, *model], "refused"),
        (["gopher://host/x", *model], "is no address of a camera"),
        ([frames, *model], "is no address of a camera"),
        ([str(tmp_path / "none"), *model, "--as-live"], "no such video"),
        ([frames, *model, "--as-live", "--start-utc", "noon"], "is no time"),
        ([f"http://127.0.0.1:{free_port()}/x", *model, "--check"], "refused"),
    ]
    for arguments, why in cases:
        with pytest.raises(SystemExit) as stopped:
            main(["live", *arguments])
        out, err = capsys.readouterr()
        assert stopped.value.code == 2, arguments
        assert why in err, (arguments, err)
        assert err.count("\n") == 1, err
        assert "secret" not in out + err


def test_nothing_that_is_read_is_written_to(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything is opened: a store or a log would be added to a source."""
    own = tmp_path / "own"
    shutil.copytree(folder, own)
    for name in ("a.geojson", "secret", "feed.nmea"):
        (own / name).write_text("not to be touched\n", encoding="utf-8")
    (own / "live.toml").write_text("[source]\nspeed = 1.0\n", encoding="utf-8")
    (own / "soft.db").symlink_to(own / "feed.nmea")
    before = {path: path.read_bytes() for path in own.rglob("*") if path.is_file()}
    start = [str(own / "frames"), "--as-live", "--model", str(own / "model.safetensors")]
    read = "is read by this command"
    cases = [
        ("--store", "model.safetensors", [], read),
        ("--log", "model.safetensors", [], read),
        ("--log", "clock.csv", ["--clock", "clock.csv"], read),
        ("--log", "feed.nmea", ["--ais", "feed.nmea"], read),
        ("--store", "soft.db", ["--ais", "feed.nmea"], read),
        ("--log", "live.toml", ["--config", "live.toml"], read),
        ("--store", "a.geojson", ["--shore", "a.geojson"], read),
        ("--log", "a.geojson", ["--basemap", "a.geojson"], read),
        ("--log", "a.geojson", ["--lines", "a.geojson"], read),
        ("--log", "a.geojson", ["--zones", "a.geojson"], read),
        ("--log", "a.geojson", ["--area", "a.geojson"], read),
        ("--log", "mask-small.png", ["--mask", "mask-small.png"], read),
        ("--log", "secret", ["--credentials", "secret"], read),
        ("--log", "secret", ["--token-file", "secret"], read),
        ("--log", "a.onnx", ["--detector", "a.onnx"], read),
        ("--log", "new.db", ["--store", "new.db"], "is given for two results"),
        # What it does not read is not added to either.
        ("--log", "clock.csv", [], "exists and is not a log that sightline wrote"),
    ]
    for option, name, others, why in cases:
        more = [one if one.startswith("--") else str(own / one) for one in others]
        with pytest.raises(SystemExit) as stopped:
            main(["live", *start, option, str(own / name), *more])
        err = capsys.readouterr().err
        assert stopped.value.code == 2
        assert f"{own / name}: {why}" in err, (option, name, err)
        assert err.count("\n") == 1, err
        after = {path: path.read_bytes() for path in own.rglob("*") if path.is_file()}
        assert after == before, (option, name)


def test_a_log_is_added_to_its_own(tmp_path: Path) -> None:
    for text in ("first", "second"):
        journal = Journal(tmp_path / "live.log")
        journal.write("event", text)
        journal.close()
    told = [json.loads(line)["text"] for line in (tmp_path / "live.log").read_text().splitlines()]
    assert told == ["first", "second"]


def test_the_unit_of_the_documentation_is_one_that_systemd_takes(tmp_path: Path) -> None:
    verify = shutil.which("systemd-analyze")
    if verify is None:
        pytest.skip("there is no systemd-analyze")
    page = Path(__file__).parents[2] / "docs" / "how-to" / "watch-live.md"
    (text,) = re.findall(r"^```ini\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    assert "ExecReload=/bin/kill -HUP $MAINPID" in text
    unit = tmp_path / "sightline-dock.service"
    # Nobody has installed it here, nor made a user for it.
    unit.write_text(text.replace("/opt/sightline/bin/sightline", "/bin/true"), encoding="utf-8")
    done = subprocess.run(
        [verify, "verify", "--man=no", str(unit)], capture_output=True, text=True, timeout=60
    )
    said = [line for line in done.stderr.splitlines() if unit.name in line]
    assert said == []
    unit.write_text(text.replace("NoNewPrivileges=yes", "NoNewPrivilege=yes"), encoding="utf-8")
    done = subprocess.run(
        [verify, "verify", "--man=no", str(unit)], capture_output=True, text=True, timeout=60
    )
    if "NoNewPrivilege" not in done.stderr:
        pytest.skip(f"systemd-analyze checks nothing here: {done.stderr.strip()[-200:]}")


def test_the_configuration_of_the_documentation_is_read(tmp_path: Path) -> None:
    page = Path(__file__).parents[2] / "docs" / "how-to" / "watch-live.md"
    (text,) = re.findall(r"^```toml\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    commented = re.sub(r"^# (\w+ =)", r"\1", text, flags=re.MULTILINE)
    (tmp_path / "live.toml").write_text(commented, encoding="utf-8")
    table = read_live_config(tmp_path / "live.toml")
    assert table.camera == "dock"
    assert table.model == str(tmp_path / "dock.safetensors")
    assert table.source.options == {"rtsp_transport": "udp"}
    assert table.feeds.nmea == ["tcp://0.0.0.0:10110"]


@pytest.mark.slow
def test_the_configuration_is_read_again_when_asked(
    folder: Path, tmp_path: Path, camera: HttpCamera
) -> None:
    address = f"http://127.0.0.1:{camera.port}/video"
    log, config = tmp_path / "log.jsonl", tmp_path / "live.toml"
    port = free_port()
    content = (
        f'camera = "quay"\nmodel = "{folder / "model.safetensors"}"\n'
        f'[source]\naddress = "{address}"\ncredentials = "{folder / "password"}"\n'
        f'silent_s = SILENT\n[detector]\nname = "motion"\n[log]\nfile = "log.jsonl"\n'
        f"[targets]\ngone_s = GONE\n[feeds]\nnmea = [FEEDS]\n"
    )

    def write(silent: str, gone: str, feeds: str = "", more: str = "") -> None:
        text = content.replace("SILENT", silent).replace("GONE", gone).replace("FEEDS", feeds)
        config.write_text(text + more, encoding="utf-8")

    write("2.0", "20.0")
    # A service has no terminal.
    live = Live("--config", config, new_session=True)

    def texts(kind: str) -> list[str]:
        lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
        told = [json.loads(line) for line in lines]
        return [one["text"] for one in told if one["event"] == kind]

    def again(kind: str) -> str:
        before = len(texts(kind))
        live.process.send_signal(signal.SIGHUP)
        until(lambda: len(texts(kind)) > before)
        return texts(kind)[-1]

    until(lambda: bool(texts("connected")))
    listening = f'"tcp://127.0.0.1:{port}"'
    write("3.0", "30.0", listening)
    assert again("reloaded") == (
        "changed: feeds.nmea, targets.gone_s; only a restart changes source.silent_s"
    )
    with socket.create_connection(("127.0.0.1", port), timeout=5.0):
        pass
    # What is broken changes nothing, and says so.
    write("3.0", "-1.0", listening)
    assert again("not-reloaded").endswith("all stays as it was")
    assert "targets.gone_s" in texts("not-reloaded")[-1]
    write("3.0", "30.0", listening, f'[boundaries]\nlines = "{tmp_path / "none.geojson"}"\n')
    assert "none.geojson" in again("not-reloaded")
    with socket.create_connection(("127.0.0.1", port), timeout=5.0):
        pass
    write("2.0", "30.0")
    assert again("reloaded") == "changed: feeds.nmea"

    def refused() -> bool:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=5.0).close()
        except ConnectionRefusedError:
            return True
        return False

    until(refused)
    status, _, err = live.end()
    assert status == 0, err
    assert "Traceback" not in err
