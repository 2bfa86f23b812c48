"""Files that are not read as videos or pictures: what they are, and what would mend that."""

from __future__ import annotations

import os
import re
from pathlib import Path

_HEAD_BYTES = 1024

READ_PICTURES = ("JPEG", "PNG", "TIFF", "WebP", "BMP")
"""The kinds of pictures that are read."""

UNREAD_SUFFIXES = {
    ".gif": "GIF",
    **dict.fromkeys((".heic", ".heif", ".hif"), "HEIC"),
    ".avif": "AVIF",
    **dict.fromkeys((".jp2", ".j2k", ".jpx"), "JPEG 2000"),
    ".jxl": "JPEG XL",
    ".jxr": "JPEG XR",
    ".psd": "Photoshop",
    ".svg": "SVG",
    ".exr": "OpenEXR",
    **dict.fromkeys((".ppm", ".pgm", ".pbm", ".pnm"), "Netpbm"),
    ".tga": "TGA",
    ".ico": "icon",
    **dict.fromkeys(
        (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef"), "raw"
    ),
}
"""Endings of pictures that are not read, and their kinds."""

_VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".ts", ".mts", ".webm", ".mpg", ".m4v")
_MP4 = "ffmpeg -i FILE FILE.mp4"
_TO_PICTURES = "convert it to JPEG or PNG"
_AS_PICTURE = "convert it to JPEG or PNG, and give the folder that it is in"
AS_VIDEO = f"convert it to MP4 ({_MP4})"
"""What mends a video that is not read."""
_UNPACK = "unpack it, and give what is in it"
_PLAYLIST = "give the address of its stream, or one of the files that it names"
_AGAIN = "a server may have sent it in place of the file; download that again"
_SOUND = "give the video that it belongs to"

# A pattern at the beginning of a file, what such a file is, and what would mend that.
_KINDS = tuple(
    (re.compile(pattern, re.DOTALL | re.IGNORECASE), what, mend)
    for pattern, what, mend in (
        (rb"\xff\xd8\xff", "a JPEG picture", ""),
        (rb"\x89PNG\r\n\x1a\n", "a PNG picture", ""),
        (rb"RIFF....WEBP", "a WebP picture", ""),
        (rb"BM....\0\0\0\0", "a BMP picture", ""),
        (rb"II[*+]\0|MM\0[*+]", "a TIFF picture", ""),
        (rb"GIF8[79]a", "a GIF picture", f"{AS_VIDEO}, or to pictures in a folder"),
        (rb"....ftyp(hei[cxms]|hev[cxms]|mif1|msf1)", "a HEIC picture", _AS_PICTURE),
        (rb"....ftypavi[fs]", "an AVIF picture", _AS_PICTURE),
        (rb"....ftypcrx ", "a raw picture", _AS_PICTURE),
        (rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51", "a JPEG 2000 picture", _AS_PICTURE),
        (rb"\xff\x0a|\0\0\0\x0cJXL ", "a JPEG XL picture", _AS_PICTURE),
        (rb"8BPS", "a Photoshop picture", _AS_PICTURE),
        (rb"\x76\x2f\x31\x01", "an OpenEXR picture", _AS_PICTURE),
        (rb"P[1-7]\s", "a Netpbm picture", _AS_PICTURE),
        (rb"\0\0\x01\0", "an icon", _AS_PICTURE),
        (rb"%!PS|\xc5\xd0\xd3\xc6", "a PostScript document", _AS_PICTURE),
        (rb"%PDF", "a PDF document", _AS_PICTURE),
        (rb"(<\?xml.*)?\s*<svg", "an SVG picture", _AS_PICTURE),
        (rb"\s*#EXTM3U", "a playlist", _PLAYLIST),
        (rb"(<\?xml.*)?\s*<MPD", "a playlist", _PLAYLIST),
        (rb"ffconcat|\[playlist\]|\[Reference\]", "a playlist", _PLAYLIST),
        (rb"v=0\r?\n", "a description of a stream (SDP)", "give the address of the stream"),
        (rb"\s*(<!doctype html|<html)", "a web page", _AGAIN),
        (rb"version https://git-lfs", "a pointer of Git LFS", "fetch the file: git lfs pull"),
        (rb"PK\x03\x04", "a ZIP archive", _UNPACK),
        (rb"\x1f\x8b", "a gzip archive", _UNPACK),
        (rb"7z\xbc\xaf|Rar!|BZh|\xfd7zXZ|\x28\xb5\x2f\xfd", "an archive", _UNPACK),
        (rb"RIFF....WAVE|ID3|fLaC|\xff[\xfb\xf3\xf2\xf1\xf9]", "a sound", _SOUND),
        (rb"\.RMF", "a RealMedia video", AS_VIDEO),
        (rb"[FCZ]WS[\x01-\x20]", "a Flash film", AS_VIDEO),
        (rb"ARRIRAW|RED[12]|....RED[12]", "a raw video", AS_VIDEO),
        (rb"DICM|.{128}DICM", "a medical picture (DICOM)", _AS_PICTURE),
    )
)


# Pictures within them look like a stream of pictures.
_HOLD_PICTURES = ("a PDF document", "a PostScript document", "a ZIP archive", "a gzip archive")


def kind_of_unread(path: str | os.PathLike[str]) -> tuple[str, str] | None:
    """What a file is, by its beginning, and what would mend it; None where nobody knows.

    What would mend it is empty for a picture that is read.
    """
    try:
        with Path(path).open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return None
    return next(((what, mend) for pattern, what, mend in _KINDS if pattern.match(head)), None)


def why_no_video(path: str | os.PathLike[str]) -> str | None:
    """What is wrong with a file that is given as a video; None where nobody knows."""
    known = kind_of_unread(path)
    if known is None:
        return None
    what, mend = known
    return f"is {what}, not a video; {mend or 'give the folder that it is in'}"


def holds_pictures(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a document or an archive, in which FFmpeg may see a stream of pictures."""
    known = kind_of_unread(path)
    return known is not None and known[0] in _HOLD_PICTURES


def why_no_picture(path: str | os.PathLike[str]) -> str | None:
    """What is wrong with a file that is given as a picture; None where nobody knows."""
    known = kind_of_unread(path)
    if known is None or not known[1]:
        return None
    what, mend = known
    mend = _TO_PICTURES if mend == _AS_PICTURE or "picture" in what else mend
    return f"is {what}; read are {', '.join(READ_PICTURES)}: {mend}"


def why_no_pictures(folder: Path) -> str | None:
    """What a folder holds in place of pictures that are read; None where there is nothing near."""
    for suffixes, what, mend in (
        (UNREAD_SUFFIXES, "pictures", "convert them to JPEG or PNG"),
        (_VIDEO_SUFFIXES, "videos", "give one of them"),
    ):
        names = [path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in suffixes]
        if names:
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            unread = f"no picture that is read, but {what} ({names[0]}{more})"
            return f"holds {unread}; {mend}"
    return None
