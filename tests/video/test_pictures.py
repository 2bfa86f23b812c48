"""Pictures: which are decoded, by what, and how they are shown."""

from __future__ import annotations

import os
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sightline.errors import BrokenOffError, InputError
from sightline.tally import Tally
from sightline.video import frames, read_picture
from sightline.video.reader import frame_count

QUARTERS = np.zeros((24, 32, 3), np.uint8)
QUARTERS[:12, :16], QUARTERS[:12, 16:], QUARTERS[12:, :16] = (250, 0, 0), (0, 250, 0), (0, 0, 250)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP", "BMP"])
@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".webp"])
def test_what_is_in_a_file_tells_its_kind(tmp_path: Path, kind: str, suffix: str) -> None:
    path = tmp_path / f"000007{suffix}"
    more = {"quality": 95, "subsampling": 0} if kind == "JPEG" else {}
    lossless = {"lossless": True} if kind == "WEBP" else {}
    Image.fromarray(QUARTERS).save(path, format=kind, **more, **lossless)
    (frame,) = frames(tmp_path)
    assert frame.index == 7
    assert np.abs(frame.image_bgr.astype(int) - QUARTERS[..., ::-1]).max() < 30


@pytest.mark.parametrize("kind", ["EPS", "PPM", "GIF", "TGA", "PCX", "SGI", "ICO", "PDF"])
def test_other_kinds_are_refused_and_start_nothing(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark, programs = tmp_path / "was-run", tmp_path / "bin"
    programs.mkdir()
    for name in ("gs", "gswin64c"):
        (programs / name).write_text(f"#!/bin/sh\ntouch {mark}\n")
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    folder = tmp_path / "frames"
    folder.mkdir()
    Image.fromarray(QUARTERS).save(folder / "000001.jpg", format=kind)
    with pytest.raises(InputError, match=r"000001\.jpg: is (no picture that can|an? .*; read are)"):
        list(frames(folder))
    assert not mark.exists()


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
def test_turned_and_mirrored(tmp_path: Path, orientation: int, kind: str) -> None:
    path = tmp_path / "000001.jpg"
    exif = Image.Exif()
    exif[0x0112] = orientation
    more = {"quality": 95, "subsampling": 0} if kind == "JPEG" else {}
    Image.fromarray(QUARTERS).save(path, format=kind, exif=exif, **more)
    # The standard: where the first row and the first column of what is stored are shown.
    wanted = {
        1: QUARTERS,
        2: QUARTERS[:, ::-1],
        3: QUARTERS[::-1, ::-1],
        4: QUARTERS[::-1],
        5: QUARTERS.transpose(1, 0, 2),
        6: QUARTERS.transpose(1, 0, 2)[:, ::-1],
        7: QUARTERS.transpose(1, 0, 2)[::-1, ::-1],
        8: QUARTERS.transpose(1, 0, 2)[::-1],
    }[orientation][..., ::-1]
    image = read_picture(path)
    assert image.shape == wanted.shape
    assert np.abs(image.astype(int) - wanted).max() < 30


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "RGBA", "CMYK", "YCbCr"])
def test_modes_of_eight_bits(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "1.tif"
    grey = np.tile(np.array([0, 255], np.uint8), (8, 8))
    Image.fromarray(grey).convert("RGB").convert(mode, dither=Image.Dither.NONE).save(path)
    np.testing.assert_allclose(read_picture(path), np.repeat(grey[..., None], 3, axis=2), atol=2)


def test_sixteen_bits_of_colour(tmp_path: Path) -> None:
    deep = (QUARTERS[..., ::-1].astype(np.uint16) << 8) + 77
    cv2.imwrite(str(tmp_path / "1.png"), deep)
    assert np.abs(read_picture(tmp_path / "1.png").astype(int) - QUARTERS[..., ::-1]).max() <= 1


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_thermal_pictures_share_one_scale(tmp_path: Path, suffix: str) -> None:
    scene = np.linspace(7000, 14650, 24 * 32).reshape(24, 32).astype(np.uint16)
    cv2.imwrite(str(tmp_path / f"000001.{suffix}"), scene)
    cv2.imwrite(str(tmp_path / f"000002.{suffix}"), scene - 1000)
    tally = Tally(tmp_path)
    first, second = (frame.image_bgr.astype(float) for frame in frames(tmp_path, tally=tally))
    np.testing.assert_allclose(first[..., 0], (scene - 7000.0) / 7650.0 * 255.0, atol=0.51)
    expected = np.clip((scene - 8000.0) / 7650.0 * 255.0, 0, 255)
    np.testing.assert_allclose(second[..., 2], expected, atol=0.51)
    assert any("from 7000 to 14650" in note for note in tally.notes)


def test_temperatures_as_fractions(tmp_path: Path) -> None:
    celsius = np.linspace(-5.0, 35.0, 24 * 32, dtype=np.float32).reshape(24, 32)
    Image.fromarray(celsius).save(tmp_path / "1.tif")
    image = read_picture(tmp_path / "1.tif")
    np.testing.assert_allclose(image[..., 0], (celsius + 5.0) / 40.0 * 255.0, atol=0.51)


def png_of(width: int, height: int) -> bytes:
    """A picture that is no more than its header."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b""))


@pytest.mark.parametrize("size_px", [(60_000, 60_000), (10_001, 10_000), (13_000, 13_000)])
def test_a_size_is_told_before_it_is_decoded(tmp_path: Path, size_px: tuple[int, int]) -> None:
    path = tmp_path / "000001.png"
    path.write_bytes(png_of(*size_px))
    tracemalloc.start()
    with pytest.raises(InputError, match=r"too large .* at most 100 megapixels"):
        read_picture(path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_what_is_cut_short_is_not_shown_in_part(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    for kind in ("JPEG", "PNG", "TIFF", "WEBP", "BMP"):
        whole, cut = tmp_path / "whole", tmp_path / f"{kind}.jpg"
        Image.fromarray(noise).save(whole, format=kind)
        cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
        with pytest.raises(InputError, match="is no picture that can be read"):
            read_picture(cut)


def test_a_damaged_picture_is_named(tmp_path: Path) -> None:
    for number in (1, 2, 4):
        Image.fromarray(QUARTERS).save(tmp_path / f"{number:06d}.png")
    (tmp_path / "._000001.png").write_bytes(b"what a system keeps of a picture")
    (tmp_path / "000009.txt").write_bytes(b"not a picture")
    tally = Tally(tmp_path)
    assert [frame.index for frame in frames(tmp_path, tally=tally)] == [1, 2, 4]
    assert tally.read == {"frames": frame_count(tmp_path)} == {"frames": 3}
    (tmp_path / "000003.png").write_bytes(b"not a picture")
    found = []
    with pytest.raises(InputError, match=r"000003\.png: is no picture"):
        found.extend(frames(tmp_path))
    assert [frame.index for frame in found] == [1, 2]


def test_two_sizes_in_a_folder(tmp_path: Path) -> None:
    Image.fromarray(QUARTERS).save(tmp_path / "000001.png")
    Image.fromarray(QUARTERS).save(tmp_path / "000002.png")
    Image.fromarray(QUARTERS[:12]).save(tmp_path / "000003.png")
    found = []
    with pytest.raises(BrokenOffError, match=r"000003\.png has 32 x 12 px, 000001\.png 32 x 24 px"):
        found.extend(frames(tmp_path))
    assert [frame.index for frame in found] == [1, 2]
