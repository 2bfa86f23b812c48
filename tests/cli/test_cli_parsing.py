from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest

from sightline.cli.parsing import (
    parse_architecture_options,
    parse_distinct_names,
    parse_known_names,
    parse_names,
    parse_options_by_architecture,
    parse_pair,
    parse_size_px,
    parse_time,
)
from sightline.errors import InputError
from sightline.formats.labels import parse_margins

ARCHITECTURES = ("harbour", "faster-rcnn")


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (parse_names, "", ()),
        (parse_names, " 07, ,nord-süd,", ("07", "nord-süd")),
        (lambda text: parse_pair("--scales", text, "-"), "0.5-1.5", (0.5, 1.5)),
        (lambda text: parse_size_px("--size", text), "640X384", (640, 384)),
        (lambda text: parse_time("--start-utc", text), None, None),
        (lambda text: parse_time("--start-utc", text), "1970-01-01T01:00:00+01:00", 0.0),
        (lambda text: parse_time("--start-utc", text), "1970-01-02", 86_400.0),
        (
            parse_architecture_options,
            ["width=1.5", "depth=3", "frozen=true", "backbone=resnet50"],
            {"width": 1.5, "depth": 3, "frozen": True, "backbone": "resnet50"},
        ),
        (
            lambda texts: parse_options_by_architecture(texts, ARCHITECTURES),
            ["harbour.width=2", "faster-rcnn.a=b", "harbour.c=d=e"],
            {"harbour": {"width": 2, "c": "d=e"}, "faster-rcnn": {"a": "b"}},
        ),
    ],
)
def test_a_text_means(parse: Callable[[Any], Any], text: Any, value: Any) -> None:
    assert parse(text) == value


@pytest.mark.parametrize(
    ("parse", "text", "message"),
    [
        (
            lambda text: parse_known_names(text, "class", ("boat", "buoy")),
            "boat,bat",
            "unknown class 'bat'; known are boat, buoy",
        ),
        (
            lambda text: parse_distinct_names("--classes", text),
            " ,",
            "--classes ' ,': names nothing; give one name or more",
        ),
        (
            lambda text: parse_distinct_names("--classes", text),
            "boat,buoy,boat",
            "names boat twice",
        ),
        (parse_margins, ["voc=nan"], "--margin 'voc=nan': expected SOURCE=PX"),
        (
            lambda text: parse_pair("--scales", text, "-"),
            "0.5",
            "--scales '0.5': expected two numbers with '-' between them",
        ),
        (lambda text: parse_size_px("--size", text), "nanx100", "--size 'nanx100': expected width"),
        (lambda text: parse_size_px("--size", text), "16x99999", "must lie between 32 and 8192 px"),
        (lambda text: parse_time("--start-utc", text), "noon", "--start-utc 'noon' is no time"),
        (lambda text: parse_architecture_options([text]), "width", "expected NAME=VALUE"),
        (lambda text: parse_architecture_options([text]), "a b=1", "expected NAME=VALUE"),
        (
            lambda text: parse_options_by_architecture([text], ARCHITECTURES),
            "ssd.width=1",
            "expected ARCH.NAME=VALUE, and known are harbour, faster-rcnn",
        ),
    ],
)
def test_another_text_is_refused(parse: Callable[[Any], Any], text: Any, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        parse(text)
