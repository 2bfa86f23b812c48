"""Ways to spoil containers: their bytes, and the parts that their own checks would not let pass."""

from __future__ import annotations

import io
import json
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pyarrow as pa
import pyarrow.parquet as pq

from fuzz.texts import NUMBERS, WORDS, Mutator, Rng, pick
from fuzz.trees import mutate_tree

_INTERESTING = (0, 1, -1, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, -(2**31), 2**24, 10**6)
_LARGEST_PX = 60_000


def _at(rng: Rng, content: bytes) -> int:
    """A position, near the beginning more often than not: headers stand there."""
    if not content:
        return 0
    if rng.random() < 0.5:
        return int(rng.integers(min(len(content), 512)))
    return int(rng.integers(len(content)))


def flip(rng: Rng, content: bytes) -> bytes:
    """Some bits are turned."""
    spoilt = bytearray(content)
    for _ in range(int(2 ** rng.uniform(0.0, 6.0)) if content else 0):
        spoilt[_at(rng, content)] ^= 1 << int(rng.integers(8))
    return bytes(spoilt)


def put(rng: Rng, content: bytes) -> bytes:
    """Some bytes are replaced."""
    spoilt = bytearray(content)
    for _ in range(int(rng.integers(1, 8)) if content else 0):
        spoilt[_at(rng, content)] = int(rng.integers(256))
    return bytes(spoilt)


def size_field(rng: Rng, content: bytes) -> bytes:
    """A number of two, four or eight bytes becomes one at the edge of what it can be."""
    width = (2, 4, 8)[int(rng.integers(3))]
    if len(content) < width:
        return content
    at = min(_at(rng, content), len(content) - width)
    value = _INTERESTING[int(rng.integers(len(_INTERESTING)))] % 2 ** (8 * width)
    order = "big" if rng.random() < 0.5 else "little"
    return content[:at] + value.to_bytes(width, order) + content[at + width :]


def cut(rng: Rng, content: bytes) -> bytes:
    """The end is missing, or now and then the beginning."""
    at = int(rng.integers(len(content) + 1))
    return content[:at] if rng.random() < 0.8 else content[at:]


def lose(rng: Rng, content: bytes) -> bytes:
    """A piece from the middle is missing."""
    at = _at(rng, content)
    return content[:at] + content[at + int(2 ** rng.uniform(0.0, 11.0)) :]


def repeat(rng: Rng, content: bytes) -> bytes:
    """A piece comes twice, or a hundred times."""
    at, length = _at(rng, content), int(2 ** rng.uniform(0.0, 11.0))
    piece = content[at : at + length]
    return content[:at] + piece * int(10 ** rng.uniform(0.3, 2.0)) + content[at + length :]


def move(rng: Rng, content: bytes) -> bytes:
    """A piece stands elsewhere."""
    at, to, length = _at(rng, content), _at(rng, content), int(2 ** rng.uniform(2.0, 10.0))
    piece, rest = content[at : at + length], content[:at] + content[at + length :]
    return rest[:to] + piece + rest[to:]


def blank(rng: Rng, content: bytes) -> bytes:
    """A piece is zeros, ones or noise."""
    at, length = _at(rng, content), int(2 ** rng.uniform(0.0, 11.0))
    length = min(length, len(content) - at)
    filled = (bytes(length), b"\xff" * length, rng.bytes(length))[int(rng.integers(3))]
    return content[:at] + filled + content[at + length :]


def append(rng: Rng, content: bytes) -> bytes:
    """Something follows where nothing should, or the whole comes again."""
    more = (rng.bytes(int(rng.integers(1, 4096))), content, bytes(4096))[int(rng.integers(3))]
    return content + more


BYTES: tuple[Mutator, ...] = (
    *(flip, flip, put, put, size_field, size_field, size_field, cut, lose, repeat, move, blank),
    append,
)
"""For any container."""


def packets(rng: Rng, content: bytes) -> bytes:
    """Packets of a transport stream are lost, come twice, or in another order."""
    rows = [content[i : i + 188] for i in range(0, len(content), 188)]
    how = int(rng.integers(3))
    if how == 0:
        rows = [row for row in rows if rng.random() > 0.05]
    elif how == 1:
        rows = [row for row in rows for _ in range(1 + (rng.random() < 0.05))]
    else:
        at = int(rng.integers(max(len(rows) - 8, 1)))
        rows[at : at + 8] = [rows[at : at + 8][i] for i in rng.permutation(len(rows[at : at + 8]))]
    return b"".join(rows)


_BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"udta", b"edts")


def boxes_of_mp4(rng: Rng, content: bytes) -> bytes:
    """A box of an MP4 has another size or name, or a number in it is another."""
    found: list[int] = []

    def walk(start: int, stop: int) -> None:
        while start + 8 <= stop:
            size = int.from_bytes(content[start : start + 4], "big")
            if size < 8 or start + size > stop:
                return
            found.append(start)
            if content[start + 4 : start + 8] in _BOXES:
                walk(start + 8, start + size)
            start += size

    walk(0, len(content))
    if not found:
        return content
    at = found[int(rng.integers(len(found)))]
    size = int.from_bytes(content[at : at + 4], "big")
    how = int(rng.integers(4))
    if how == 0:
        value = _INTERESTING[int(rng.integers(len(_INTERESTING)))] % 2**32
        return content[:at] + value.to_bytes(4, "big") + content[at + 4 :]
    if how == 1:
        name = content[found[int(rng.integers(len(found)))] + 4 :][:4]
        return content[: at + 4] + name + content[at + 8 :]
    if how == 2:
        return content[:at] + content[at + size :]
    inside = at + 8 + 4 * int(rng.integers(max((size - 8) // 4, 1)))
    value = _INTERESTING[int(rng.integers(len(_INTERESTING)))] % 2**32
    return content[:inside] + value.to_bytes(4, "big") + content[inside + 4 :]


MP4: tuple[Mutator, ...] = (*(boxes_of_mp4,) * 8, *BYTES)
"""For MP4 and QuickTime."""

TS: tuple[Mutator, ...] = (*(packets,) * 4, *BYTES)
"""For MPEG transport streams."""


def picture_size(rng: Rng, content: bytes) -> bytes:
    """A picture says another size of itself, and its checksum agrees."""
    sizes = (0, 1, 63, 65, 1000, 20_000, _LARGEST_PX, 65_535)
    width, height = (sizes[int(rng.integers(len(sizes)))] for _ in range(2))
    if content[:8] == b"\x89PNG\r\n\x1a\n":
        body = b"IHDR" + struct.pack(">II", width, height) + content[24:29]
        return content[:12] + body + zlib.crc32(body).to_bytes(4, "big") + content[33:]
    if content[:2] == b"BM":
        return content[:18] + struct.pack("<ii", width, height) + content[26:]
    start = content.find(b"\xff\xc0")
    if content[:2] == b"\xff\xd8" and start > 0:
        return content[: start + 5] + struct.pack(">HH", height, width) + content[start + 9 :]
    return size_field(rng, content)


def picture_kind(rng: Rng, content: bytes) -> bytes:
    """A PNG of another depth or colour, and its checksum agrees."""
    if content[:8] != b"\x89PNG\r\n\x1a\n":
        return flip(rng, content)
    depth, colour = (1, 2, 4, 8, 16, 3)[int(rng.integers(6))], int(rng.integers(8))
    body = content[12:24] + bytes([depth, colour, *content[26:28], int(rng.integers(2))])
    return content[:12] + body + zlib.crc32(body).to_bytes(4, "big") + content[33:]


PICTURE: tuple[Mutator, ...] = (*(picture_size,) * 4, *(picture_kind,) * 2, *BYTES)
"""For pictures."""


def header(rng: Rng, content: bytes) -> bytes:
    """The header of a safetensors file: shapes, types, places, and the JSON that it carries."""
    length = int.from_bytes(content[:8], "little")
    try:
        tree = json.loads(content[8 : 8 + length])
        about = tree["__metadata__"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return flip(rng, content)
    data = content[8 + length :]
    how = int(rng.integers(4))
    if how < 2:
        try:
            about["content"] = json.dumps(mutate_tree(rng, json.loads(about["content"])))
        except (ValueError, KeyError, TypeError, RecursionError):
            tree = mutate_tree(rng, tree)
    elif how == 2:
        tree = mutate_tree(rng, tree)
    else:
        tree, data = _reshaped(rng, tree, data)
    text = json.dumps(tree).encode("ascii")
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data


def _reshaped(rng: Rng, tree: dict[str, Any], data: bytes) -> tuple[dict[str, Any], bytes]:
    """One tensor with another shape or other values, and the file still whole."""
    names = [name for name in sorted(tree) if isinstance(tree[name], dict) and name[:1] != "_"]
    if not names:
        return tree, data
    name = names[int(rng.integers(len(names)))]
    try:
        shape, (start, stop) = tree[name]["shape"], tree[name]["data_offsets"]
        count = int(np.prod(shape)) if shape else 1
    except (KeyError, TypeError, ValueError):
        return tree, data
    how = int(rng.integers(4))
    if how == 0:
        tree[name]["shape"] = [count]
    elif how == 1:
        tree[name]["shape"] = [1, count] if len(shape) < 2 else shape[::-1]
    elif how == 2 and tree[name].get("dtype") == "F64":
        values = np.frombuffer(data[start:stop], "<f8").copy()
        odd = [np.nan, np.inf, -1.0, 0.0, 1e308, -1e-300, 1e9]
        values[rng.integers(max(values.size, 1), size=min(values.size, 3))] = pick_number(rng, odd)
        data = data[:start] + values.tobytes() + data[stop:]
    else:
        tree[name]["dtype"] = pick(rng, ["F32", "I64", "U8", "BOOL", "F16", "F64", "BF16"])
    return tree, data


def pick_number(rng: Rng, values: list[float]) -> float:
    """One of some numbers."""
    return values[int(rng.integers(len(values)))]


SAFETENSORS: tuple[Mutator, ...] = (*(header,) * 20, *BYTES)
"""For model files."""


def graph(rng: Rng, content: bytes) -> bytes:
    """A network with another shape, type, name, operator, constant or metadata."""
    try:
        model = onnx.load_from_string(content)
    except Exception:
        return flip(rng, content)
    infos = [*model.graph.input, *model.graph.output]
    nodes, stored = model.graph.node, model.graph.initializer
    how = int(rng.integers(9))
    if how == 0 and infos:
        _other_shape(rng, infos[int(rng.integers(len(infos)))])
    elif how == 1 and infos:
        one = infos[int(rng.integers(len(infos)))]
        one.type.tensor_type.elem_type = int(rng.integers(0, 24))
    elif how == 2 and nodes:
        kinds = ["Relu", "Identity", "Loop", "Shape", "NonZero", "TopK", "Nothing", "StringSplit"]
        nodes[int(rng.integers(len(nodes)))].op_type = pick(rng, kinds)
    elif how == 3 and model.metadata_props:
        keys = ["names", "task", "sightline", "classes", "stride", "imgsz"]
        pair = model.metadata_props[int(rng.integers(len(model.metadata_props)))]
        texts = ["{0: 'boat', 5: 'x'}", "{", "[]", "{0: 1}", "__import__('os')", '{"format": 1e9}']
        pair.key, pair.value = pick(rng, keys), pick(rng, [*texts, *NUMBERS[:9], "a" * 9999])
    elif how == 4 and stored:
        one = stored[int(rng.integers(len(stored)))]
        one.data_location = onnx.TensorProto.EXTERNAL
        place = one.external_data.add()
        place.key, place.value = "location", pick(rng, ["/etc/hostname", "../x", "clip.mp4"])
    elif how == 5 and nodes:
        del nodes[int(rng.integers(len(nodes)))]
    elif how == 6:
        model.opset_import[0].version = int(rng.integers(-1, 40))
    elif how == 7 and nodes and nodes[0].attribute:
        one = nodes[0].attribute[0]
        if one.HasField("t"):
            one.t.raw_data = _other_numbers(rng, one.t.raw_data)
    else:
        model.ir_version = int(rng.integers(0, 20))
    return bytes(model.SerializeToString())


def _other_shape(rng: Rng, info: onnx.ValueInfoProto) -> None:
    dims = info.type.tensor_type.shape.dim
    if not dims:
        return
    one = dims[int(rng.integers(len(dims)))]
    if rng.random() < 0.2:
        del dims[int(rng.integers(len(dims)))]
    elif rng.random() < 0.3:
        one.dim_param = pick(rng, ["n", "", "width"])
    else:
        one.dim_value = (0, 1, 2, 3, 5, 64, 1000, 100_000, -1, 2**40)[int(rng.integers(10))]


def _other_numbers(rng: Rng, raw: bytes) -> bytes:
    values = np.frombuffer(raw[: len(raw) // 4 * 4], "<f4").copy()
    odd = [float("nan"), float("inf"), -1e30, 1e30, 0.0, 255.0]
    values[rng.integers(max(values.size, 1), size=min(values.size, 3))] = pick_number(rng, odd)
    return values.tobytes() + raw[len(raw) // 4 * 4 :]


ONNX: tuple[Mutator, ...] = (*(graph,) * 20, *BYTES)
"""For networks."""


def rows(rng: Rng, content: bytes) -> bytes:
    """A Parquet file whose columns have other types, names or values."""
    try:
        found = pq.read_table(pa.BufferReader(content))
    except (pa.ArrowException, OSError):
        return flip(rng, content)
    if not found.num_columns:
        return content
    at = int(rng.integers(found.num_columns))
    name, n = found.column_names[at], found.num_rows
    kinds: list[Callable[[], pa.Array]] = [
        lambda: pa.array([pick(rng, [*NUMBERS, *_WORDS]) for _ in range(n)]),
        lambda: pa.array([None] * n),
        lambda: pa.array([[1.0]] * n),
        lambda: pa.array([{"a": 1}] * n),
        lambda: pa.array([float("nan")] * n),
        lambda: pa.array([b"\xff\x00"] * n),
        lambda: pa.array([2**63] * n, pa.uint64()),
        lambda: pa.array([-(2**62)] * n, pa.timestamp("us")),
        lambda: pa.array([1] * n, pa.duration("ns")),
        lambda: pa.array([True] * n),
        lambda: pa.array(["x"] * n).dictionary_encode(),
        lambda: pa.array([10**9] * n, pa.time64("us")),
        lambda: pa.array([1e308] * n),
    ]
    how = int(rng.integers(6))
    if how == 0:
        found = found.drop_columns([name])
    elif how == 1:
        found = found.append_column(name, found.column(at))
    elif how == 2:
        names = [
            pick(rng, [*_WORDS, "track_id"]) if one == name else one for one in found.schema.names
        ]
        found = found.rename_columns(names)
    elif how == 3:
        found = found.slice(0, int(rng.integers(0, 2)))
    else:
        found = found.set_column(at, name, kinds[int(rng.integers(len(kinds)))]())
    out = io.BytesIO()
    try:
        pq.write_table(found, out)
    except pa.ArrowException:
        return flip(rng, content)
    return out.getvalue()


_WORDS = [word for word in WORDS if word.isprintable() and len(word) < 100]

PARQUET: tuple[Mutator, ...] = (*(rows,) * 14, *BYTES)
"""For Parquet."""


def database(rng: Rng, content: bytes) -> bytes:
    """A GeoPackage in which a statement of SQL has been at work."""
    statements = (
        "DROP TABLE tracks",
        "DELETE FROM tracks",
        "DELETE FROM gpkg_contents",
        "DELETE FROM gpkg_geometry_columns",
        "DELETE FROM gpkg_spatial_ref_sys",
        "DROP TABLE gpkg_contents",
        "UPDATE tracks SET geom = NULL",
        "UPDATE tracks SET geom = x'00'",
        "UPDATE tracks SET geom = 'text'",
        "UPDATE tracks SET geom = (SELECT geom FROM tracks LIMIT 1)",
        "ALTER TABLE tracks DROP COLUMN latitude_deg",
        "ALTER TABLE tracks DROP COLUMN kind",
        'ALTER TABLE tracks RENAME COLUMN time_utc TO "time"',
        "ALTER TABLE tracks RENAME TO points",
        "ALTER TABLE tracks ADD COLUMN label2 BLOB",
        "UPDATE gpkg_contents SET data_type = 'attributes'",
        "UPDATE gpkg_contents SET table_name = 'points'",
        "UPDATE gpkg_geometry_columns SET geometry_type_name = 'POLYGON'",
        "UPDATE gpkg_geometry_columns SET column_name = 'nothing'",
        "UPDATE gpkg_geometry_columns SET srs_id = 32632",
        "PRAGMA application_id = 0",
        "PRAGMA user_version = 99999",
    )
    columns = ("track_id", "time_utc", "latitude_deg", "longitude_deg", "kind", "label")
    column = columns[int(rng.integers(len(columns)))]
    written = f"UPDATE tracks SET {column} = {pick(rng, SQL_VALUES)}"  # noqa: S608
    if rng.random() < 0.5:
        written += f" WHERE fid % {int(rng.integers(1, 6))} = 0"
    asked = written if rng.random() < 0.6 else statements[int(rng.integers(len(statements)))]
    return _executed(rng, content, lambda _: asked)


FACTORS = ("-1", "1e-9", "1e9", "1e300", "1000")
SQL_VALUES = (
    *("NULL", "'x'", "x'ff'", "1e308", "-1", "9223372036854775807", "''", "'nan'", "180.1"),
    *("'2024-13-01T00:00:00Z'", "'9999-12-31T23:59:59Z'", "9e999", "CAST(x'ff' AS TEXT)"),
    *("0", "-9223372036854775808", "1e-320", "'<![CDATA[&'", "char(0, 27, 8238)", "4611686018427"),
)
"""What may stand in a cell of a table of SQLite."""


def any_table(rng: Rng, content: bytes) -> bytes:
    """A database of SQLite in which a cell, a column or a row of any table is another."""

    def asked(connection: sqlite3.Connection) -> str:
        rows = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        table = pick(rng, [name for (name,) in rows])
        columns = [row[1] for row in connection.execute(f'PRAGMA table_info("{table}")')]
        column = pick(rng, columns)
        changed = f'UPDATE OR REPLACE "{table}" SET "{column}" = '  # noqa: S608
        below = f'WHERE "{column}" <= (SELECT avg("{column}") FROM "{table}")'  # noqa: S608
        return pick(
            rng,
            [
                *[f"{changed}{pick(rng, SQL_VALUES)}"] * 5,
                f'{changed}"{column}" * {pick(rng, FACTORS)}',
                f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO "other"',
                f'DELETE FROM "{table}" {below}',  # noqa: S608
                f'DROP TABLE "{table}"',
                "PRAGMA application_id = 0",
                f"PRAGMA user_version = {pick(rng, ('0', '99999', '-1'))}",
            ],
        )

    return _executed(rng, content, asked)


def _executed(rng: Rng, content: bytes, asked: Callable[[sqlite3.Connection], str]) -> bytes:
    """A database in which SQL has been at work; where it cannot be, bits are flipped."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tracks.gpkg"
        path.write_bytes(content)
        connection = sqlite3.connect(path)
        try:
            for (trigger,) in connection.execute(
                "SELECT name FROM sqlite_master WHERE type = 'trigger'"
            ).fetchall():
                # They ask for functions that only GDAL knows.
                connection.execute(f'DROP TRIGGER "{trigger}"')
            connection.execute(asked(connection))
            connection.commit()
        except (sqlite3.Error, UnicodeDecodeError):
            return flip(rng, content)
        finally:
            connection.close()
        return path.read_bytes()


STORE: tuple[Mutator, ...] = (*(any_table,) * 14, *BYTES)
"""For what live keeps."""

GEOPACKAGE: tuple[Mutator, ...] = (*(database,) * 14, *BYTES)
"""For GeoPackages."""
