"""What a file or an address leads to: the file itself, and what its kind of stream needs."""

from __future__ import annotations

import os
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from videos import write

from sightline.errors import InputError
from sightline.video import containers, frames, video_info

TIMES = [0, 100, 200, 300, 400]


@pytest.fixture
def port() -> Iterator[int]:
    """Of a server to which nothing connects."""
    connections = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.1)
        stop = threading.Event()

        def listen() -> None:
            while not stop.is_set():
                try:
                    connections.append(server.accept())
                except TimeoutError:
                    continue

        thread = threading.Thread(target=listen)
        thread.start()
        yield server.getsockname()[1]
        stop.set()
        thread.join()
    assert not connections


PLAYLISTS = {
    "a.m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n{url}\n#EXT-X-ENDLIST\n",
    "a.mp4": "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n{url}\n#EXT-X-ENDLIST\n",
    "a.ffconcat": "ffconcat version 1.0\nfile '{url}'\n",
    "a.mkv": "ffconcat version 1.0\nfile '{url}'\n",
    "a.sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\n"
    "m=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
    "a.asx": '<asx version="3.0"><entry><ref href="{url}"/></entry></asx>',
    "a.mpd": '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static">'
    '<Period><AdaptationSet><Representation id="1" bandwidth="1"><BaseURL>{url}</BaseURL>'
    "</Representation></AdaptationSet></Period></MPD>",
    "a.ram": "{url}\n",
    "a.txt": "{url}\n",
}


@pytest.mark.parametrize("name", sorted(PLAYLISTS))
@pytest.mark.parametrize("to_server", [False, True])
def test_a_file_leads_to_nothing_else(
    tmp_path: Path, name: str, port: int, to_server: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "secret.ts", TIMES)
    url = f"http://127.0.0.1:{port}/secret.ts" if to_server else "secret.ts"
    (tmp_path / name).write_text(PLAYLISTS[name].format(url=url))
    for read in (frames, video_info):
        with pytest.raises(InputError, match=name.replace(".", r"\.")):
            read(name)


@pytest.mark.parametrize(
    "name",
    [
        "concat:secret.ts|secret.ts",
        "subfile,,start,0,end,99,,:secret.ts",
        "pipe:0",
        "file:secret.ts",
        "async:secret.ts",
        "data:video/mp4;base64,AAAA",
        "x\0y",
        "file:///etc/hosts",
        "lavfi://testsrc",
        "concat://secret.ts",
        "gopher://127.0.0.1/",
    ],
)
def test_a_name_is_a_path_or_the_address_of_a_stream(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "secret.ts", TIMES)
    with pytest.raises(InputError, match=r"there is no such|is no address of a stream"):
        frames(name)


@pytest.mark.parametrize("name", ["%d.mp4", "-y.mp4", "a:b.mp4", "http:x.mp4", "a|b.mp4", "é.mp4"])
def test_names_of_files_are_names(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(write(tmp_path / "whole.mp4", TIMES), name)
    assert len(list(frames(name))) == 5
    assert len(video_info(name).presentation_s) == 5


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/stdin", "fifo"])
def test_what_is_no_regular_file(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("fifo")
    with pytest.raises(InputError, match="is no regular file"):
        frames(name)


Serve = Callable[[dict[str, bytes]], str]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Serves files by their names, and tells its address."""
    servers = []

    def start(files: dict[str, bytes]) -> str:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                data = files.get(self.path)
                self.send_response(404 if data is None else 200)
                self.send_header("Content-Length", str(len(data or b"")))
                self.end_headers()
                self.wfile.write(data or b"")

            def log_message(self, *_args: object) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        servers.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def test_a_playlist_on_the_web_never_leads_to_a_file(tmp_path: Path, serve: Serve) -> None:
    secret = write(tmp_path / "secret.ts", TIMES)
    playlist = PLAYLISTS["a.m3u8"].format(url=f"file://{secret}").encode()
    address = serve({"/a.m3u8": playlist})
    with pytest.raises(InputError):
        list(frames(f"{address}/a.m3u8"))


def test_a_video_on_the_web(tmp_path: Path, serve: Serve) -> None:
    path = write(tmp_path / "a.mp4", TIMES)
    address = serve({"/a.mp4": path.read_bytes()})
    times = [frame.time_utc_s for frame in frames(f"{address}/a.mp4", start_utc_s=7.0)]
    assert times == pytest.approx([7.0, 7.1, 7.2, 7.3, 7.4])
    with pytest.raises(InputError, match="404"):
        frames(f"{address}/b.mp4")


def test_a_video_has_a_largest_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.mp4", TIMES)
    monkeypatch.setattr(containers, "MOST_PIXELS", 64 * 48 - 1)
    with pytest.raises(InputError, match="64 x 48 px are too large"):
        frames(path)
