"""The server of the page on which boxes are drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sightline.web.server import PageServer

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from sightline.web.workbench import Workbench


class DrawServer(PageServer):
    """Lets boxes and control points be drawn in a browser.

    Examples:
        >>> from sightline.web.draw_server import DrawServer
        >>> DrawServer("0.0.0.0:8081")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        sightline.errors.InputError: serving at 0.0.0.0:8081 shows the recording to the network...
    """

    def __init__(self, address: str, *, token: str | None = None) -> None:
        """Check what was asked for; `serve` begins.

        Args:
            address: ``HOST:PORT``; port 0 takes a free one.
            token: What visitors have to show; needed where others than this machine reach the
                address.

        Raises:
            InputError: The address is none or needs a token, or the libraries are not installed.
        """
        super().__init__(address, token=token, shows="the recording")
        self._bench: Workbench | None = None

    def serve(self, bench: Workbench) -> None:
        """Begin to serve; returns when the page can be opened.

        Args:
            bench: What is shown and changed.

        Raises:
            InputError: The address cannot be had.
        """
        self._bench = bench
        self.start()

    def _build_app(self) -> ASGIApp:
        from sightline.web.draw_app import build_draw_app

        assert self._bench is not None, "serve() is given it"
        return build_draw_app(self._bench)
