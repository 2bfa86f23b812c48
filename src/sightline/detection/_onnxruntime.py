"""Import of ONNX Runtime without its telemetry.

Its wheels for Linux (1.32, for one) write an identifier under ``~/.cache/Microsoft`` as soon as
they are loaded, and some seconds later look for ``mobile.events.data.microsoft.com``, to send what
they have seen. ``onnxruntime.disable_telemetry_events()`` stops neither. What does is a variable of
the environment, and only if it is there before the library is loaded.
"""

from __future__ import annotations

import os
from typing import Any


def load() -> Any:
    """Import ``onnxruntime`` with its telemetry switched off.

    Where somebody loaded it before, that comes too late.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime  # noqa: TID251

    # 1.32 does not heed it; another release may.
    onnxruntime.disable_telemetry_events()
    return onnxruntime
