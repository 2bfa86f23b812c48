"""What the base installation may bring, on made-up packages and on those that are there."""

from __future__ import annotations

import tomllib
from importlib.metadata import Distribution
from pathlib import Path

import licences
import pytest


def made(folder: Path, name: str, *lines: str, files: tuple[str, ...] = ()) -> Distribution:
    """A package that is installed in a folder, with these lines in its metadata."""
    where = folder / f"{name}-1.0.dist-info"
    where.mkdir()
    head = ("Metadata-Version: 2.4", f"Name: {name}", "Version: 1.0")
    (where / "METADATA").write_text("\n".join([*head, *lines]) + "\n", encoding="utf-8")
    (where / "RECORD").write_text("".join(f"{file},,\n" for file in files), encoding="utf-8")
    return Distribution.at(where)


@pytest.mark.parametrize(
    ("lines", "stated"),
    [
        (["License-Expression: MIT", "License: GPL"], "MIT"),
        (["License: BSD-3-Clause"], "BSD-3-Clause"),
        (["Classifier: License :: OSI Approved :: MIT License"], "MIT License"),
        (
            ["License: Copyright (c) 2015", "       All rights", "Classifier: License :: X :: Y"],
            "Y",
        ),
        (["License:  ====", "       Terms of it", "       and more"], "Terms of it"),
        (["License: Free", "Classifier: License :: OSI Approved :: GNU GPL"], "Free AND GNU GPL"),
        (["License: LGPLv3+", "Classifier: License :: OSI Approved :: GNU LGPL"], "LGPLv3+"),
        (["Summary: says nothing"], ""),
    ],
)
def test_a_licence_is_what_the_package_says(tmp_path: Path, lines: list[str], stated: str) -> None:
    assert licences.licence(made(tmp_path, "some", *lines)) == stated


@pytest.mark.parametrize(
    ("stated", "copyleft"),
    [
        ("MIT", False),
        ("Apache-2.0 OR BSD-2-Clause", False),
        ("BSD-3-Clause AND 0BSD AND MIT AND Zlib AND CC0-1.0", False),
        ("Python Software Foundation License", False),
        ("GPL-3.0-only", True),
        ("LGPLv3+", True),
        ("AGPL-3.0", True),
        ("GNU Lesser General Public License v2 or later (LGPLv2+)", True),
        ("EUPL-1.2", True),
        ("Mozilla Public License 2.0 (MPL 2.0)", True),
        ("MIT AND GPL-2.0-or-later", True),
        ("MIT OR GPL-2.0-or-later", False),
        ("GPL-2.0 OR LGPL-3.0", True),
        ("GPL-2.0-only AND (MIT OR BSD-3-Clause)", True),
    ],
)
def test_which_licences_are_copyleft(stated: str, copyleft: bool) -> None:
    assert licences.is_copyleft(stated) == copyleft


def test_a_package_is_refused_for_what_comes_with_it(tmp_path: Path) -> None:
    there = {
        "fine": made(
            tmp_path,
            "fine",
            "License-Expression: MIT",
            "Requires-Dist: Deep_Down[fast]>=1",
            "Requires-Dist: on-another-system; sys_platform == 'nowhere'",
            "Requires-Dist: if-asked-for; extra == 'more'",
        ),
        "deep-down": made(
            tmp_path,
            "deep_down",
            "License: Apache 2.0",
            "Requires-Dist: fine",
            "Requires-Dist: copyleft; extra == 'fast'",
        ),
        "copyleft": made(tmp_path, "copyleft", "License-Expression: GPL-3.0-or-later"),
        "silent": made(tmp_path, "silent"),
        "certifi": made(tmp_path, "certifi", "License: MPL-2.0"),
    }
    found = licences.closure(["fine", "silent", "certifi"], there.__getitem__)
    assert list(found) == ["certifi", "copyleft", "deep-down", "fine", "silent"]
    assert licences.refused(found) == {
        "copyleft": "is under GPL-3.0-or-later",
        "silent": "says nothing of its licence",
    }
    # What was looked at was one licence.
    (tmp_path / "later").mkdir()
    other = made(tmp_path / "later", "certifi", "License: GPL-2.0")
    assert licences.refused({"certifi": other}) == {"certifi": "is under GPL-2.0"}


def test_it_ends_with_an_error_that_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    packages = {"copyleft": made(tmp_path, "copyleft", "License: AGPL-3.0")}
    monkeypatch.setattr(licences, "closure", lambda _: packages)
    with pytest.raises(SystemExit) as stopped:
        licences.main()
    assert stopped.value.code == 1
    told = capsys.readouterr()
    assert told.out.split() == ["copyleft", "1.0", "AGPL-3.0"]
    assert told.err == "error: copyleft is under AGPL-3.0\n"


def test_libraries_in_wheels_are_told(tmp_path: Path) -> None:
    files = ("av/a.py", "av.libs/libx264-d6533a8d.so.165", "av.libs/libx264x-1.so")
    assert licences.bundled(made(tmp_path, "av", files=files)) == ["libx264"]


def test_nothing_that_the_base_installation_brings_is_copyleft() -> None:
    project = tomllib.loads((licences.ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = licences.closure(project["project"]["dependencies"])
    assert len(packages) > 30
    assert licences.refused(packages) == {}
