"""Puts the commands with their options into the documentation, as the program itself has them."""

from __future__ import annotations

from typing import Any

import typer
from typer.cli import get_docs_for_click

from sightline.cli import app

MARK = "<!-- commands -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the mark by all commands; called by MkDocs for every page."""
    if MARK not in markdown:
        return markdown
    group: Any = typer.main.get_command(app)
    context = typer.Context(group, info_name="sightline")
    parts = []
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        parts.append(
            get_docs_for_click(obj=command, ctx=context, indent=1, call_prefix="sightline")
        )
    return markdown.replace(MARK, "\n".join(parts))
