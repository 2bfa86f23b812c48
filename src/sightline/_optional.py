"""Optional libraries, which come with extras."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from sightline.errors import InputError


def module(name: str, extra: str) -> Any:
    """Import an optional library.

    Args:
        name: The module.
        extra: The extra of this package that brings it.

    Raises:
        InputError: It is not installed; says how to install it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(
            f'{name} is not installed; run: pip install "sightline[{extra}]"'
        ) from error
