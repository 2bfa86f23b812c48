"""What is refused as a video or a picture is named, with what would mend it."""

from __future__ import annotations

import wave
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sightline.errors import InputError
from sightline.tally import Tally
from sightline.video import frames, video_info
from sightline.video.pictures import read_picture

GREY = Image.fromarray(np.full((48, 64, 3), 120, np.uint8))


def saved(kind: str, **options: object) -> Callable[[Path], None]:
    return lambda path: GREY.save(path, format=kind, **options)


def content(data: bytes) -> Callable[[Path], None]:
    return lambda path: (path.write_bytes(data), None)[1]


def animated(path: Path) -> None:
    GREY.save(path, format="GIF", save_all=True, append_images=[GREY.rotate(90), GREY])


def archive(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a.mp4", b"video")


def sound(path: Path) -> None:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(8000)
        file.writeframes(bytes(16000))


def heic(path: Path) -> None:
    path.write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(200))


VIDEOS = [
    ("a.gif", animated, "is a GIF picture, not a video; convert it to MP4"),
    # What is in the file counts, not its name.
    ("a.mp4", animated, "is a GIF picture, not a video; convert it to MP4"),
    ("a.jpg", saved("JPEG"), "is a JPEG picture, not a video; give the folder that it is in"),
    ("a.mov", saved("JPEG"), "is a JPEG picture, not a video; give the folder that it is in"),
    ("a.png", saved("PNG"), "is a PNG picture, not a video; give the folder that it is in"),
    ("a.webp", saved("WEBP"), "is a WebP picture, not a video; give the folder that it is in"),
    ("a.tif", saved("TIFF"), "is a TIFF picture, not a video; give the folder that it is in"),
    ("a.bmp", saved("BMP"), "is a BMP picture, not a video; give the folder that it is in"),
    ("a.jp2", saved("JPEG2000"), "is a JPEG 2000 picture, not a video; convert it to JPEG or PNG"),
    ("a.heic", heic, "is a HEIC picture, not a video; convert it to JPEG or PNG"),
    ("a.eps", saved("EPS"), "is a PostScript document, not a video; convert it to JPEG or PNG"),
    ("a.pdf", saved("PDF"), "is a PDF document, not a video; convert it to JPEG or PNG"),
    (
        "a.m3u8",
        content(b"#EXTM3U\n#EXTINF:4,\na.ts\n"),
        "is a playlist, not a video; give the addr",
    ),
    ("a.mpd", content(b'<?xml version="1.0"?>\n<MPD></MPD>'), "is a playlist, not a video; give"),
    ("a.txt", content(b"ffconcat version 1.0\nfile a.mp4\n"), "is a playlist, not a video; give"),
    ("a.sdp", content(b"v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\n"), "is a description of a stream"),
    ("a.mp4", content(b"<!DOCTYPE html><html>404</html>"), "is a web page, not a video; a server"),
    ("a.mp4", content(b"version https://git-lfs.github.com/spec/v1\n"), "is a pointer of Git LFS"),
    ("a.zip", archive, "is a ZIP archive, not a video; unpack it"),
    ("a.wav", sound, "is a sound, not a video; give the video"),
    ("a.rm", content(b".RMF\0\0\0\x12" + bytes(64)), "is a RealMedia video, .* convert it to MP4"),
    ("a.xyz", content(b"nothing known " * 20), "if it plays elsewhere, convert it to MP4"),
]


@pytest.mark.parametrize(("name", "make", "message"), VIDEOS)
def test_what_is_no_video_is_named(
    tmp_path: Path, name: str, make: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / name
    make(path)
    for read in (lambda: list(frames(path)), lambda: video_info(path)):
        with pytest.raises(InputError, match=message) as refused:
            read()
        assert str(refused.value).startswith(f"{path}: ")
        assert "\n" not in str(refused.value)


PICTURES = [
    (animated, "is a GIF picture; read are JPEG, .* convert it to JPEG or PNG"),
    (saved("JPEG2000"), "is a JPEG 2000 picture; read are JPEG, .* convert it to JPEG or PNG"),
    (heic, "is a HEIC picture; read are JPEG, .* convert it to JPEG or PNG"),
    (saved("EPS"), "is a PostScript document; read are JPEG, .* convert it to JPEG or PNG"),
    (
        content(b"version https://git-lfs.github.com/spec/v1\n"),
        "is a pointer of Git LFS; .* lfs pull",
    ),
    (content(b"<html>404</html>"), "is a web page; .* download that again"),
    (content(b"\x89PNG\r\n\x1a\n cut short"), "is no picture that can be read, or is damaged"),
]


@pytest.mark.parametrize(("make", "message"), PICTURES)
def test_what_is_no_picture_is_named(
    tmp_path: Path, make: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / "000001.png"
    make(path)
    for read in (lambda: read_picture(path), lambda: list(frames(tmp_path))):
        with pytest.raises(InputError, match=message) as refused:
            read()
        assert str(refused.value).startswith(f"{path}: ")


def test_a_folder_without_pictures_that_are_read(tmp_path: Path) -> None:
    for number in range(3):
        GREY.save(tmp_path / f"{number:06d}.gif")
    with pytest.raises(
        InputError, match=r"but pictures \(000000\.gif and 2 more\); convert them to JPEG or PNG"
    ):
        list(frames(tmp_path))
    # Beside others they are not lost without a word.
    GREY.save(tmp_path / "000003.png")
    tally = Tally(tmp_path)
    assert [frame.index for frame in frames(tmp_path, tally=tally)] == [3]
    assert tally.reasons() == "3 pictures of a kind that is not read (000000.gif)"
    videos = tmp_path / "videos"
    videos.mkdir()
    (videos / "a.mp4").touch()
    with pytest.raises(InputError, match=r"but videos \(a\.mp4\); give one of them"):
        list(frames(videos))
