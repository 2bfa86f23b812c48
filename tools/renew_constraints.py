"""Write constraints.txt anew: the newest versions of everything that fit together.

Nothing is installed: pip resolves the package with its extras, all dependency groups and what
builds it, and says what it would install.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
HEADER = """\
# The exact version of everything that is installed, so that an install today and in a year are
# the same. For Linux and Python 3.11 to 3.14. Written by `make constraints`; do not edit.
"""


OLDEST = (3, 11)


def main() -> None:
    if sys.version_info[:2] != OLDEST:
        # What the oldest Python can install the others can as well; the reverse does not hold.
        sys.exit("run this with Python {}.{}".format(*OLDEST))
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)
    groups = project["dependency-groups"]
    extras = ",".join(project["project"]["optional-dependencies"])
    # Hatchling builds an editable install with the help of editables; what has no wheel is built
    # by setuptools.
    builders = ["pip", "editables", "setuptools", *project["build-system"]["requires"]]
    wanted = [*builders, f".[{extras}]"]
    for group in groups:
        wanted += ["--group", group]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        resolve = ["install", "--quiet", "--dry-run", "--ignore-installed", "--report", report]
        subprocess.run([sys.executable, "-m", "pip", *resolve, *wanted], cwd=ROOT, check=True)
        installed = json.loads(report.read_text(encoding="utf-8"))["install"]
    versions = {item["metadata"]["name"]: item["metadata"]["version"] for item in installed}
    own = project["project"]["name"]
    lines = [f"{name}=={versions[name]}\n" for name in sorted(versions, key=str.lower)]
    pins = "".join(line for line in lines if not line.startswith(f"{own}=="))
    (ROOT / "constraints.txt").write_text(HEADER + pins, encoding="utf-8")


if __name__ == "__main__":
    main()
