"""Ask `sightline live --serve` in the same container how it is: 0 well, 1 not.

    python3 health.py [PORT]

The token is that of SIGHTLINE_TOKEN, or of the file that SIGHTLINE_TOKEN_FILE names.
"""

from __future__ import annotations

import os
import sys
import urllib.request
from pathlib import Path


def main() -> int:
    port = int(sys.argv[1]) if len(sys.argv) > 1 else 8080
    token = os.environ.get("SIGHTLINE_TOKEN", "")
    file = os.environ.get("SIGHTLINE_TOKEN_FILE")
    if file:
        token = Path(file).read_text(encoding="utf-8").splitlines()[0].strip()
    asked = urllib.request.Request(f"http://127.0.0.1:{port}/healthz")
    if token:
        asked.add_header("Authorization", f"Bearer {token}")
    try:
        with urllib.request.urlopen(asked, timeout=4.0) as answer:
            return 0 if answer.status == 200 else 1
    except OSError as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
