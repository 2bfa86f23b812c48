"""A full disk under the results of the commands: one line, and what was there before stays."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from full_disk import room_for
from moments import START, target
from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.labelling.box_table import BoxTable
from sightline.labelling.control_points import ControlPointSheet
from sightline.live.store import Store
from sightline.moment import Moment

Command = Callable[..., Any]

PLACE = (54.3233, 10.1394)
ZONE = [[10.12, 54.30], [10.16, 54.30], [10.16, 54.34], [10.12, 54.34], [10.12, 54.30]]
FLEET = """[[cameras]]
name = "quay"
model = "camera.safetensors"
recordings = [{source = "boxes/01.csv", clock = "clock/01.csv"}]
"""
PLAN = "plan --height 5 --field-of-view 60 --heading 90 --place 54.3,10.1 --drive none"
SHOW = "show {h}/boat.mp4 --model {h}/camera.safetensors --tracks {h}/t.csv"
MODEL = "--model {h}/camera.safetensors --clock {h}/clock/01.csv"


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def filled(harbour: Path, sightline: Command) -> Path:
    """The harbour with tracks, a zone, a fleet and a store."""
    model = ("--model", harbour / "camera.safetensors", "--clock", harbour / "clock" / "01.csv")
    done = sightline("track", harbour / "boxes" / "01.csv", *model, "-o", harbour / "t.csv")
    assert done.status == 0, done.err
    zone = {"type": "Polygon", "coordinates": [ZONE]}
    feature = {"type": "Feature", "properties": {"name": "harbour"}, "geometry": zone}
    text = json.dumps({"type": "FeatureCollection", "features": [feature]})
    (harbour / "zones.geojson").write_text(text)
    (harbour / "fleet.toml").write_text(FLEET)
    store = Store(harbour / "kept.db", camera="quay", plane=LocalPlane(*PLACE))
    for k in range(20):
        store.keep([Moment(START + 0.1 * k, "sender", "quay", (target(),))])
    store.close()
    return harbour


@pytest.mark.parametrize(
    "command",
    [
        *(
            f"count {{h}}/t.csv --zones {{h}}/zones.geojson -o {{t}}/out/c.{ending}"
            for ending in ("json", "parquet")
        ),
        *(
            f"export {{h}}/kept.db -o {{t}}/out/e.{ending}"
            for ending in ("csv", "geojson", "gpx", "kml", "mfjson", "parquet")
        ),
        *(f"{PLAN} -o {{t}}/out/p.{ending}" for ending in ("html", "png", "geojson")),
        f"{PLAN} --json {{t}}/out/p.json",
        f"{SHOW} -o {{t}}/out/s.mp4",
        f"{SHOW} --at 3 -o {{t}}/out/s.png",
        "detect {h}/boat.mp4 --detector motion -o {t}/out/b.csv",
        f"track {{h}}/boxes/01.csv {MODEL} -o {{t}}/out/t.mfjson",
        "evaluate {h}/t.csv --fixes {h}/target.gpx --json {t}/out/e.json",
        "check {h}/scene.toml --json {t}/out/c.json",
    ],
)
def test_results_are_whole_or_not_there(
    sightline: Command, filled: Path, tmp_path: Path, command: str
) -> None:
    before = content(tmp_path)
    arguments = [part.format(h=filled, t=tmp_path) for part in command.split()]
    with room_for(700):
        done = sightline(*arguments)
    assert done.status == 2
    last = done.err.splitlines()[-1]
    assert re.fullmatch(r"error: .*/out/.*: cannot be written: .*", last), done.err
    assert "Traceback" not in done.err
    assert content(tmp_path) == before
    done = sightline(*arguments)
    assert done.status == 0, done.err


@pytest.mark.slow
def test_a_batch_goes_on_once_there_is_room(
    sightline: Command, filled: Path, tmp_path: Path
) -> None:
    before = content(filled)
    batch = ("batch", filled / "fleet.toml", "-o", tmp_path / "out", "--workers", 1)
    with room_for(2000):
        done = sightline(*batch, "--retries", 0)
    assert done.status == 2
    assert "Traceback" not in done.err
    assert not list((tmp_path / "out").rglob("*.parquet"))
    done = sightline(*batch)
    assert done.status == 0, done.err
    assert len(list((tmp_path / "out" / "tracks").rglob("*.parquet"))) == 1
    assert content(filled) == before


def test_what_is_drawn_stays_as_it_was(filled: Path) -> None:
    """The tables of boxes and of control points, and the scene that names them."""
    boxes = BoxTable(filled / "scene.toml", "01", filled / "boxes" / "01.csv", (640, 360))
    sheet = ControlPointSheet(filled / "scene.toml")
    before = content(filled)
    for room in (10, 300):
        with pytest.raises(InputError, match="cannot be written"), room_for(room):
            boxes.put(4, "somebody", [(100.0, 200.0, 140.0, 220.0)], expected=())
        assert content(filled) == before
    with pytest.raises(InputError, match="cannot be written"), room_for(10):
        sheet.add((320.0, 200.0), PLACE[0] + 0.001, PLACE[1])
    assert content(filled) == before
    # The table fits, and the scene file that would name it does not.
    with pytest.raises(InputError, match="cannot be written"), room_for(200):
        sheet.add((320.0, 200.0), PLACE[0] + 0.001, PLACE[1])
    assert content(filled) == before
