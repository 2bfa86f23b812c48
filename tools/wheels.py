"""Whether the base installation has a wheel of everything for another processor.

    python tools/wheels.py [--platform manylinux_2_28_aarch64] [--python 3.11]

Asks pip to resolve what the package needs, as `constraints.txt` pins it, from wheels alone for that
platform, and installs nothing. Fails where one is missing, with pip's own words.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
# A wheel for an older glibc serves as well.
OLDER = {"manylinux_2_28_aarch64": ("manylinux_2_27_aarch64", "manylinux_2_17_aarch64")}
ALIASES = ("manylinux2014_aarch64",)


def resolved(platform: str, python: str) -> list[tuple[str, str, str]]:
    """Name, version and file of each wheel.

    Raises:
        SystemExit: There is none of something.
    """
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wanted = content["project"]["dependencies"]
    accepted = [platform, *OLDER.get(platform, ()), *ALIASES]
    with TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        done = subprocess.run(
            [
                *(sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed"),
                *("--quiet", "--disable-pip-version-check", "--only-binary", ":all:"),
                *(word for one in accepted for word in ("--platform", one)),
                *("--python-version", python, "--implementation", "cp"),
                *("--target", str(Path(folder) / "there"), "--report", str(report)),
                *("--constraint", str(ROOT / "constraints.txt"), *wanted),
            ],
            check=False,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise SystemExit(done.stderr.strip())
        installed = json.loads(report.read_text(encoding="utf-8"))["install"]
    return sorted(
        (
            one["metadata"]["name"],
            one["metadata"]["version"],
            one["download_info"]["url"].rpartition("/")[2],
        )
        for one in installed
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--platform", default="manylinux_2_28_aarch64")
    parser.add_argument("--python", default="3.11")
    arguments = parser.parse_args()
    found = resolved(arguments.platform, arguments.python)
    for name, version, file in found:
        kind = "any processor" if file.endswith("-any.whl") else file.rpartition("-")[2][:-4]
        print(f"{name:28}{version:12}{kind}")
    print(f"{len(found)} packages, each with a wheel for {arguments.platform}")


if __name__ == "__main__":
    main()
