"""Positions that people paste, against what each form says by hand."""

from __future__ import annotations

import pytest

from sightline import InputError
from sightline.formats.pasted_position import parse_position

DECIMAL = (32.7, -117.2)
MINUTES = (32.0 + 42.3 / 60.0, -(117.0 + 10.2 / 60.0))
SECONDS = (32.0 + 42.0 / 60.0 + 18.5 / 3600.0, -(117.0 + 10.0 / 60.0 + 12.0 / 3600.0))


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("32.7, -117.2", DECIMAL),
        ("32.7,-117.2", DECIMAL),
        ("  32.7   -117.2\n", DECIMAL),
        ("(32.7, -117.2)", DECIMAL),
        ("32,7; -117,2", DECIMAL),
        ("32,7, -117,2", DECIMAL),
        ("lat: 32.7, lon: -117.2", DECIMAL),
        ("32.7N 117.2W", DECIMAL),
        ("32.7° N, 117.2° W", DECIMAL),
        ("N32.7 W117.2", DECIMAL),
        ("117.2W 32.7N", DECIMAL),
        ("32.7\N{NO-BREAK SPACE}N 117.2\N{NO-BREAK SPACE}W", DECIMAL),
        ("32.7, \N{MINUS SIGN}117.2", DECIMAL),
        ("32.7 north 117.2 west", DECIMAL),
        ("32°42.3'N 117°10.2'W", MINUTES),
        ("32 42.3 N 117 10.2 W", MINUTES),
        ("N 32° 42.300′ W 117° 10.200′", MINUTES),
        ("32°42.3' -117°10.2'", MINUTES),
        ("N 32 42 18.5 W 117 10 12", SECONDS),
        ("32°42'18.5\"N, 117°10'12\"W", SECONDS),
        ("geo:32.7,-117.2", DECIMAL),
        ("geo:32.7,-117.2,12;u=35", DECIMAL),
        ("https://www.openstreetmap.org/#map=17/32.7/-117.2", DECIMAL),
        ("https://www.openstreetmap.org/?mlat=32.7&mlon=-117.2#map=15/1/2", DECIMAL),
        ("#map=17/32.7/-117.2", DECIMAL),
        ("?mlat=32.7&mlon=-117.2", DECIMAL),
        ("https://maps.example.org/@32.7,-117.2,17z", DECIMAL),
        ("https://maps.example.org/place/Dock/@1,2,17z/data=!3d32.7!4d-117.2", DECIMAL),
        ("https://maps.example.org/?q=32.7,-117.2", DECIMAL),
        ("-90, 180", (-90.0, 180.0)),
    ],
)
def test_what_people_paste(text: str, place: tuple[float, float]) -> None:
    assert parse_position(text) == pytest.approx(place, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "is no position"),
        ("the end of the pier", "may be several"),
        ("32.7", "may be several"),
        # One number with a comma for a point, or two.
        ("32,7", "may be several"),
        ("12,13", "may be several"),
        ("1 2 3 4 5 6", "may be several"),
        ("32.7, -117.2, 5", "may be several"),
        ("32.7N 117.2N", "may be several"),
        ("32.7N, 117.2", "may be several"),
        ("-32.7 S 117.2 W", "may be several"),
        ("N 32 75 W 117", "may be several"),
        ("nan, nan", "no position"),
        ("inf, 3", "no position"),
        ("-117.2, 32.7", "are latitude and longitude swapped?"),
        ("32.7, 200", "longitude of 200°"),
        ("geo:95,10", "latitude of 95°"),
        ("https://maps.example.org/", "an address without a position"),
        ("https://[maps", "no address that can be read"),
        ("https://maps.example.org/?lat=1&lat=2&lon=3", "or several"),
        ("9" * 5000, "is no position"),
    ],
)
def test_what_is_none_is_refused_in_one_line(text: str, why: str) -> None:
    with pytest.raises(InputError) as raised:
        parse_position(text)
    assert why in str(raised.value)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 300
