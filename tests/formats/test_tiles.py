"""Tiles of a map: those of the specifications are found, what is spoilt is refused in a line."""

from __future__ import annotations

import base64
import gzip
import io
import random
import sqlite3
import struct
from contextlib import suppress
from pathlib import Path

import pytest
from PIL import Image

from sightline.errors import InputError
from sightline.formats.tiles import open_tiles, tile_number

PNG = b"\x89PNG\r\n\x1a\n"
# Written by the reference implementation (pmtiles 3.8.1 for Python): six pictures of one pixel,
# each of the colour (zoom, x, y), those of zoom 10 less 500 and 300.
ARCHIVE = base64.b85decode(
    "P)$^6Y-Mu;e*gdg00000B>(^b00000qyPW_00000Q2+n{00000^#A|>000000000000000^#A|>00000"
    "o&f*=000001^@s6000001^@s6000001^@s6000000RjO6015yA000000002O>k9xz!y^Fz000000000V"
    "iwFP!0000217l-gVlrY{^T?YK3|zs0kpTn%uf#sI8vp<RABzY8000000t2g7N-QZU%1kOP$;{7FvQkh|"
    "OU^H-v{tZ5RLCewO|w<6P`3-t&rMCrPpP!gPqb6gQBcZD%uNL;Em5ik090(*t3Ln$0EtjeM-2)Z3IG5A"
    "4M|8uQUCw|0RR910SE#B005A8Q{Dgo01Qb)K~#90V_;-p0000700QX}*-QWc002ovPDHLkV1kKIPDc$2"
    "8VUda01Zh<L{b0%00961009UB0001xcT?T~000b0L_t(|oMT{OU<3dF3jhREmClR+0000<MNUMnLSTZ4"
    "P)<h;3K|Lk000e1NJLTq00031000390ssI2kattw0000CNkl<Zc${NkVq^dS01N;GJ_NoD00000NkvXX"
    "u0mjfiBL{Q4GJ0x0000DNk~Le00001000012m$~A0FZZ6-T(jq3`s;mRCt_YU}j|j000{R4Y$x`wg3PC"
    "07*qoM6N<$f{9R0M-2)Z3IG5A4M|8uQUCw|0RR910SE#B005A8Q{Dgo01Qb)K~#90V_;@s1pojV01es9"
    "X@md(002ovPDHLkV1kKIPDc$28VUda01Zh<L{b0%00961009UB0001xcT?T~000b0L_t(|oMYh95eEPO"
    "kpNCkFeLo|0000<MNUMnLSTX"
)
COLOURS = {
    (0, 0, 0): (1, 0, 0),
    (1, 1, 0): (2, 1, 0),
    (1, 0, 1): (2, 0, 1),
    (3, 4, 5): (3, 4, 5),
    (3, 5, 4): (3, 5, 4),
    (10, 544, 323): (10, 44, 23),
}


def colour(picture: bytes) -> tuple[int, ...]:
    return Image.open(io.BytesIO(picture)).getpixel((0, 0))  # type: ignore[return-value]


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    path = tmp_path / "harbour.pmtiles"
    path.write_bytes(ARCHIVE)
    return path


def mbtiles(path: Path, tiles: dict[tuple[int, int, int], bytes], **metadata: str) -> Path:
    """As the specification has it: rows count from the south."""
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name text, value text)")
        base.execute(
            "CREATE TABLE tiles (zoom_level integer, tile_column integer, tile_row integer,"
            " tile_data blob)"
        )
        base.executemany("INSERT INTO metadata VALUES (?, ?)", metadata.items())
        base.executemany(
            "INSERT INTO tiles VALUES (?, ?, ?, ?)",
            [(z, x, 2**z - 1 - y, data) for (z, x, y), data in tiles.items()],
        )
    base.close()
    return path


@pytest.mark.parametrize(
    ("place", "number"),
    [
        ((0, 0, 0), 0),
        ((1, 0, 0), 1),
        ((1, 0, 1), 2),
        ((1, 1, 1), 3),
        ((1, 1, 0), 4),
        ((2, 0, 0), 5),
        ((12, 3423, 1763), 19078479),
    ],
)
def test_tiles_are_numbered_as_the_specification_has_it(
    place: tuple[int, int, int], number: int
) -> None:
    assert tile_number(*place) == number


def test_numbers_of_a_zoom_are_those_of_a_curve() -> None:
    """Each once, and those that follow each other are neighbours."""
    by_number = {tile_number(4, x, y): (x, y) for x in range(16) for y in range(16)}
    first = (4**4 - 1) // 3
    assert sorted(by_number) == list(range(first, first + 256))
    for number in range(first, first + 255):
        (x, y), (u, v) = by_number[number], by_number[number + 1]
        assert abs(x - u) + abs(y - v) == 1


def test_an_archive_of_the_reference_is_read(archive: Path) -> None:
    tiles = open_tiles(archive)
    assert tiles.about.kind == "raster"
    assert tiles.about.zooms == (0, 10)
    assert tiles.about.bounds_deg == (0.0, 0.0, 20.0, 60.0)
    # Markup is left out of what is owed to whom.
    assert tiles.about.attribution == "© Somebody"
    for place, wanted in COLOURS.items():
        data, media_type = tiles.tile(*place)
        assert media_type == "image/png"
        assert colour(data) == wanted
    for place in ((1, 1, 1), (2, 0, 0), (3, 4, 4), (11, 0, 0)):
        assert tiles.tile(*place) is None
    tiles.close()


def test_mbtiles_have_their_rows_from_the_south(tmp_path: Path) -> None:
    here, there = PNG + b"here", b"\xff\xd8\xffthere"
    made = mbtiles(
        tmp_path / "a.mbtiles",
        {(0, 0, 0): PNG, (3, 4, 1): here, (3, 4, 6): there},
        format="png",
        bounds="9.5,54.0,10.5,54.5",
        attribution="<b>Chart</b> office",
    )
    tiles = open_tiles(made)
    assert tiles.tile(3, 4, 1) == (here, "image/png")
    assert tiles.tile(3, 4, 6) == (there, "image/jpeg")
    assert tiles.tile(3, 1, 4) is None
    assert tiles.about.zooms == (0, 3)
    assert tiles.about.bounds_deg == (9.5, 54.0, 10.5, 54.5)
    assert tiles.about.attribution == "Chart office"
    tiles.close()


def test_vectors_are_unpacked_and_their_layers_named(tmp_path: Path) -> None:
    made = mbtiles(
        tmp_path / "v.mbtiles",
        {(0, 0, 0): gzip.compress(b"a tile"), (1, 0, 0): gzip.compress(b"\0" * 50_000_000)},
        format="pbf",
        json='{"vector_layers": [{"id": "water"}, {"id": 3}, 7, {"id": "roads"}]}',
    )
    tiles = open_tiles(made)
    assert (tiles.about.kind, tiles.about.layers) == ("vector", ("water", "roads"))
    assert tiles.tile(0, 0, 0) == (b"a tile", "application/x-protobuf")
    with pytest.raises(InputError, match="larger than 4 MB unpacked"):
        tiles.tile(1, 0, 0)
    tiles.close()


@pytest.mark.parametrize(
    "data",
    [
        b"<svg xmlns='http://www.w3.org/2000/svg'><script>alert(1)</script></svg>",
        b"<!doctype html><script>alert(1)</script>",
        b"",
        b"RIFF0000WAVE",
        PNG + b"\0" * 4_000_001,
    ],
)
def test_a_tile_that_is_no_picture_is_refused(data: bytes, tmp_path: Path) -> None:
    made = mbtiles(tmp_path / "a.mbtiles", {(0, 0, 0): PNG, (1, 0, 0): data}, format="png")
    tiles = open_tiles(made)
    with pytest.raises(InputError) as refused:
        tiles.tile(1, 0, 0)
    assert "\n" not in str(refused.value)
    for place in ((-1, 0, 0), (1, 2, 0), (1, 0, -1), (25, 0, 0), (2**40, 0, 0)):
        with pytest.raises(InputError, match="there is no tile"):
            tiles.tile(*place)
    tiles.close()


def test_a_view_that_never_ends_is_broken_off(tmp_path: Path) -> None:
    path = mbtiles(tmp_path / "a.mbtiles", {(0, 0, 0): PNG}, format="png")
    with sqlite3.connect(path) as base:
        base.execute("ALTER TABLE tiles RENAME TO kept")
        base.execute(
            "CREATE VIEW tiles AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
            " SELECT i AS zoom_level, i AS tile_column, i AS tile_row, x'00' AS tile_data FROM n"
        )
    base.close()
    with pytest.raises(InputError, match="interrupted"):
        open_tiles(path)


def spoilt(name: str) -> bytes:
    huge = struct.pack("<Q", 2**63)
    return {
        "empty": b"",
        "text": b"a map",
        "cut": ARCHIVE[:100],
        "version": ARCHIVE[:7] + b"\x02" + ARCHIVE[8:],
        "root": ARCHIVE[:8] + huge + ARCHIVE[16:],
        "length": ARCHIVE[:16] + huge + ARCHIVE[24:],
        "compression": ARCHIVE[:97] + b"\x04" + ARCHIVE[98:],
        "type": ARCHIVE[:99] + b"\x09" + ARCHIVE[100:],
        "zooms": ARCHIVE[:100] + b"\x09\x02" + ARCHIVE[102:],
        "base": b"SQLite format 3\0" + b"\0" * 200,
    }[name]


@pytest.mark.parametrize(
    "name",
    ["empty", "text", "cut", "version", "root", "length", "compression", "type", "zooms", "base"],
)
@pytest.mark.parametrize("ending", [".pmtiles", ".mbtiles", ".png"])
def test_a_file_that_is_none_is_refused_in_a_line(name: str, ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"map{ending}"
    path.write_bytes(spoilt(name))
    with pytest.raises(InputError) as refused:
        open_tiles(path)
    assert "\n" not in str(refused.value)


def test_what_is_spoilt_anywhere_is_read_or_refused(archive: Path) -> None:
    draw = random.Random(3)
    for _ in range(300):
        data = bytearray(ARCHIVE)
        for _ in range(draw.randint(1, 4)):
            data[draw.randrange(8, len(data))] = draw.randrange(256)
        archive.write_bytes(bytes(data))
        try:
            tiles = open_tiles(archive)
        except InputError:
            continue
        for place in COLOURS:
            with suppress(InputError):
                tiles.tile(*place)
        tiles.close()


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        open_tiles(tmp_path / "none.pmtiles")
    (tmp_path / "folder.mbtiles").mkdir()
    with pytest.raises(InputError, match="cannot be read"):
        open_tiles(tmp_path / "folder.mbtiles")
