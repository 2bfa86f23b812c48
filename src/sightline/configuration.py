"""Configuration files in TOML: read, and checked against a schema."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, TypeVar, get_args

from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from sightline.errors import InputError
from sightline.text import without_secrets

_LONGEST = 80


class Table(BaseModel):
    """A table of keys and values in which no other key may stand."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _moment(value: object) -> object:
    return datetime.fromisoformat(value) if isinstance(value, str) else value


UtcTime = Annotated[datetime, BeforeValidator(_moment)]
"""A time of TOML's own, or as text in ISO 8601."""


def posix_s(moment: datetime | None) -> float | None:
    """POSIX seconds of a time, which is UTC where it has no zone."""
    if moment is None:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


TableT = TypeVar("TableT", bound=Table)


def read_toml(path: Path, what: str) -> dict[str, object]:
    """The content of a TOML file.

    Args:
        path: The file; one that begins with a byte order mark will do.
        what: What it is, for messages: ``"scene file"``.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: It is a folder, cannot be read, or is no TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8, so it is no {what}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no TOML: {shortened(str(error))}") from error


def checked(path: Path, content: dict[str, object], schema: type[TableT]) -> TableT:
    """The tables of a file by their schema.

    Raises:
        InputError: A key or a value cannot stand there; names the first, and what mends it.
    """
    try:
        return schema.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {_first_problem(error, schema)}") from error


def _first_problem(error: ValidationError, schema: type[Table]) -> str:
    """The first problem of a validation in one line: the key's path, and what mends it."""
    # An unknown key is often why another is missing, so it goes first.
    problem = min(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    unknown = problem["type"] == "extra_forbidden"
    where, table = "", schema
    for i, step in enumerate(problem["loc"]):
        if isinstance(step, int):
            where += f"[{step + 1}]"
        # Where a value may be of several kinds, the one that was tried stands among the keys.
        elif (named := _field(table, step)) or (unknown and i + 1 == len(problem["loc"])):
            key = shortened(step)
            where += f".{key}" if where else key
            table = (_table(named.annotation) if named else None) or table
    if unknown:
        return f"unknown key {where}; known are {', '.join(table.model_fields)}"
    if problem["type"] == "missing":
        return f"{where} is missing"
    given = shortened(without_secrets(repr(problem["input"])))
    if problem["type"] == "model_type":
        return f"{where}: expected a table of keys and values; it is {given}"
    message = problem["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    if isinstance(problem["input"], str | int | float | list) and problem["type"] != "value_error":
        message += f"; it is {given}"
    return f"{where}: {message}" if where else message


def _field(table: type[Table], key: str) -> FieldInfo | None:
    """The field of a table that a key fills, by its name or by an older one."""
    for name, field in table.model_fields.items():
        alias = field.validation_alias
        if key == name or (isinstance(alias, AliasChoices) and key in alias.choices):
            return field
    return None


def _table(annotation: object) -> type[Table] | None:
    """The table that a value of a kind is, or holds."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return annotation
    return next((table for table in map(_table, get_args(annotation)) if table), None)


def shortened(text: str) -> str:
    """A text from outside, cut to what a line of a message has room for."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
