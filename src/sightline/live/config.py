"""`live.toml`: what a camera is watched with, checked before anything is opened."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote, urlsplit

from pydantic import Field

from sightline.configuration import Table, checked, read_toml
from sightline.errors import InputError

CREDENTIALS = "SIGHTLINE_CREDENTIALS"
"""Environment variable with a camera's user and password, ``USER:PASSWORD``."""
TOKEN = "SIGHTLINE_TOKEN"  # noqa: S105 - the name of the variable
"""Environment variable with the token of the page."""

Seconds = Annotated[float, Field(gt=0.0, le=86_400.0)]


class SourceTable(Table):
    """`[source]`."""

    address: str | None = None
    credentials: str | None = None
    options: dict[str, str] = Field(default_factory=dict)
    clock: Literal["auto", "sender", "arrival"] = "auto"
    largest_clock_error_s: Seconds = 30.0
    open_s: Seconds = 10.0
    silent_s: Seconds = 5.0
    frozen_s: Seconds = 10.0
    black_s: Seconds = 5.0
    longest_wait_s: Seconds = 5.0
    as_live: bool = False
    frame_clock: str | None = None
    start_utc: str | None = None
    speed: Annotated[float, Field(gt=0.0, le=1000.0)] = 1.0


class DetectorTable(Table):
    """`[detector]`."""

    name: str | None = None
    classes: list[str] | None = None
    threshold: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    views: str | None = None
    enlarge: Annotated[float, Field(gt=0.0)] | None = None
    budget_ms: Annotated[float, Field(gt=0.0)] | None = None


class TargetsTable(Table):
    """`[targets]`; see `sightline.live.state.StateSettings`."""

    shown_s: Seconds = 10.0
    gone_s: Seconds = 20.0
    lag_s: Seconds = 5.0
    smooth_every_s: Seconds = 4.0
    moored_after_s: Seconds = 30.0
    moored_mps: Annotated[float, Field(gt=0.0)] = 0.5


class StoreTable(Table):
    """`[store]`."""

    file: str | None = None
    clips: str | None = None
    retention_days: Annotated[float, Field(gt=0.0)] | None = None


class ServerTable(Table):
    """`[server]`."""

    address: str | None = None
    token_file: str | None = None
    shore: str | None = None
    basemap: str | None = None


class FeedsTable(Table):
    """`[feeds]`."""

    nmea: list[str] = Field(default_factory=list)
    signalk: list[str] = Field(default_factory=list)
    cot: list[str] = Field(default_factory=list)
    mqtt: list[str] = Field(default_factory=list)
    webhook: list[str] = Field(default_factory=list)


class BoundariesTable(Table):
    """`[boundaries]`; see `sightline.live.boundaries`."""

    lines: str | None = None
    zones: str | None = None
    speed_mps: Annotated[float, Field(gt=0.0)] | None = None
    dwell_s: Seconds | None = None


class AisTable(Table):
    """`[ais]`."""

    source: str | None = None


class LogTable(Table):
    """`[log]`."""

    file: str | None = None


class LiveTable(Table):
    """All of `live.toml`."""

    camera: str = "camera"
    model: str | None = None
    mask: str | None = None
    area: list[str] = Field(default_factory=list)
    water_level_m: float | None = None
    source: SourceTable = SourceTable()
    detector: DetectorTable = DetectorTable()
    targets: TargetsTable = TargetsTable()
    store: StoreTable = StoreTable()
    server: ServerTable = ServerTable()
    feeds: FeedsTable = FeedsTable()
    boundaries: BoundariesTable = BoundariesTable()
    ais: AisTable = AisTable()
    log: LogTable = LogTable()


_PATHS = (
    ("", "model"),
    ("", "mask"),
    ("source", "credentials"),
    ("source", "frame_clock"),
    ("store", "file"),
    ("store", "clips"),
    ("server", "token_file"),
    ("server", "shore"),
    ("server", "basemap"),
    ("log", "file"),
    ("boundaries", "lines"),
    ("boundaries", "zones"),
)


def read_live_config(path: Path) -> LiveTable:
    """Read and check `live.toml`; paths in it are relative to it.

    Raises:
        InputError: There is no such file, it is no TOML, or a key or a value cannot stand there.
    """
    try:
        content = read_toml(path, "configuration")
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such configuration") from error
    table = checked(path, content, LiveTable)
    return _resolved(table, path.parent)


def _resolved(table: LiveTable, folder: Path) -> LiveTable:
    content = table.model_dump()
    for section, key in _PATHS:
        where = content[section] if section else content
        if where[key] is not None and where[key] != "-":
            where[key] = str(folder / where[key])
    content["area"] = [str(folder / one) for one in content["area"]]
    address = content["source"]["address"]
    if address is not None and "://" not in address:
        content["source"]["address"] = str(folder / address)
    source = content["ais"]["source"]
    if source is not None and "://" not in source:
        content["ais"]["source"] = str(folder / source)
    return LiveTable.model_validate(content)


_CHANGEABLE = ("mask", "area", "detector.", "targets.", "feeds.", "boundaries.", "store.retention_")


def changed_keys(before: LiveTable, after: LiveTable) -> tuple[list[str], list[str]]:
    """Which keys are other ones: those that hold at once, and those that want a restart."""
    old, new = (_flat(one.model_dump()) for one in (before, after))
    every = sorted(key for key in new if new[key] != old[key])
    at_once = [key for key in every if key.startswith(_CHANGEABLE)]
    return at_once, [key for key in every if key not in at_once]


def _flat(content: dict[str, object], before: str = "") -> dict[str, object]:
    flat: dict[str, object] = {}
    for key, value in content.items():
        # The options of FFmpeg are one value.
        if isinstance(value, dict) and key != "options":
            flat |= _flat(value, f"{before}{key}.")
        else:
            flat[f"{before}{key}"] = value
    return flat


def with_credentials(address: str, file: str | None) -> str:
    """An address with the user and password of a file, or else of the environment.

    Args:
        address: Of a camera; one that names a user already stays as it is.
        file: Holds ``USER:PASSWORD`` in its first line; None: the environment tells, if anything.

    Raises:
        InputError: The file cannot be read, or holds something else.
    """
    told = os.environ.get(CREDENTIALS)
    where = CREDENTIALS
    if file is not None:
        where = file
        told = _first_line(file)
    if told is None or "://" not in address or "@" in urlsplit(address).netloc:
        return address
    user, colon, password = told.partition(":")
    if not colon or not user:
        raise InputError(f"{where}: expected USER:PASSWORD")
    scheme, rest = address.split("://", 1)
    return f"{scheme}://{quote(user, safe='')}:{quote(password, safe='')}@{rest}"


def page_token(file: str | None) -> str | None:
    """The token of the page, of a file or else of the environment; None where there is none.

    Raises:
        InputError: The file cannot be read, or is empty.
    """
    if file is None:
        return os.environ.get(TOKEN) or None
    token = _first_line(file)
    if not token:
        raise InputError(f"{file}: is empty; expected a token in its first line")
    return token


def _first_line(file: str) -> str:
    try:
        return Path(file).read_text(encoding="utf-8").partition("\n")[0].strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "is not text in UTF-8"
        raise InputError(f"{file}: cannot be read: {reason}") from error
