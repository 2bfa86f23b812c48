"""A headless Chromium, driven over its own protocol with the library for WebSockets alone."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome", "chromium-headless-shell")
_OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    # Without a graphics card.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
_CODES = {"Tab": 9, "Enter": 13, "Escape": 27, " ": 32, "Delete": 46}
_CODES |= {f"Arrow{name}": 37 + i for i, name in enumerate(("Left", "Up", "Right", "Down"))}


class Browser:
    """A page of a browser."""

    def __init__(self, stream) -> None:
        self._stream = stream
        self._numbers = itertools.count(1)
        self.requests: list[str] = []
        self.complaints: list[str] = []
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._stream.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            said = json.loads(self._stream.recv(timeout=60.0))
            if said.get("id") == number:
                assert "error" not in said, said
                return said["result"]
            self._note(said)

    def _note(self, said: dict[str, Any]) -> None:
        what, told = said.get("method"), said.get("params", {})
        if what == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        elif what == "Network.webSocketCreated":
            self.requests.append(told["url"])
        elif what == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(told["exceptionDetails"])[:500])
        elif what == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning"):
            self.complaints.append(json.dumps(told["args"])[:500])
        elif what == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.complaints.append(json.dumps(told["entry"])[:500])

    def evaluate(self, code: str) -> Any:
        """The value of an expression, or of its promise."""
        done = self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def until(self, code: str, within_s: float = 60.0) -> Any:
        deadline = time.monotonic() + within_s
        while not (value := self.evaluate(code)):
            assert time.monotonic() < deadline, (code, self.complaints)
            time.sleep(0.05)
        return value

    def size(self, width: int, height: int, *, mobile: bool = False) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if mobile else 1,
            mobile=mobile,
        )

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        self.until("document.documentElement?.dataset.ready === 'true'")

    def open_anew(self, url: str) -> None:
        """Open a page when the one before is gone, and forget what that asked for and said."""
        # It may still be asking a server that has ended.
        self.call("Page.navigate", url="about:blank")
        self.until("location.href === 'about:blank'")
        self.complaints.clear()
        self.requests.clear()
        self.open(url)

    def screenshot(self, path: Path) -> None:
        done = self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(done["data"]))

    def press(self, key: str, *, shift: bool = False, ctrl: bool = False) -> None:
        modifiers = 8 * shift + 2 * ctrl
        text = {"text": key} if len(key) == 1 and not ctrl else {}
        if key == "Enter":
            text = {"text": "\r"}
        code = {"windowsVirtualKeyCode": _CODES[key]} if key in _CODES else {}
        told: dict[str, Any] = {"key": key, "modifiers": modifiers, **code}
        self.call("Input.dispatchKeyEvent", type="keyDown", **told, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **told)

    def type(self, text: str) -> None:
        """Put a text where the focus is, as pasting does."""
        self.call("Input.insertText", text=text)

    def click(self, x: float, y: float) -> None:
        self.mouse("mousePressed", x, y)
        self.mouse("mouseReleased", x, y)

    def drag(self, *places: tuple[float, float]) -> None:
        """Press the mouse at the first place, and let it go at the last."""
        self.mouse("mouseMoved", *places[0], held=False)
        self.mouse("mousePressed", *places[0])
        for place in places[1:]:
            self.mouse("mouseMoved", *place)
        self.mouse("mouseReleased", *places[-1])

    def mouse(self, kind: str, x: float, y: float, *, held: bool = True) -> None:
        button = "left" if held else "none"
        buttons = int(held and kind != "mouseReleased")
        self.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=x,
            y=y,
            button=button,
            buttons=buttons,
            clickCount=int(held),
        )

    def touch(self, kind: str, *places: tuple[float, float]) -> None:
        """Fingers: touchStart and touchMove with all that are down, touchEnd without any."""
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
        self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """A browser with a profile in a folder; the test is skipped where there is none."""
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(_NAMES)} is on the path")
    profile = folder / "profile"
    with subprocess.Popen(
        [found, *_OPTIONS, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            yield from _page(profile, process)
        finally:
            process.terminate()
            process.wait(20)


def _page(profile: Path, process: subprocess.Popen[bytes]) -> Iterator[Browser]:
    told = profile / "DevToolsActivePort"
    deadline = time.monotonic() + 60.0
    while not told.exists() or told.read_text().count("\n") < 1:
        if process.poll() is not None or time.monotonic() > deadline:
            pytest.skip("the browser does not start here")
        time.sleep(0.05)
    port, path = told.read_text().split("\n")[:2]
    with connect(f"ws://127.0.0.1:{port}{path}", proxy=None, max_size=None) as stream:
        # Of the browser itself; the page's own stream has its number in the path.
        stream.send(json.dumps({"id": 0, "method": "Target.getTargets"}))
        while "result" not in (said := json.loads(stream.recv(timeout=60.0))):
            pass
        (page,) = (one for one in said["result"]["targetInfos"] if one["type"] == "page")
        url = f"ws://127.0.0.1:{port}/devtools/page/{page['targetId']}"
        with connect(url, proxy=None, max_size=None) as own:
            yield Browser(own)
