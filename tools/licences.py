"""Lists what the base installation brings, with its licences, and refuses copyleft.

    python tools/licences.py

The packages are those that `pyproject.toml` asks for without an extra, and what they ask for, as
installed beside this Python. What a package says of itself is taken: its licence expression, else
the field for its licence, else its classifiers. No metadata tell of the libraries of others that
wheels hold; those that are known to be copyleft are told, and none is refused for them.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable, Iterable
from importlib import metadata
from importlib.metadata import Distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]

ALLOWED = {
    # One file of certificates that is used as it is; the MPL asks for no more than that file.
    "certifi": "MPL-2.0",
}
"""Packages whose weak copyleft was looked at, and the licence that they had then."""

_COPYLEFT = re.compile(
    r"\b[AL]?GPL|General Public Licen[cs]e|\bEUPL|European Union Public|\bMPL|Mozilla Public"
    r"|\bCeCILL|\bOSL-|\bEPL|Eclipse Public|\bCDDL|\bSSPL|\bCC-BY-SA|\bCPAL|\bMS-RL",
    re.IGNORECASE,
)
_LONGEST = 60
BUNDLED = {
    "libavcodec": "LGPL-2.1-or-later, or GPL where x264 or x265 is beside it",
    "libgfortran": "GPL-3.0 with the exception for runtime libraries",
    "libgmp": "LGPL-3.0-or-later",
    "libgnutls": "LGPL-2.1-or-later",
    "libmp3lame": "LGPL-2.0-or-later",
    "libquadmath": "LGPL-2.1-or-later",
    "libx264": "GPL-2.0-or-later",
    "libx265": "GPL-2.0-or-later",
}
"""Copyleft libraries that wheels are known to hold."""


def closure(
    requirements: Iterable[str], find: Callable[[str], Distribution] = metadata.distribution
) -> dict[str, Distribution]:
    """All packages that requirements bring, by name.

    Args:
        requirements: As `pyproject.toml` has them.
        find: The installed package of a name.
    """
    found: dict[str, Distribution] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = [(Requirement(one), frozenset({""})) for one in requirements]
    while waiting:
        requirement, extras = waiting.pop()
        marker = requirement.marker
        if marker is not None and not any(marker.evaluate({"extra": one}) for one in extras):
            continue
        name = canonicalize_name(requirement.name)
        wanted = frozenset({"", *requirement.extras})
        if (name, wanted) not in seen:
            seen.add((name, wanted))
            found[name] = find(name)
            waiting += [(Requirement(one), wanted) for one in found[name].requires or []]
    return dict(sorted(found.items()))


def licence(package: Distribution) -> str:
    """What a package says of its licence; empty where it says nothing."""
    about = package.metadata
    stated = about.get("License-Expression")
    if stated:
        return str(stated)
    kinds = [one for one in about.get_all("Classifier") or [] if one.startswith("License ::")]
    named = " AND ".join(one.rpartition(" :: ")[2] for one in kinds)
    text = str(about.get("License") or "").strip()
    # Some have the whole text in the field; then its name is the classifier, or its first line.
    if text and len(text) <= _LONGEST and "\n" not in text:
        hidden = _COPYLEFT.search(named) and not _COPYLEFT.search(text)
        return f"{text} AND {named}" if hidden else text
    return named or next((line.strip(" =") for line in text.splitlines() if line.strip(" =")), "")


def is_copyleft(stated: str) -> bool:
    """Whether a licence asks that what is made with it be under it as well.

    Of alternatives (``OR``) one that is free of it is enough; in parentheses none is, so that
    somebody looks.
    """
    if "(" in stated:
        return bool(_COPYLEFT.search(stated))
    return all(_COPYLEFT.search(one) for one in re.split(r"\bOR\b", stated))


def bundled(package: Distribution) -> list[str]:
    """Copyleft libraries that are known to be in a wheel."""
    names = {Path(str(file)).name for file in package.files or []}
    known = {
        library for library in BUNDLED if any(re.match(rf"{library}[.-]", name) for name in names)
    }
    return sorted(known)


def refused(packages: dict[str, Distribution]) -> dict[str, str]:
    """What each package is refused for, by its name."""
    reasons = {}
    for name, package in packages.items():
        stated = licence(package)
        if not stated:
            reasons[name] = "says nothing of its licence"
        elif is_copyleft(stated) and ALLOWED.get(name) != stated:
            reasons[name] = f"is under {stated}"
    return reasons


def main() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = closure(project["project"]["dependencies"])
    for name, package in packages.items():
        print(f"{name:24}{package.version:16}{licence(package)[:_LONGEST]}")
    for name, package in packages.items():
        for library in bundled(package):
            print(f"note: the wheel of {name} holds {library} ({BUNDLED[library]})")
    wrong = refused(packages)
    for name, reason in wrong.items():
        print(f"error: {name} {reason}", file=sys.stderr)
    if wrong:
        sys.exit(1)
    print(f"{len(packages)} packages; none says that it is copyleft but {', '.join(ALLOWED)} (MPL)")


if __name__ == "__main__":
    main()
