"""Adds a key to a scene file, and changes nothing else of its text."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.scene.schema import parse_scene_table

_HEADER = re.compile(r"^[ \t]*\[\[[ \t]*recordings[ \t]*\]\][ \t]*(?:#.*)?\r?$", re.MULTILINE)
_BARE = re.compile(r"[A-Za-z0-9._/ -]+")


def name_file(scene: Path, recording: str, key: str, file: str, *, wait_s: float = 0.0) -> str:
    """Name a file in a recording's table, unless one is named there already.

    Comments, order and all other keys stay as they are.

    Args:
        scene: The scene file.
        recording: Name of the recording.
        key: Of the file, as ``boxes``.
        file: Its path, relative to the scene file, with ``/``.
        wait_s: How long to wait for somebody else who writes the scene file.

    Returns:
        What is named there now.

    Raises:
        InputError: The scene file cannot be read or written, has no such recording, or is written
            in a way that a line cannot be added to.
    """
    with atomic_path(scene, wait_s=wait_s) as temporary:
        table = parse_scene_table(scene)
        numbers = [i for i, one in enumerate(table.recordings) if one.name == recording]
        if not numbers:
            raise InputError(f"{scene}: has no recording {recording!r} any more")
        named: str | None = getattr(table.recordings[numbers[0]], key)
        with scene.open(encoding="utf-8", newline="") as opened:
            text = opened.read()
        if named is None:
            text, named = _with_file(scene, text, numbers[0], key, file), file
        with temporary.open("w", encoding="utf-8", newline="") as written:
            written.write(text)
    return named


def state_number(
    scene: Path, recording: str, key: str, value: float | int | None, *, wait_s: float = 0.0
) -> None:
    """State a number in a recording's table, in the place of what is stated there.

    Comments, order and all other keys stay as they are.

    Args:
        scene: The scene file.
        recording: Name of the recording.
        key: What is stated, as ``clock_offset_s``.
        value: The number; None takes the line away.
        wait_s: How long to wait for somebody else who writes the scene file.

    Raises:
        InputError: The scene file cannot be read or written, has no such recording, is written
            in a way that the line cannot be changed, or would be none with it.
    """
    with atomic_path(scene, wait_s=wait_s) as temporary:
        table = parse_scene_table(scene)
        numbers = [i for i, one in enumerate(table.recordings) if one.name == recording]
        if not numbers:
            raise InputError(f"{scene}: has no recording {recording!r} any more")
        with scene.open(encoding="utf-8", newline="") as opened:
            text = opened.read()
        before = tomllib.loads(text.removeprefix("\ufeff"))["recordings"][numbers[0]]
        written = None if value is None else repr(value)
        if key in before:
            text = _with_other_line(scene, text, numbers[0], key, written)
        elif written is not None:
            text = _with_line(scene, text, numbers[0], key, written)
        with temporary.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
        # A number that no scene takes is refused here, with the key's own words.
        parse_scene_table(temporary)


def _with_file(scene: Path, text: str, number: int, key: str, file: str) -> str:
    """The text of a scene file that names a file more in one of its recordings."""
    if _BARE.fullmatch(file) is None:
        raise _by_hand(scene, key, f'"{file}"')
    return _with_line(scene, text, number, key, f'"{file}"')


def _by_hand(scene: Path, key: str, written: str) -> InputError:
    return InputError(
        f"{scene}: {key} cannot be added to its recordings as they are written; add the line {key} "
        f"= {written} by hand"
    )


def _with_line(scene: Path, text: str, number: int, key: str, written: str) -> str:
    """The text of a scene file with a key more in one of its recordings."""
    headers = list(_HEADER.finditer(text))
    if len(headers) <= number:
        raise _by_hand(scene, key, written)
    end = headers[number].end()
    ending = "\r\n" if text[:end].endswith("\r") else "\n"
    line = f"{key} = {written}{ending}"
    # A header may be the last line, and have no end.
    begun = text[end : end + 1] == "\n"
    at = end + 1 if begun else end
    # Behind the name, where people look for it.
    after = re.compile(r"[ \t]*name[ \t]*=[^\n]*\n").match(text, at)
    at = after.end() if after is not None else at
    longer = text[:at] + ("" if begun else ending) + line + text[at:]
    return _checked(scene, text, longer, number, key, written)


def _with_other_line(scene: Path, text: str, number: int, key: str, written: str | None) -> str:
    """The text of a scene file with another value of a key that a recording has, or without it."""
    headers = list(_HEADER.finditer(text))
    if len(headers) <= number:
        raise _by_hand(scene, key, written or "nothing")
    begin = headers[number].end()
    after = _TABLE.search(text, begin)
    end = len(text) if after is None else after.start()
    line = re.compile(
        rf"^([ \t]*{key}[ \t]*=[ \t]*)[^\n#\r]*?([ \t]*(?:#[^\n]*)?\r?(?:\n|\Z))", re.M
    )
    found = line.search(text, begin, end)
    if found is None:
        raise _by_hand(scene, key, written or "nothing")
    other = "" if written is None else f"{found[1]}{written}{found[2]}"
    changed = text[: found.start()] + other + text[found.end() :]
    return _checked(scene, text, changed, number, key, written)


def _checked(
    scene: Path, text: str, changed: str, number: int, key: str, written: str | None
) -> str:
    """The changed text of a scene file, if nothing but a key of a recording is another."""
    by_hand = _by_hand(scene, key, written or "nothing")
    try:
        before = tomllib.loads(text.removeprefix("\ufeff"))
        now = tomllib.loads(changed.removeprefix("\ufeff"))
        wanted = None if written is None else tomllib.loads(f"value = {written}")["value"]
    except tomllib.TOMLDecodeError as error:
        raise by_hand from error
    before["recordings"][number].pop(key, None)
    if now["recordings"][number].pop(key, None) != wanted or now != before:
        raise by_hand
    return changed


_TABLE = re.compile(r"^[ \t]*\[", re.MULTILINE)
_POINTS = "control_points"


def name_control_points(scene: Path, file: str | None, *, wait_s: float = 0.0) -> None:
    """Name the table of control points in a scene file that has none, or name none any more.

    Args:
        scene: The scene file.
        file: The table, relative to the scene file, with ``/``; None takes its line away.
        wait_s: How long to wait for somebody else who writes the scene file.

    Raises:
        InputError: The scene file cannot be read or written, has control points already, has
            nothing else, or is written in a way that the line cannot be added to or taken from.
    """
    with atomic_path(scene, wait_s=wait_s) as temporary:
        parse_scene_table(scene)
        with scene.open(encoding="utf-8", newline="") as opened:
            text = opened.read()
        before = tomllib.loads(text.removeprefix("\ufeff"))
        ending = "\r\n" if "\r\n" in text else "\n"
        if file is None:
            changed = re.sub(rf"^{_POINTS}[ \t]*=[^\n]*\n", "", text, count=1, flags=re.MULTILINE)
            wanted = {key: value for key, value in before.items() if key != _POINTS}
        else:
            first = _TABLE.search(text)
            at = first.start() if first is not None else len(text)
            # Comments right above a table are of that.
            lines = text[:at].splitlines(keepends=True)
            while lines and lines[-1].lstrip().startswith("#"):
                at -= len(lines.pop())
            line = f'{_POINTS} = "{file}"{ending}{ending}'
            bom = len(text) - len(text.removeprefix("\ufeff"))
            at = max(at, bom)
            changed = text[:at] + line + text[at:]
            wanted = {**before, _POINTS: file}
        by_hand = InputError(
            f"{scene}: the line of its {_POINTS} cannot be added or taken away as it is written; "
            f'name the table by hand ({_POINTS} = "{file or ""}")'
        )
        if file is not None and _POINTS in before:
            raise InputError(f"{scene}: has control points already")
        try:
            if tomllib.loads(changed.removeprefix("\ufeff")) != wanted:
                raise by_hand
        except tomllib.TOMLDecodeError as error:
            raise by_hand from error
        with temporary.open("w", encoding="utf-8", newline="") as written:
            written.write(changed)
        # Whatever is left must still be a scene.
        parse_scene_table(temporary)
