"""Writes a bill of materials of what is installed beside this Python, as CycloneDX 1.5.

    python tools/sbom.py FILE.cdx.json

Each distribution has its name, version, package URL and licence, as it says of itself, and what it
requires of the others. No time and no random number are in it: the same installation gives the same
file.
"""

from __future__ import annotations

import json
import re
import sys
from importlib import metadata
from pathlib import Path

_REQUIRED = re.compile(r"^\s*([A-Za-z0-9][A-Za-z0-9._-]*)")


def canonical(name: str) -> str:
    """A name as package URLs have it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def component(one: metadata.Distribution) -> dict[str, object]:
    """A distribution, as CycloneDX has it."""
    name, version = canonical(one.metadata["Name"]), one.version
    found: dict[str, object] = {
        "type": "library",
        "bom-ref": f"pkg:pypi/{name}@{version}",
        "name": name,
        "version": version,
        "purl": f"pkg:pypi/{name}@{version}",
    }
    expression = one.metadata.get("License-Expression")
    text = (one.metadata.get("License") or "").strip().split("\n")[0][:100]
    classified = [
        line.rpartition(" :: ")[2]
        for line in one.metadata.get_all("Classifier") or []
        if line.startswith("License :: ")
    ]
    if expression:
        found["licenses"] = [{"expression": expression}]
    elif text or classified:
        found["licenses"] = [{"license": {"name": text or "; ".join(classified)}}]
    return found


def bill() -> dict[str, object]:
    """All of them, each once, in the order of their names."""
    distributions = {canonical(one.metadata["Name"]): one for one in metadata.distributions()}
    refs = {name: f"pkg:pypi/{name}@{one.version}" for name, one in distributions.items()}
    requires = {
        name: sorted(
            {
                refs[canonical(match[1])]
                for line in one.requires or []
                if "extra ==" not in line
                and (match := _REQUIRED.match(line))
                and canonical(match[1]) in refs
            }
        )
        for name, one in distributions.items()
    }
    content: dict[str, object] = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "components": [component(distributions[name]) for name in sorted(distributions)],
        "dependencies": [
            {"ref": refs[name], "dependsOn": requires[name]} for name in sorted(distributions)
        ],
    }
    if "sightline" in distributions:
        own = {**component(distributions["sightline"]), "type": "application"}
        content["metadata"] = {"component": own}
    return content


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit("give the file: python tools/sbom.py FILE.cdx.json")
    Path(sys.argv[1]).write_text(json.dumps(bill(), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
