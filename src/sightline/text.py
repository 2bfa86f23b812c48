"""Texts of others: names and labels, made fit for what they are written to."""

from __future__ import annotations

import json
import re
import unicodedata

_REPLACED = "\N{REPLACEMENT CHARACTER}"
_LONE_SURROGATE = re.compile("[\ud800-\udfff]")
_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
# Controls of eight bits, and what has no width: it hides, joins, or turns what follows round.
_UNSEEN = re.compile(
    "[\x7f-\x9f\xad\u034f\u061c\u070f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f\u202a-\u202e"
    "\u2060-\u206f\u3164\ufeff\uffa0\ufff9-\ufffb\U0001bca0-\U0001bca3\U0001d173-\U0001d17a"
    "\U000e0000-\U000e0fff]"
)
# What a spreadsheet takes for the beginning of a formula, also where it is written full width.
_FORMULA = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")


# Of an address: what stands before the host, and what a query calls by such a name.
_USER = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*://)[^/\s?#]*@")
_SECRET = re.compile(
    r"([?&](?:user(?:name)?|usr|pwd|pass(?:word|wd|phrase)?|token|key|secret|auth)=)[^&\s#]+",
    re.IGNORECASE,
)


def without_secrets(text: str) -> str:
    """A text whose addresses no longer name a user, a password or a token."""
    if "://" not in text:
        return text
    return _SECRET.sub(r"\1***", _USER.sub(r"\1***@", text))


def encodable_text(text: str) -> str:
    """A text without the lone surrogates that no encoding can hold."""
    return _LONE_SURROGATE.sub(_REPLACED, text)


def xml_text(text: str) -> str:
    """A text without control characters: those that no XML can hold, and those of no width.

    Marks that turn the direction of what follows make a name look like another.
    """
    return _UNSEEN.sub(_REPLACED, _NOT_IN_XML.sub(_REPLACED, text))


def json_text(document: str) -> str:
    r"""A JSON document whose characters of no width are written as ``\u202e``: it says the same."""
    return _UNSEEN.sub(lambda found: json.dumps(found[0])[1:-1], encodable_text(document))


def cell_text(text: str) -> str:
    """A text as a cell of a table that a spreadsheet or a terminal may show.

    A spreadsheet runs what begins like a formula, and that may open an address or another program.
    An apostrophe before it makes it a text; `text_of_cell` takes it off again. Control characters
    are replaced, since tables are looked at in terminals.
    """
    kept = xml_text(text)
    return f"'{kept}" if _FORMULA.match(kept) else kept


def text_of_cell(cell: str) -> str:
    """The text that `cell_text` made a cell of."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def terminal_text(text: str) -> str:
    r"""A text whose control characters are shown (as ``\x1b``), not sent to the terminal.

    Others move the cursor, colour what follows, turn its direction or set the window's title. Line
    feeds stay.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if _shown(c) else c.encode("unicode_escape").decode("ascii") for c in text)


def _shown(character: str) -> bool:
    return character == "\n" or character.isprintable() or unicodedata.category(character) == "Zs"


def figure_text(text: str, most: int = 40) -> str:
    """A text as a figure can show it: on one line, shortened, and without control characters."""
    line = " ".join(xml_text(text).split())
    return line if len(line) <= most else f"{line[: most - 1]}\N{HORIZONTAL ELLIPSIS}"
