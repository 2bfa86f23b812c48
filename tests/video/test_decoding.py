"""The number, the time and the size of each frame, in videos of the kinds that people bring."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from videos import SIZE_PX, number_of, overwrite, packet_places, picture, write

from sightline.clock import presentation_clock
from sightline.errors import BrokenOffError, InputError
from sightline.tally import Tally
from sightline.video import frames, video_info
from sightline.video.presentation import presentation_of_packets
from sightline.video.reader import _decoded_times, frame_count

TEN_HZ = list(range(0, 2400, 100))
IRREGULAR = [0, 40, 90, 300, 310, 420, 800, 840, 880, 920, 1300, 1340, 1600, 1900, 1910, 2500]


def seen(path: Path, tally: Tally | None = None) -> tuple[list[int], list[float], list[int]]:
    """Indices, times after a start at 0, and the numbers that the pictures show."""
    found = list(frames(path, start_utc_s=0.0, tally=tally or Tally(path)))
    numbers = [number_of(frame.image_bgr) for frame in found]
    return [frame.index for frame in found], [frame.time_utc_s for frame in found], numbers


def agree(path: Path, index: list[int], times_s: list[float], count: int) -> None:
    """All that is said of a video is the same."""
    info = video_info(path, tally=Tally(path))
    assert len(info.presentation_s) == frame_count(path) == count
    np.testing.assert_allclose(info.presentation_s[index], times_s, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "codec", "b_frames", "tick", "times"),
    [
        ("a.mp4", "libx264", 0, Fraction(1, 1000), IRREGULAR),
        ("a.mp4", "libx264", 3, Fraction(1, 1000), IRREGULAR),
        ("a.mp4", "mpeg4", 0, Fraction(1, 1000), IRREGULAR),
        ("a.mkv", "libx264", 3, Fraction(1, 1000), IRREGULAR),
        ("a.mkv", "mjpeg", 0, Fraction(1, 1000), IRREGULAR),
        ("a.webm", "libvpx", 0, Fraction(1, 1000), IRREGULAR),
        ("a.webm", "libvpx-vp9", 0, Fraction(1, 1000), IRREGULAR),
        ("a.ts", "libx264", 3, Fraction(1, 1000), IRREGULAR),
        ("a.ts", "libx264", 0, Fraction(1, 1000), IRREGULAR),
        ("a.flv", "libx264", 2, Fraction(1, 1000), IRREGULAR),
        ("a.avi", "libx264", 0, Fraction(1, 10), TEN_HZ),
        ("a.avi", "libx264", 2, Fraction(1, 10), TEN_HZ),
        ("a.avi", "mpeg4", 2, Fraction(1, 10), TEN_HZ),
        ("a.avi", "mjpeg", 0, Fraction(1, 10), TEN_HZ),
        ("a.mpg", "mpeg2video", 2, Fraction(1, 25), [*range(0, 960, 40)]),
    ],
)
def test_each_frame_has_its_time(
    tmp_path: Path, name: str, codec: str, b_frames: int, tick: Fraction, times: list[int]
) -> None:
    full = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    path = write(tmp_path / name, times, codec, b_frames=b_frames, tick=tick, pix_fmt=full)
    index, times_s, numbers = seen(path)
    assert index == numbers == list(range(len(times)))
    np.testing.assert_allclose(times_s, np.array(times) / 1000.0, rtol=0, atol=1e-4)
    agree(path, index, times_s, len(times))
    # What packets tell is what decoding tells.
    known = presentation_of_packets(str(path), Tally(path))
    if known is not None:
        size_px, decoded_s = _decoded_times(str(path), Tally(path))
        assert known[0] == size_px == SIZE_PX
        np.testing.assert_array_equal(known[1], decoded_s)
    assert (known is not None) == (codec in ("libx264", "mjpeg"))


def test_null_frames_of_avi_are_no_frames(tmp_path: Path) -> None:
    times = [0, 100, 200, 500, 600, 700, 1000, 1100]
    for codec, full in (("mjpeg", "yuvj420p"), ("libx264", "yuv420p"), ("mpeg4", "yuv420p")):
        path = write(tmp_path / f"{codec}.avi", times, codec, tick=Fraction(1, 10), pix_fmt=full)
        with av.open(str(path)) as container:
            # The muxer has filled the gaps, and counts them.
            assert container.streams.video[0].frames > len(times)
        index, times_s, numbers = seen(path)
        assert index == numbers == list(range(8))
        np.testing.assert_allclose(times_s, np.array(times) / 1000.0, atol=1e-9)
        agree(path, index, times_s, 8)


def joined(path: Path, *parts: Path) -> Path:
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    return path


def test_a_clock_that_starts_anew(tmp_path: Path) -> None:
    first = write(tmp_path / "1.ts", TEN_HZ[:12])
    second = write(tmp_path / "2.ts", TEN_HZ[:12], first=12)
    path = joined(tmp_path / "both.ts", first, second)
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    assert index == numbers == list(range(24))
    np.testing.assert_allclose(times_s, np.arange(24) / 10.0, atol=1e-4)
    assert any("starts anew at frame 12" in note for note in tally.notes)
    agree(path, index, times_s, 24)


def test_a_clock_that_jumps_ahead(tmp_path: Path) -> None:
    first = write(tmp_path / "1.ts", TEN_HZ[:12])
    later = [time_ms + 60_000 for time_ms in TEN_HZ[:12]]
    second = write(tmp_path / "2.ts", later, first=12, options={"copyts": "1"})
    path = joined(tmp_path / "both.ts", first, second)
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    assert index == numbers == list(range(24))
    assert np.diff(times_s).min() >= 0.0
    assert times_s[12] == pytest.approx(60.0, abs=1.5)
    assert any("jumps ahead at frame 12" in note for note in tally.notes)
    agree(path, index, times_s, 24)


@pytest.mark.parametrize("b_frames", [0, 2])
@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "libx264"), ("a.mkv", "libx264"), ("a.mp4", "libx265")]
)
def test_damaged_packets_cost_their_frames_alone(
    tmp_path: Path, name: str, codec: str, b_frames: int
) -> None:
    times = [0, *np.cumsum(np.random.default_rng(3).integers(30, 200, 39)).tolist()]
    path = tmp_path / name
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg cannot encode with {codec}")
    x265 = {"x265-params": "log-level=none:keyint=10:min-keyint=10:scenecut=0"}

    def prepare(stream: av.VideoStream) -> None:
        if codec == "libx265":
            stream.options = {"preset": "ultrafast", **x265}

    write(path, times, codec, b_frames=b_frames, prepare=prepare)
    places = packet_places(path)
    for place, size in places[14:17]:
        overwrite(path, place, size)
    tally = Tally(path)
    index, times_s, _ = seen(path, tally)
    # Those up to the next key picture may lean on what is lost, no others.
    assert {*range(10), *range(25, 40)} <= set(index)
    assert 0 < 40 - len(index) == tally.total_left_out
    assert tally.read["frames"] == len(index)
    np.testing.assert_allclose(times_s, np.array(times)[index] / 1000.0, atol=1e-3)
    for frame in frames(path, tally=Tally(path)):
        if frame.index >= 25:
            assert number_of(frame.image_bgr) == frame.index
    agree(path, index, times_s, 40)


@pytest.mark.parametrize("lost", [False, True])
def test_lost_packets_of_a_transport_stream(tmp_path: Path, lost: bool) -> None:
    times = list(range(0, 4000, 100))
    noise = np.random.default_rng(0).integers(0, 255, (40, 48, 64, 3), dtype=np.uint8)
    images = [np.clip(picture(n) + noise[n] // 8, 0, 255) for n in range(40)]
    path = write(tmp_path / "a.ts", times, images=images)
    data = path.read_bytes()
    begun = packet_places(path)[14][0] // 188 * 188
    ended = packet_places(path)[17][0] // 188 * 188
    path.write_bytes(data[:begun] + (b"" if lost else bytes(ended - begun)) + data[ended:])
    tally = Tally(path)
    index, times_s, _ = seen(path, tally)
    assert {*range(13), *range(21, 40)} <= set(index)
    assert 0 < 40 - len(index) == tally.total_left_out
    np.testing.assert_allclose(times_s, np.array(index) / 10.0, atol=1e-4)
    agree(path, index, times_s, 40)


def test_damage_in_avi(tmp_path: Path) -> None:
    path = write(tmp_path / "a.avi", TEN_HZ, tick=Fraction(1, 10))
    for place, size in packet_places(path)[12:14]:
        overwrite(path, place, size)
    index, times_s, _ = seen(path)
    assert {*range(10), *range(20, 24)} <= set(index) < set(range(24))
    np.testing.assert_allclose(times_s, np.array(index) / 10.0, atol=1e-9)
    agree(path, index, times_s, 24)


def test_frames_that_an_edit_list_hides(tmp_path: Path) -> None:
    # Muxers write those before zero, which the others lean on, and a list that hides them.
    path = write(tmp_path / "a.mp4", [time_ms - 400 for time_ms in TEN_HZ])
    with av.open(str(path)) as container:
        assert container.streams.video[0].frames == 24
    index, times_s, numbers = seen(path)
    assert index == list(range(20))
    assert numbers == list(range(4, 24))
    np.testing.assert_allclose(times_s, np.arange(20) / 10.0, atol=1e-9)
    agree(path, index, times_s, 20)


def two_streams(path: Path, sizes: list[tuple[int, int]], film: int, flag: object) -> Path:
    """Streams of sizes, each picture of the number of its stream; one of them is flagged."""
    with av.open(str(path), "w") as container:
        streams = []
        for size_px in sizes:
            stream = container.add_stream("mpeg4", rate=10)
            stream.width, stream.height, stream.pix_fmt = *size_px, "yuv420p"
            streams.append(stream)
        streams[film].disposition = flag
        for number, (stream, size_px) in enumerate(zip(streams, sizes, strict=True)):
            for _ in range(5):
                frame = av.VideoFrame.from_ndarray(picture(number, size_px), format="bgr24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    return path


def test_the_film_is_read_and_not_its_cover(tmp_path: Path) -> None:
    kinds = av.stream.Disposition
    # A preview in front.
    path = two_streams(tmp_path / "a.mkv", [(64, 48), (160, 120)], 1, kinds.default)
    tally = Tally(path)
    found = list(frames(path, tally=tally))
    assert {frame.image_bgr.shape for frame in found} == {(120, 160, 3)}
    assert any("holds 2 videos; stream 1 is read" in note for note in tally.notes)
    assert video_info(path).image_size_px == (160, 120)
    # The larger is not the film where another is marked as it.
    path = two_streams(tmp_path / "b.mkv", [(64, 48), (160, 120)], 0, kinds.default)
    assert video_info(path).image_size_px == (64, 48)


def test_a_picture_that_changes_its_size(tmp_path: Path) -> None:
    for name, size_px in (("a", (96, 72)), ("b", (48, 64))):
        first = write(tmp_path / "1.ts", TEN_HZ[:12])
        second = write(tmp_path / "2.ts", TEN_HZ[:12], size_px=size_px)
        path = joined(tmp_path / f"{name}.ts", first, second)
        found = []
        with pytest.raises(BrokenOffError, match=r"from frame 12 on its pictures have .* 64 x 48"):
            found.extend(frames(path))
        assert [number_of(frame.image_bgr) for frame in found] == list(range(12))
        tally = Tally(path)
        assert len(video_info(path, tally=tally).presentation_s) == 12
        assert any("from frame 12 on" in note for note in tally.notes)


def test_raw_streams_need_a_clock(tmp_path: Path) -> None:
    raw = write(tmp_path / "a.h264", TEN_HZ, container_format="h264")
    jpegs = write(
        tmp_path / "a.mjpeg", TEN_HZ, "mjpeg", container_format="mjpeg", pix_fmt="yuvj420p"
    )
    clock = presentation_clock(500.0, np.array(TEN_HZ) / 1000.0)
    for path in (raw, jpegs):
        with pytest.raises(InputError, match=r"stores no times .* give a clock"):
            frames(path, start_utc_s=0.0)
        with pytest.raises(InputError, match="stores no times"):
            video_info(path)
        tally = Tally(path)
        found = list(frames(path, tally=tally))
        assert np.isnan([frame.time_utc_s for frame in found]).all()
        assert any("a clock (frame,utc) tells them" in note for note in tally.notes)
        timed = list(frames(path, clock=clock))
        assert [number_of(frame.image_bgr) for frame in timed] == list(range(24))
        np.testing.assert_allclose([f.time_utc_s for f in timed], 500.0 + np.arange(24) / 10.0)


def test_metadata_in_bytes_of_its_country(tmp_path: Path) -> None:
    for name in ("a.mp4", "a.avi", "a.mkv"):
        path = write(
            tmp_path / name,
            TEN_HZ,
            "mpeg4",
            tick=Fraction(1, 10),
            metadata={"title": "Kieler Foerde at dusk"},
        )
        data = path.read_bytes()
        assert b"Foerde" in data
        path.write_bytes(data.replace(b"Foerde", b"F\xf6rde ", 1))
        assert seen(path)[2] == list(range(24))


@pytest.mark.parametrize("turned_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("mirrored", [(False, False), (True, False), (False, True)])
def test_turned_and_mirrored(tmp_path: Path, turned_deg: int, mirrored: tuple[bool, bool]) -> None:
    stored = np.zeros((48, 64, 3), np.uint8)
    stored[:24, :32], stored[:24, 32:], stored[24:, :32] = 250, 170, 90
    across, down = mirrored

    def prepare(stream: av.VideoStream) -> None:
        stream.set_display_rotation(turned_deg, hflip=across, vflip=down)

    path = write(tmp_path / "a.mp4", [0], "mpeg4", images=[stored], prepare=prepare)
    # Turned counterclockwise, then mirrored.
    wanted = np.rot90(stored, turned_deg // 90)
    wanted = wanted[:, ::-1] if across else wanted
    wanted = wanted[::-1] if down else wanted
    (frame,) = frames(path)
    assert frame.image_bgr.shape == wanted.shape
    assert np.abs(frame.image_bgr.astype(int) - wanted).mean() < 8.0
    assert video_info(path).image_size_px == wanted.shape[1::-1]


def test_pixels_that_are_not_square(tmp_path: Path) -> None:
    def prepare(stream: av.VideoStream) -> None:
        stream.sample_aspect_ratio = Fraction(16, 11)

    path = write(tmp_path / "a.mp4", TEN_HZ, prepare=prepare, size_px=(88, 72))
    tally = Tally(path)
    for frame in frames(path, tally=tally):
        assert frame.image_bgr.shape == (72, 128, 3)
    assert any("88 x 72 px are shown, and read, with 128 x 72 px" in note for note in tally.notes)
    assert video_info(path).image_size_px == (128, 72)


def test_pictures_of_ten_bits_look_like_those_of_eight(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mkv", TEN_HZ, "ffv1", pix_fmt="yuv420p10le")
    assert seen(path)[2] == list(range(24))


def test_grey_of_sixteen_bits_is_scaled_by_its_range(tmp_path: Path) -> None:
    scene = np.linspace(3000, 3400, 48 * 64).reshape(48, 64).astype(np.uint16)
    warmer = scene + 100
    path = write(
        tmp_path / "a.mkv",
        [0, 100],
        "ffv1",
        pix_fmt="gray16le",
        images=[scene, warmer],
        image_format="gray16le",
    )
    tally = Tally(path)
    first, second = (frame.image_bgr.astype(float) for frame in frames(path, tally=tally))
    np.testing.assert_allclose(first[..., 0], (scene - 3000.0) / 400.0 * 255.0, atol=0.51)
    # The scale is that of the first.
    expected = np.clip((warmer - 3000.0) / 400.0 * 255.0, 0, 255)
    np.testing.assert_allclose(second[..., 1], expected, atol=0.51)
    assert any("scaled from 3000 to 3400" in note for note in tally.notes)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi"])
def test_what_is_cut_short_breaks_off(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, TEN_HZ, tick=Fraction(1, 10), options={"movflags": "+faststart"})
    data = path.read_bytes()
    places = packet_places(path)
    path.write_bytes(data[: places[15][0] + 8 + places[15][1] // 2])
    found = []
    with pytest.raises(BrokenOffError, match="breaks off after"):
        found.extend(frames(path, start_utc_s=0.0))
    assert [number_of(frame.image_bgr) for frame in found[:15]] == list(range(15))
    assert len(found) <= 16
    tally = Tally(path)
    assert len(video_info(path, tally=tally).presentation_s) >= 15
    assert any("breaks off" in note for note in tally.notes)


def test_a_picture_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "000001.png"
    av.VideoFrame.from_ndarray(picture(0), format="bgr24").to_image().save(path)
    with pytest.raises(InputError, match="give the folder"):
        frames(path)


def test_warnings_are_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    part = write(tmp_path / "1.ts", TEN_HZ[:12])
    path = joined(tmp_path / "both.ts", part, part)
    list(frames(path))
    assert [record.message for record in caplog.records if "starts anew" in record.message] == [
        caplog.records[0].message
    ]


def test_one_wrong_time_is_no_break_of_the_clock(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ts", list(range(0, 4000, 100)))
    data = bytearray(path.read_bytes())
    place = packet_places(path)[20][0] // 188 * 188
    begun = data.index(b"\0\0\1\xe0", place)
    # A bit of the presentation time that is worth hours.
    data[begun + 9] ^= 0x04
    path.write_bytes(data)
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    assert index == numbers == list(range(40))
    np.testing.assert_allclose(times_s, np.arange(40) / 10.0, atol=1e-4)
    assert any("cannot be true (the first is frame 20)" in note for note in tally.notes)
    agree(path, index, times_s, 40)


def test_an_end_that_was_never_written(tmp_path: Path) -> None:
    # Recorders and downloads take the place on the disk first.
    path = write(tmp_path / "a.mp4", list(range(0, 6000, 100)), options={"movflags": "faststart"})
    data = path.read_bytes()
    begun = packet_places(path)[30][0]
    path.write_bytes(data[:begun] + bytes(len(data) - begun))
    found = []
    with pytest.raises(BrokenOffError, match="its end cannot be decoded"):
        found.extend(frames(path))
    assert [number_of(frame.image_bgr) for frame in found] == list(range(30))


def test_a_stream_that_begins_between_key_pictures(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ts", list(range(0, 4000, 100)), b_frames=2)
    data = path.read_bytes()
    begun = packet_places(path)[14][0] // 188 * 188
    path.write_bytes(data[: 3 * 188] + data[begun:])
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    # Frames are counted from the first that can be shown, and none counts as damaged.
    assert numbers == list(range(numbers[0], 40))
    assert numbers[0] <= 20
    assert index == list(range(len(numbers)))
    assert tally.total_left_out == 0
    np.testing.assert_allclose(times_s, np.arange(len(numbers)) / 10.0, atol=1e-4)
    agree(path, index, times_s, len(numbers))


def test_fields_that_are_packets_each(tmp_path: Path) -> None:
    def prepare(stream: av.VideoStream) -> None:
        stream.options = {"preset": "ultrafast", "x264-params": "tff=1:keyint=10"}

    path = write(tmp_path / "a.ts", TEN_HZ, prepare=prepare)
    index, times_s, numbers = seen(path)
    assert index == numbers == list(range(24))
    assert presentation_of_packets(str(path), Tally(path)) is None
    agree(path, index, times_s, 24)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts"])
@pytest.mark.parametrize("b_frames", [0, 2, 3])
@pytest.mark.parametrize("behind", [5, 12, 13, 20, 38])
def test_a_gap_in_a_variable_rate(tmp_path: Path, name: str, b_frames: int, behind: int) -> None:
    # The first picture behind the gap is decoded before those in front of it that lean on it.
    times = np.cumsum(np.random.default_rng(0).integers(20, 120, 40))
    times = times - times[0]
    times[behind:] += 20_000
    path = write(tmp_path / name, times.tolist(), b_frames=b_frames)
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    assert index == numbers == list(range(40))
    assert tally.read["frames"] == 40
    assert tally.total_left_out == 0
    np.testing.assert_allclose(times_s, times / 1000.0, rtol=0, atol=1e-4)
    (note,) = tally.notes
    assert f"jumps ahead at frame {behind}, by up to 20.1 s" in note or "20.0 s" in note
    agree(path, index, times_s, 40)


@pytest.mark.parametrize("b_frames", [0, 2])
@pytest.mark.parametrize("wrong", [(3,), (20,), (37,), (20, 30), (20, 23)])
@pytest.mark.parametrize("bit", [9, 11, 13, 15])
def test_wrong_times_in_matroska(
    tmp_path: Path, b_frames: int, wrong: tuple[int, ...], bit: int
) -> None:
    times = [0, *np.cumsum(np.random.default_rng(3).integers(30, 200, 59)).tolist()]
    path = write(tmp_path / "a.mkv", times, b_frames=b_frames)
    data, places = bytearray(path.read_bytes()), packet_places(path)
    for ordinal in wrong:
        # Before a block's data stand its time, 16 bits of milliseconds, and a byte of flags.
        data[places[ordinal][0] - 3 + (0 if bit > 7 else 1)] ^= 1 << bit % 8
    path.write_bytes(data)
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    # No frame is lost, and none counted twice: 60 of 60.
    assert index == numbers == list(range(60))
    assert tally.read["frames"] == 60
    assert tally.total_left_out == 0
    off_s = np.abs(np.array(times_s) - np.array(times) / 1000.0)
    assert (off_s > 1e-3).sum() <= 2 * len(wrong)
    assert off_s.max() < 0.6
    agree(path, index, times_s, 60)


@pytest.mark.parametrize("late_ms", [700, 3000, -3000])
def test_a_wrong_time_that_packets_do_not_show_at_the_beginning(
    tmp_path: Path, late_ms: int
) -> None:
    times = list(range(0, 12_000, 100))
    path = write(tmp_path / "a.mkv", times, b_frames=2)
    data, places = bytearray(path.read_bytes()), packet_places(path)
    place = places[100][0] - 3
    own = int.from_bytes(data[place : place + 2], "big", signed=True) + late_ms
    data[place : place + 2] = own.to_bytes(2, "big", signed=True)
    path.write_bytes(data)
    index, times_s, numbers = seen(path)
    assert index == numbers == list(range(120))
    assert (np.abs(np.array(times_s) - np.array(times) / 1000.0) > 1e-3).sum() <= 2
    agree(path, index, times_s, 120)


@pytest.mark.parametrize("b_frames", [0, 2])
@pytest.mark.parametrize(
    "garbage",
    [bytes(188), bytes(1000), bytes(1 << 20), b"\xff" * 300_000, b"no transport stream " * 50_000],
)
def test_what_stands_behind_a_transport_stream(
    tmp_path: Path, b_frames: int, garbage: bytes
) -> None:
    # Recorders take their place on the disk in whole blocks.
    path = write(tmp_path / "a.ts", list(range(0, 4000, 100)), b_frames=b_frames)
    path.write_bytes(path.read_bytes() + garbage)
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    assert index == numbers == list(range(40))
    assert not tally.notes
    assert tally.total_left_out == 0
    np.testing.assert_allclose(times_s, np.arange(40) / 10.0, atol=1e-4)
    agree(path, index, times_s, 40)


def test_what_stands_within_a_transport_stream(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ts", list(range(0, 4000, 100)), b_frames=2)
    data = path.read_bytes()
    middle = len(data) // 376 * 188
    path.write_bytes(data[:middle] + bytes(1 << 20) + data[middle:])
    index, times_s, numbers = seen(path)
    assert index == numbers == list(range(40))
    agree(path, index, times_s, 40)


def test_a_duration_that_cannot_be(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mp4", IRREGULAR)
    data = bytearray(path.read_bytes())
    entries = data.index(b"stts") + 12
    # Times of decoding: so many frames of so long a duration that their sum is negative.
    for entry in range(3):
        data[entries + 8 * entry : entries + 8 * entry + 8] = b"\x7f\xff\xff\xff" * 2
    path.write_bytes(data)
    with av.open(str(path)) as container:
        assert container.streams.video[0].duration < 0
    # Which frames are shown depends on these times.
    assert seen(path)[2][0] == 0


@pytest.mark.parametrize("seed", [3, 24, 39, 51])
def test_no_picture_is_counted_twice_behind_damage(tmp_path: Path, seed: int) -> None:
    """Decoders show some pictures late there, when others are thought to be lost."""
    noise = np.random.default_rng(0).integers(0, 255, (60, 48, 64, 3), dtype=np.uint8)
    images = [np.clip(picture(n) + noise[n] // 8, 0, 255) for n in range(60)]
    path = write(tmp_path / "a.ts", list(range(0, 6000, 100)), b_frames=2, images=images)
    data, rng = bytearray(path.read_bytes()), np.random.default_rng(seed)
    for _ in range(int(rng.integers(1, 4))):
        place, size = int(rng.integers(600, len(data) - 200)), int(rng.integers(1, 400))
        data[place : place + size] = bytes(size)
    path.write_bytes(data)
    tally = Tally(path)
    index, times_s, _ = seen(path, tally)
    assert tally.read["frames"] == len(index) == 60 - tally.total_left_out
    np.testing.assert_allclose(times_s, np.array(index) / 10.0, atol=1e-4)
    agree(path, index, times_s, 60)


def without_times(path: Path, which: Callable[[int], bool]) -> None:
    """Take the times off some pictures of a transport stream, as encoders do that write few."""
    data = bytearray(path.read_bytes())
    begun, number = data.find(b"\x00\x00\x01\xe0"), 0
    while begun >= 0:
        flags = data[begun + 7] >> 6
        if which(number) and flags:
            size = 10 if flags == 3 else 5
            data[begun + 7] &= 0x3F
            data[begun + 9 : begun + 9 + size] = b"\xff" * size
        begun, number = data.find(b"\x00\x00\x01\xe0", begun + 4), number + 1
    path.write_bytes(data)


@pytest.mark.parametrize("codec", ["libx264", "mpeg2video"])
@pytest.mark.parametrize(
    "which",
    [
        lambda n: n == 0,
        lambda n: n % 3 == 1,
        lambda n: n % 10 in (2, 3, 4),
        lambda n: n % 10 != 0,
        lambda n: n > 20,
    ],
    ids=["first", "thirds", "runs", "all but key pictures", "end"],
)
def test_pictures_without_a_time_stand_evenly_between_those_with_one(
    tmp_path: Path, codec: str, which: Callable[[int], bool]
) -> None:
    times = [*range(0, 1600, 40)]
    path = write(tmp_path / "a.ts", times, codec, b_frames=2, tick=Fraction(1, 25))
    without_times(path, which)
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    assert index == numbers == list(range(40))
    np.testing.assert_allclose(times_s, np.array(times) / 1000.0, rtol=0, atol=1e-4)
    agree(path, index, times_s, 40)
    # FFmpeg itself tells those of MPEG-2 by its rate.
    assert codec == "mpeg2video" or any("have no time" in note for note in tally.notes)


@pytest.mark.parametrize("some", [0, 1])
def test_a_transport_stream_without_times_has_none(tmp_path: Path, some: int) -> None:
    path = write(tmp_path / "a.ts", [*range(0, 1600, 40)], b_frames=2, tick=Fraction(1, 25))
    without_times(path, lambda number: number >= some)
    tally = Tally(path)
    index, times_s, numbers = seen(path, tally)
    assert index == numbers == list(range(40))
    assert np.isnan(times_s[some:]).all()
    assert any("a clock (frame,utc) would tell" in note for note in tally.notes)
    # With a clock it is as any other.
    clock = presentation_clock(0.0, np.arange(40) * 0.04)
    told = [frame.time_utc_s for frame in frames(path, clock=clock)]
    np.testing.assert_allclose(told, np.arange(40) * 0.04, rtol=0, atol=1e-9)
