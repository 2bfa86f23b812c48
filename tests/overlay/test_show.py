"""Videos and pictures as files: their times, their sound, and what is refused."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from scene import SEA, SIZE_PX, START_S, model, sea, track
from sightline import video
from sightline.clock import FrameClock
from sightline.errors import BrokenOffError, InputError, StoppedError
from sightline.overlay import Found, OverlaySettings
from sightline.overlay.style import colour_of
from sightline.pipeline.show import Footage, show_picture, show_video
from sightline.tally import Tally
from sightline.types import Frame

UNEVEN_MS = [0, 40, 80, 200, 233, 267, 900, 1000, 3000, 3040]


def film(
    path: Path, times_ms: Sequence[int] = UNEVEN_MS, *, codec: str | None = None, turned: int = 0
) -> Path:
    """Pictures of the sea at given times, with a sound where a codec for it is named."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        sound = container.add_stream(codec, rate=48000) if codec else None
        for time_ms in times_ms:
            picture = av.VideoFrame.from_ndarray(sea(), format="bgr24")
            picture.time_base, picture.pts = Fraction(1, 1000), time_ms
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
        if sound is not None:
            for i in range(0, 48000 * 3, 1024):
                wave = (np.sin(np.arange(i, i + 1024) / 20.0) * 9000).astype(np.int16)
                heard = av.AudioFrame.from_ndarray(wave[None].repeat(2, 1), "s16", "stereo")
                heard.sample_rate, heard.pts, heard.time_base = 48000, i, Fraction(1, 48000)
                container.mux(sound.encode(heard))
            container.mux(sound.encode(None))
    return path


def clock_at(lags_s: Sequence[float]) -> FrameClock:
    n = len(lags_s)
    return FrameClock(np.arange(n), START_S + np.array(lags_s), np.zeros(n))


def test_frames_are_shown_at_the_times_of_the_source(tmp_path: Path) -> None:
    source = film(tmp_path / "in.mp4")
    shown = show_video(
        Footage(str(source), start_utc_s=START_S), model(), Found([track()]), tmp_path / "out.mp4"
    )
    assert shown.frames == len(UNEVEN_MS)
    written = video.video_info(tmp_path / "out.mp4")
    np.testing.assert_allclose(written.presentation_s, np.array(UNEVEN_MS) / 1000.0, atol=2e-5)
    assert written.image_size_px == SIZE_PX
    assert written.creation_utc_s == START_S


def test_a_clock_tells_what_is_drawn_and_not_when_it_is_shown(tmp_path: Path) -> None:
    source = film(tmp_path / "in.mp4", [0, 100, 200])
    # Frames that were taken a second apart, and are shown quickly.
    clock = clock_at([0.0, 1.0, 2.0])
    taken = [frame.time_utc_s for _, frame in Footage(str(source), clock).frames()]
    assert taken == [START_S, START_S + 1.0, START_S + 2.0]
    show_video(Footage(str(source), clock), model(), Found(), tmp_path / "out.mp4")
    written = video.video_info(tmp_path / "out.mp4")
    np.testing.assert_allclose(written.presentation_s, [0.0, 0.1, 0.2], atol=2e-5)


def test_pictures_in_a_folder_are_shown_at_the_pace_at_which_they_were_taken(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.png"), sea())
    clock = clock_at([0.0, 0.5, 2.0])
    show_video(Footage(str(folder), clock), model(), Found([track()]), tmp_path / "out.mp4")
    written = video.video_info(tmp_path / "out.mp4")
    np.testing.assert_allclose(written.presentation_s, [0.0, 0.5, 2.0], atol=2e-5)
    with pytest.raises(InputError, match="clock"):
        Footage(str(folder)).frames()


def test_the_sound_is_copied(tmp_path: Path) -> None:
    source = film(tmp_path / "in.mp4", codec="aac")
    shown = show_video(
        Footage(str(source), start_utc_s=START_S), model(), Found(), tmp_path / "out.mp4"
    )
    assert shown.sound

    def packets(path: Path) -> list[tuple[float, bytes]]:
        with av.open(str(path)) as container:
            stream = container.streams.audio[0]
            return [
                (float(p.pts * p.time_base), bytes(p))
                for p in container.demux(stream)
                if p.pts is not None and p.time_base is not None and p.pts >= 0
            ]

    before, after = packets(source), packets(tmp_path / "out.mp4")
    assert len(after) >= len(before) - 3
    assert [data for _, data in after] == [data for _, data in before[: len(after)]]
    for (one_s, _), (other_s, _) in zip(before, after, strict=False):
        assert other_s == pytest.approx(one_s, abs=1e-4)


def test_a_sound_that_the_file_cannot_hold_is_told(tmp_path: Path) -> None:
    source = film(tmp_path / "in.mkv", codec="pcm_s16le")
    tally = Tally(source)
    shown = show_video(
        *(Footage(str(source), start_utc_s=START_S), model(), Found(), tmp_path / "out.mp4"),
        tally=tally,
    )
    assert shown.frames == len(UNEVEN_MS)
    assert not shown.sound
    assert any("sound (pcm_s16le) is left out" in note for note in tally.notes)


def test_a_picture_is_of_the_frame_that_is_named(tmp_path: Path) -> None:
    source = film(tmp_path / "in.mp4", range(0, 5000, 500))
    footage = Footage(str(source), start_utc_s=START_S)
    bare = OverlaySettings(trail_s=0.0, horizon=False, inset=False, labels=False)
    # Without an ellipse there is the dot alone.
    one = replace(track(), covariance_m2=np.full((11, 2, 2), np.nan))

    def column(at: int | float) -> float:
        show_picture(*(footage, model(), Found([one]), tmp_path / "p.png"), at=at, settings=bare)
        image = cv2.imread(str(tmp_path / "p.png"))
        assert image is not None
        assert image.shape == (SIZE_PX[1], SIZE_PX[0], 3)
        near = np.abs(image.astype(int) - colour_of(3)).max(axis=2) < 40
        return float(np.nonzero(near)[1].mean())

    # -10 m + 2 m/s, at 100 m + 1 m/s.
    for at, seconds in ((4, 2.0), (START_S + 2.1, 2.0), (START_S + 2.4, 2.5), (START_S, 0.0)):
        right = 320.0 + 900.0 * (-10.0 + 2.0 * seconds) / (100.0 + seconds)
        assert column(at) == pytest.approx(right, abs=2.5)
    with pytest.raises(InputError, match="has no frame 10; its frames are 0 to 9"):
        column(10)
    with pytest.raises(InputError, match="it lasts from 2023-11-14T22:13:20Z to"):
        column(START_S + 60.0)
    with pytest.raises(InputError, match="it lasts from"):
        column(START_S - 1.0)


def test_a_video_of_other_pictures_than_the_models_is_refused(tmp_path: Path) -> None:
    source = film(tmp_path / "in.mp4")
    footage = Footage(str(source), start_utc_s=START_S)
    with pytest.raises(InputError, match="640 x 360 px, the model learned"):
        show_video(footage, model(image_size_px=(320, 180)), Found(), tmp_path / "out.mp4")
    with pytest.raises(InputError, match="nothing tells the time of frame 0"):
        show_video(Footage(str(source)), model(), Found(), tmp_path / "out.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["in.mp4"]


def test_streams_and_tables_are_refused() -> None:
    with pytest.raises(InputError, match="is a stream"):
        Footage("rtsp://camera/1")
    with pytest.raises(InputError, match="--boxes"):
        Footage("boxes.csv")


def test_a_video_that_is_stopped_is_whole_until_then(tmp_path: Path) -> None:
    source = film(tmp_path / "in.mp4", range(0, 40_000, 40))
    stop = threading.Event()
    told: list[float] = []

    def progress(_what: str, share: float) -> None:
        told.append(share)
        if len(told) == 20:
            stop.set()

    footage = Footage(str(source), start_utc_s=START_S)
    out = tmp_path / "out.mp4"
    shown = show_video(footage, model(), Found(), out, stop=stop, progress=progress)
    assert 20 <= shown.frames < 1000
    assert len(video.video_info(out).presentation_s) == shown.frames
    with pytest.raises(StoppedError):
        show_video(footage, model(), Found(), tmp_path / "none.mp4", stop=stop)
    assert not (tmp_path / "none.mp4").exists()


def test_a_video_that_breaks_off_is_written_until_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def frames(*_: object, **__: object) -> Iterator[Frame]:
        for i in range(5):
            yield Frame(i, 0.04 * i, sea())
        raise BrokenOffError("in.mp4: breaks off after 5 frames")

    source = film(tmp_path / "in.mp4")
    monkeypatch.setattr(video, "frames", frames)
    footage = Footage(str(source), start_utc_s=START_S)
    shown = show_video(footage, model(), Found(), tmp_path / "out.mp4")
    assert shown.frames == 5
    assert "breaks off" in str(shown.broken)


def test_an_odd_number_of_columns_is_made_even(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in range(2):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((51, 63, 3), SEA, np.uint8))
    clock = clock_at([0.0, 1.0])
    small = model(image_size_px=(63, 51))
    show_video(Footage(str(folder), clock), small, Found(), tmp_path / "out.mp4")
    assert video.video_info(tmp_path / "out.mp4").image_size_px == (64, 52)
