"""A file's name that is added to a scene file, whose other text stays as it was."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from sightline import InputError
from sightline.scene.naming import name_control_points, name_file, state_number

SCENE = """# Our dock, drawn by hand.
[camera]  # a webcam
latitude_deg = 54.3
longitude_deg = 10.1

# The first trip.
[[recordings]]
name = "a"   # in the morning
frames = "a"

[[ recordings ]]
# no name first
frames = "b"
name = "b"
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(SCENE, encoding="utf-8")
    return path


@pytest.mark.parametrize(("name", "row"), [("a", 0), ("b", 1)])
def test_one_line_is_added(scene: Path, name: str, row: int) -> None:
    assert name_file(scene, name, "boxes", f"boxes/{name}.csv") == f"boxes/{name}.csv"
    text = scene.read_text(encoding="utf-8")
    lines = text.splitlines()
    assert [line for line in lines if not line.startswith("boxes")] == SCENE.splitlines()
    assert tomllib.loads(text)["recordings"][row]["boxes"] == f"boxes/{name}.csv"


def test_what_is_named_stays(scene: Path) -> None:
    name_file(scene, "a", "boxes", "boxes/a.csv")
    before = scene.read_bytes()
    assert name_file(scene, "a", "boxes", "another.csv") == "boxes/a.csv"
    assert scene.read_bytes() == before


@pytest.mark.parametrize("ending", ["\r\n", "\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_ends_of_lines_and_byte_order_marks_stay(scene: Path, ending: str, mark: str) -> None:
    scene.write_bytes((mark + SCENE.replace("\n", ending)).encode())
    name_file(scene, "b", "boxes", "boxes/b.csv")
    name_control_points(scene, "points.csv")
    text = scene.read_bytes().decode()
    assert text.startswith(mark)
    assert text.count("\r\n") == (text.count("\n") if ending == "\r\n" else 0)
    assert tomllib.loads(text.removeprefix("\ufeff"))["control_points"] == "points.csv"


@pytest.mark.parametrize(
    ("text", "file"),
    [
        ('recordings = [{name = "a", frames = "a"}]\n', "boxes/a.csv"),
        (SCENE, 'boxes/"a".csv'),
        (SCENE, "boxes/a\n.csv"),
    ],
)
def test_what_cannot_be_added_is_to_be_added_by_hand(scene: Path, text: str, file: str) -> None:
    scene.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="by hand"):
        name_file(scene, "a", "boxes", file)
    assert scene.read_text(encoding="utf-8") == text


def test_a_recording_that_went_is_told(scene: Path) -> None:
    with pytest.raises(InputError, match="has no recording 'c' any more"):
        name_file(scene, "c", "boxes", "boxes/c.csv")


def test_control_points_are_named_and_forgotten(scene: Path) -> None:
    name_control_points(scene, "control_points.csv")
    found = tomllib.loads(scene.read_text(encoding="utf-8"))
    assert found.pop("control_points") == "control_points.csv"
    assert found == tomllib.loads(SCENE)
    with pytest.raises(InputError, match="has control points already"):
        name_control_points(scene, "others.csv")
    name_control_points(scene, None)
    assert tomllib.loads(scene.read_text(encoding="utf-8")) == tomllib.loads(SCENE)


def test_a_number_is_stated_changed_and_taken_out_again(scene: Path) -> None:
    state_number(scene, "a", "clock_offset_s", 1.25)
    assert tomllib.loads(scene.read_text())["recordings"][0]["clock_offset_s"] == 1.25
    kept = scene.read_text().replace("= 1.25", "= 1.25   # by the church clock")
    scene.write_text(kept, encoding="utf-8")
    state_number(scene, "a", "clock_offset_s", -2.0)
    state_number(scene, "b", "clock_offset_s", 7)
    found = tomllib.loads(scene.read_text())["recordings"]
    assert [one["clock_offset_s"] for one in found] == [-2.0, 7]
    assert "= -2.0   # by the church clock\n" in scene.read_text()
    state_number(scene, "a", "clock_offset_s", None)
    state_number(scene, "b", "clock_offset_s", None)
    state_number(scene, "b", "clock_offset_s", None)
    assert scene.read_text(encoding="utf-8") == SCENE


def test_a_number_with_its_deviation_is_replaced_as_a_whole(scene: Path) -> None:
    text = SCENE.replace('frames = "b"', 'clock_offset_s = [3.0, 0.5] # s\nframes = "b"')
    scene.write_text(text, encoding="utf-8")
    state_number(scene, "b", "clock_offset_s", 2.5)
    assert scene.read_text(encoding="utf-8") == text.replace("[3.0, 0.5]", "2.5")


@pytest.mark.parametrize(
    "text",
    [
        'recordings = [{name = "a", frames = "a"}]\n',
        SCENE.replace('frames = "a"', 'frames = "a"\nclock_offset_s = [\n3.0,\n0.5]'),
    ],
)
def test_a_number_that_cannot_be_stated_is_to_be_stated_by_hand(scene: Path, text: str) -> None:
    scene.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="by hand"):
        state_number(scene, "a", "clock_offset_s", 1.0)
    assert scene.read_text(encoding="utf-8") == text
    with pytest.raises(InputError, match="has no recording 'c' any more"):
        state_number(scene, "c", "clock_offset_s", 1.0)
