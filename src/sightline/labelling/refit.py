"""Fits to the boxes drawn so far, in the background, and what they advise."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sightline.clock_offset import ClockOffset
from sightline.errors import SightlineError
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitSettings, fit
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.advice import Advice, OddBox, ThinCell
from sightline.labelling.expected import Expected, TargetSize, camera_of
from sightline.labelling.expected_gain import Design, axes_95_m, spread_rows
from sightline.labelling.logged_frames import LoggedFrames
from sightline.labelling.suggestions import Views, by_information, in_picture, median_axis_m
from sightline.scene import Recording, Scene
from sightline.scene.correspondences import collect, settled
from sightline.types import FloatArray, IntArray

MORE_BOXES = 10
"""So many boxes more are weighed against what they cost."""

ENOUGH_GAIN = 0.05
"""Where they would make the ellipses smaller by less than this share, it is enough."""

FEWEST_BOXES = 15
"""Fewer are never enough: the noise that a fit states comes from them as well."""

MODEL = "camera"
_MOST_VIEWS = 400
_MOST_AXES = 120
_ODD_SIGMAS = 3.7
_MOST_ODD = 8
_HUBER = 2.0
_LEAST_LEFT, _LEAST_LEVERAGE, _TINY = 0.05, 0.05, 1e-12
# Clocks are looked for anew when there are so many times more boxes.
_SETTLE_AGAIN = 1.5
_COLUMNS, _ROWS = 8, 4
# A part of the picture counts where so large a share of the frames is.
_LEAST_PASSES = 0.015
_MOST_NAMED = 5


@dataclass(frozen=True, eq=False)
class Situation:
    """A fit, and where it puts the target of one recording in its frames.

    Attributes:
        georeferencer: The fit.
        views: Frames that can be drawn in, thinned; none for a camera on a platform.
        design: Of boxes in that recording; None for such a camera.
    """

    georeferencer: Georeferencer
    views: Views
    design: Design | None


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of the recording that is drawn in.

    Attributes:
        recording: Its name.
        annotator: Who draws.
        frame: (N,) int64, increasing.
        image_size_px: Width and height.
    """

    recording: str
    annotator: str
    frame: IntArray
    image_size_px: tuple[int, int]


class Refits:
    """Refits in one background thread; the newest wins, and none waits twice."""

    def __init__(self, path: Path, frames: Frames) -> None:
        self._path, self._frames = path, frames
        self._condition = threading.Condition()
        self._asked, self._done, self._closed = 0, 0, False
        self._advice = Advice()
        self._situation: Situation | None = None
        self._settled: dict[str, tuple[float, ClockOffset | None]] = {}
        self._settled_at = 0
        self._thread: threading.Thread | None = None

    def ask(self) -> None:
        """Fit anew, now or when the fit that is running has ended."""
        with self._condition:
            if self._closed:
                return
            self._asked += 1
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, daemon=True, name="refit")
                self._thread.start()
            self._condition.notify_all()

    def forget_clocks(self) -> None:
        """Look for the clocks anew with the next fit: what is stated of them has changed."""
        with self._condition:
            self._settled, self._settled_at = {}, 0

    def newest(self) -> tuple[Advice, Situation | None]:
        """What the newest fit that is finished says."""
        with self._condition:
            return replace(self._advice, running=self._asked > self._done), self._situation

    def wait(self, timeout_s: float) -> bool:
        """Wait until no fit is running or asked for; whether that came to be."""
        with self._condition:
            return self._condition.wait_for(lambda: self._asked <= self._done, timeout_s)

    def close(self) -> None:
        """Fit no more; a fit that is running ends first."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def _work(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._closed or self._asked > self._done)
                if self._closed:
                    self._done = self._asked
                    self._condition.notify_all()
                    return
                number = self._asked
            self._round(number)
            with self._condition:
                self._done = number
                self._condition.notify_all()

    def _round(self, number: int) -> None:
        try:
            scene, boxes = self._scene()
            again = boxes >= _SETTLE_AGAIN * self._settled_at
            if not again or self._settled:
                self._publish(*advise(self._with_clocks(scene), self._frames))
            if again and self._asked == number:
                self._settle(scene, boxes)
                self._publish(*advise(self._with_clocks(scene), self._frames))
        except SightlineError as error:
            self._publish(Advice(error=str(error)), None)
        # A fit that fails in a way that nobody foresaw must not end drawing.
        except Exception as error:
            self._publish(Advice(error=f"the fit failed: {error!r}"[:300]), None)

    def _publish(self, advice: Advice, situation: Situation | None) -> None:
        with self._condition:
            self._advice, self._situation = advice, situation

    def _scene(self) -> tuple[Scene, int]:
        """The scene as it is now, and how many boxes there are to learn from."""
        scene = without_empty_tables(Scene.load(self._path))
        boxes = sum(
            len(one.boxes())
            for one in scene.recordings
            if one.boxes_path is not None and one.fixes_path is not None
        )
        return scene, boxes

    def _settle(self, scene: Scene, boxes: int) -> None:
        self._settled_at = max(boxes, 1)
        self._settled = {
            one.name: (one.clock_offset_s, one.clock_found) for one in settled(scene).recordings
        }

    def _with_clocks(self, scene: Scene) -> Scene:
        """The scene with the clocks as they were found last: to look for them takes seconds."""

        def clocked(one: Recording) -> Recording:
            if one.name not in self._settled or one.boxes_path is None:
                return one
            offset_s, found = self._settled[one.name]
            if found is None:
                # Too few boxes then: it is not asked before the next time either.
                prior = one.clock_prior
                found = ClockOffset(one.clock_offset_s, prior.sigma_s, prior.stated)
            return replace(one, clock_offset_s=offset_s, clock_found=found)

        return replace(scene, recordings=tuple(map(clocked, scene.recordings)))


def without_empty_tables(scene: Scene) -> Scene:
    """The scene without those tables of boxes whose last box was thrown away."""
    return replace(
        scene,
        recordings=tuple(
            replace(one, boxes_path=None)
            if one.boxes_path is not None and _is_empty(one.boxes_path)
            else one
            for one in scene.recordings
        ),
    )


def _is_empty(path: Path) -> bool:
    """Whether a table has a header alone: its last box was thrown away."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return False
    return sum(bool(line.strip()) and not line.startswith("#") for line in lines) <= 1


def advise(scene: Scene, frames: Frames) -> tuple[Advice, Situation]:
    """Fit a camera to the boxes of a scene, and say what to draw next.

    Whether the camera was turned is not asked of the pictures, which takes as long as to look at
    them all.

    Raises:
        FitError: There are too few boxes, or no camera explains them.
        InputError: A file of the scene cannot be used.
    """
    inputs = collect(scene, pictures=False)
    fitted = fit(inputs, FitSettings(model=MODEL))
    pairs = inputs.correspondences.in_plane(fitted.plane)
    situation = _situation(scene, frames, fitted)
    report = fitted.report
    taught = _taught(fitted, pairs)
    left_out = _left_out(fitted, taught, situation.design)
    drawn = _drawn_views(fitted, taught, frames)
    axis_m, gain = _expected_gain(situation, drawn, frames)
    thin = _thin(situation.views, pairs, frames)
    enough, reason = _enough(report.n, axis_m, gain, thin)
    advice = Advice(
        boxes=report.n,
        rmse_m=report.rmse_m if left_out is None else left_out.rmse_m,
        left_out=left_out is not None,
        parameters=report.parameters,
        odd=_odd(fitted, left_out, _untaught(fitted, pairs)),
        thin=thin,
        enough=enough,
        reason=reason,
        axis_m=axis_m,
        gain=gain,
        statements=report.statements,
        georeferencer=fitted,
    )
    return advice, situation


def _situation(scene: Scene, frames: Frames, fitted: Georeferencer) -> Situation:
    recording = scene[frames.recording]
    if fitted.moving or fitted.calibrated is None:
        nothing = np.empty(0, dtype=np.int64)
        logged = LoggedFrames.of(recording, nothing, np.empty(0), fitted.plane)
        return Situation(fitted, Views(logged, np.empty((0, 4)), np.empty(0)), None)
    logged = logged_by(recording, frames.frame, fitted)
    rows = np.flatnonzero(logged.known)
    logged = logged[rows[spread_rows(rows.size, _MOST_VIEWS)]]
    expected = logged.expected(recording, fitted, _size(fitted))
    shown = in_picture(expected, fitted.image_size_px)
    level = logged.water_level_m(recording, fitted)
    above = np.broadcast_to(fitted.above_m(None if level is None else level), (len(logged),))
    views = Views(logged, expected.xyxy_px, above)[shown]
    return Situation(fitted, views, Design(fitted, frames.recording, frames.annotator))


def logged_by(recording: Recording, frame: IntArray, fitted: Georeferencer) -> LoggedFrames:
    """Frames beside the log, by the clock that a fit has found.

    Args:
        recording: Whose frames.
        frame: (N,) frames.
        fitted: Tells the plane, and how far the clock is off.

    Raises:
        InputError: The log cannot be used.
    """
    taken_off_s = recording.clock_offset_s
    late_s = fitted.report.clock_offset_s.get(recording.name, -taken_off_s) + taken_off_s
    return LoggedFrames.of(recording, frame, frame_times(recording, frame) + late_s, fitted.plane)


def expected_in(recording: Recording, frame: IntArray, fitted: Georeferencer) -> Expected:
    """The boxes that a fit and the log expect in frames.

    Args:
        recording: Whose frames.
        frame: (N,) frames.
        fitted: Has a camera that stands still.
    """
    return logged_by(recording, frame, fitted).expected(recording, fitted, _size(fitted))


def frame_times(recording: Recording, frame: IntArray) -> FloatArray:
    """(N,) POSIX seconds of frames, NaN where nothing tells them."""
    try:
        clock = recording.clock()
    except SightlineError:
        return np.full(frame.size, np.nan)
    try:
        return np.asarray(clock.time_utc_s(frame), dtype=np.float64)
    except SightlineError:
        pass
    out = np.full(frame.size, np.nan)
    for i, number in enumerate(frame.tolist()):
        try:
            out[i] = float(clock.time_utc_s([number])[0])
        except SightlineError:
            continue
    return out


def _size(fitted: Georeferencer) -> TargetSize:
    """The size of the target by the fit: twice what its hull reaches."""
    usual, sizes = TargetSize(), camera_of(fitted).fit_.sizes
    if sizes is None:
        return usual
    length = max(2.0 * sizes.half_length_m, 0.5)
    share = length / usual.length_m
    return TargetSize(length, usual.beam_m * share, usual.height_m * share)


def _taught(fitted: Georeferencer, pairs: Correspondences) -> Correspondences | None:
    """The pairs that a fit learned from, in its order; None where they cannot be told apart."""
    waiting: dict[tuple[str, int, str], list[int]] = {}
    for i in range(len(pairs)):
        key = (str(pairs.recording[i]), int(pairs.boxes.frame[i]), str(pairs.boxes.source[i]))
        waiting.setdefault(key, []).append(i)
    rows: list[int] = []
    for box in fitted.report.boxes:
        same = waiting.get((box.recording, box.frame, box.source), [])
        if not same or box.frame < 0:
            return None
        rows.append(same.pop(0))
    return pairs[np.array(rows, dtype=np.int64)]


def _as_logged(pairs: Correspondences) -> LoggedFrames:
    n = len(pairs)
    return LoggedFrames(
        pairs.boxes.frame,
        pairs.boxes.time_utc_s,
        pairs.east_north_m,
        pairs.velocity_mps,
        pairs.fix_sigma_m,
        np.zeros(n),
        np.zeros(n),
    )


@dataclass(frozen=True, eq=False)
class _LeftOut:
    """Each box by a fit without it.

    Attributes:
        error_m: (N,) how far off its place is.
        sigmas: (N,) the same in standard deviations.
        off_px: (N, 2) how far its foot is off, to the right and too low.
    """

    error_m: FloatArray
    sigmas: FloatArray
    off_px: FloatArray

    @property
    def rmse_m(self) -> float:
        """Root mean square error."""
        return float(np.sqrt(np.mean(self.error_m**2)))


def _left_out(
    fitted: Georeferencer, taught: Correspondences | None, design: Design | None
) -> _LeftOut | None:
    """Each box by a fit without it, as far as a fit is linear; None where it is not known."""
    if design is None or taught is None or fitted.horizon_px is not None or not len(taught):
        return None
    at, n = _as_logged(taught), len(taught)
    level = taught.water_level_m if fitted.water_level_m is not None else None
    found = design.derivatives(
        at,
        np.broadcast_to(fitted.above_m(level), (n,)),
        taught.boxes.source.tolist(),
        taught.recording.tolist(),
    )
    fit_ = camera_of(fitted).fit_
    residual = fit_.residual_px[:n]
    # Of a box that disagrees the fit takes little.
    weight = np.minimum(1.0, _HUBER / np.maximum(fit_.standard_residual[:n], 1e-9))
    white = design.whitening(at, found, taught.recording.tolist(), weight)
    root = white.forward(np.eye(2 * n).reshape(n, 2, 2 * n)).reshape(2 * n, 2 * n)
    precision = root.T @ root
    pull = (precision @ residual.ravel()).reshape(n, 2)
    onto = (precision @ found.jacobian.reshape(2 * n, -1)).reshape(n, 2, -1)
    off_px, sigmas = np.empty((n, 2)), np.empty(n)
    for i in range(n):
        own = np.linalg.inv(precision[2 * i : 2 * i + 2, 2 * i : 2 * i + 2])
        # What is left of a box, and of its derivatives, beside the others.
        alone, slope = own @ pull[i], own @ onto[i]
        spread = design.covariance @ slope.T
        # The covariance has doubts beyond what the fit takes of a box, which its leverage tells.
        known = slope @ spread
        taken = float(np.trace(np.linalg.solve(own, known)))
        share = min(1.0, max(float(fit_.leverage[i]), _LEAST_LEVERAGE) / max(taken, _TINY))
        # A box that alone carries a parameter has nothing beside it to be held against.
        spread = share * spread
        held = np.linalg.solve(own - share * known + _LEAST_LEFT * own, alone)
        off_px[i] = residual[i] + found.jacobian[i] @ spread @ held
        sigmas[i] = np.sqrt(max(float(alone @ held), 0.0))
    place = np.linalg.solve(found.by_place + _TINY * np.eye(2), off_px[:, :, None])[:, :, 0]
    return _LeftOut(np.hypot(*place.T), sigmas, off_px)


def _drawn_views(
    fitted: Georeferencer, taught: Correspondences | None, frames: Frames
) -> tuple[Views, list[str]]:
    """Boxes of the recording that the fit learned from, and who drew them."""
    if taught is None:
        nothing = np.empty((0, 2))
        none = np.empty(0)
        at = LoggedFrames(
            np.empty(0, dtype=np.int64), none, nothing, nothing.copy(), none, none, none
        )
        return Views(at, np.empty((0, 4)), none), []
    own = taught[np.flatnonzero(taught.recording == frames.recording)]
    level = own.water_level_m if fitted.water_level_m is not None else None
    above = np.broadcast_to(fitted.above_m(level), (len(own),))
    return Views(_as_logged(own), own.boxes.xyxy_px, above), own.boxes.source.tolist()


def _expected_gain(
    situation: Situation, drawn: tuple[Views, list[str]], frames: Frames
) -> tuple[float, float]:
    """Median semi-axis where the log passes, metres, and the share that more boxes take off it."""
    views, design, fitted = situation.views, situation.design, situation.georeferencer
    if design is None or not len(views):
        return float("nan"), float("nan")
    seen = views[spread_rows(len(views), _MOST_AXES)]
    level = None
    if fitted.water_level_m is not None:
        level = seen.above_m + fitted.water_level_m
    before = median_axis_m(axes_95_m(fitted, seen.box_xyxy_px, frames.annotator, level))
    already, sources = drawn
    free = ~np.isin(views.logged.frame, already.logged.frame)
    best = views[by_information(design, fitted, views, free, already, MORE_BOXES)]
    if not len(best):
        return before, 0.0
    old = design.information(already.logged, already.above_m, sources)
    new = design.information(
        already.logged.joined(best.logged),
        np.concatenate([already.above_m, best.above_m]),
        [*sources, *[frames.annotator] * len(best)],
    )
    better = design.model_with(design.after(new - old))
    after = median_axis_m(axes_95_m(better, seen.box_xyxy_px, frames.annotator, level))
    if not np.isfinite(before):
        return before, 1.0 if np.isfinite(after) else float("nan")
    return before, float(np.clip(1.0 - after / before, 0.0, 1.0))


def _untaught(fitted: Georeferencer, pairs: Correspondences) -> list[OddBox]:
    """Boxes that the fit left out, since they and the log beside them cannot both be true."""
    if fitted.moving or fitted.horizon_px is not None or not len(pairs):
        return []
    taught = {(box.recording, box.frame, box.source) for box in fitted.report.boxes}
    level = pairs.water_level_m if fitted.water_level_m is not None else None
    above = np.broadcast_to(fitted.above_m(level), (len(pairs),))
    placed = fitted.regressor.locate(pairs.boxes.xyxy_px, pairs.boxes.source, above)
    off = placed.east_north_m - pairs.east_north_m
    out = []
    for i in np.flatnonzero(pairs.fix_sigma_m == 0.0):
        recording, source = str(pairs.recording[i]), str(pairs.boxes.source[i])
        frame = int(pairs.boxes.frame[i])
        if (recording, frame, source) in taught:
            continue
        known = np.isfinite(off[i]).all()
        spread = placed.covariance_m2[i]
        sigmas = float(np.sqrt(off[i] @ np.linalg.solve(spread, off[i]))) if known else np.inf
        error_m = float(np.hypot(*off[i])) if known else float("inf")
        said = (
            f"The box of frame {frame} is left out: it and the log beside it cannot both be true; "
            "look at its lower edge, and at the log."
        )
        out.append(OddBox(recording, frame, source, sigmas, error_m, said))
    return out


def _odd(
    fitted: Georeferencer, left_out: _LeftOut | None, untaught: Sequence[OddBox]
) -> tuple[OddBox, ...]:
    """Boxes that disagree with the others, the oddest first."""
    found = list(untaught)
    for i, box in enumerate(fitted.report.boxes):
        sigmas = float("nan") if left_out is None else float(left_out.sigmas[i])
        error_m = box.error_m if left_out is None else float(left_out.error_m[i])
        if not (box.outlier or sigmas > _ODD_SIGMAS):
            continue
        why = "disagrees with all others and counts little" if box.outlier else "is far off"
        if left_out is not None:
            right, low = left_out.off_px[i]
            why += (
                f": its foot is {abs(low):.1f} px too {'low' if low > 0.0 else 'high'} and "
                f"{abs(right):.1f} px too far {'right' if right > 0.0 else 'left'}"
            )
        said = f"The box of frame {box.frame} {why}; look at its lower edge, and at the log."
        found.append(OddBox(box.recording, box.frame, box.source, sigmas, error_m, said))
    found.sort(key=lambda one: -np.nan_to_num(one.sigmas, nan=_ODD_SIGMAS))
    return tuple(found[:_MOST_ODD])


def _thin(views: Views, pairs: Correspondences, frames: Frames) -> tuple[ThinCell, ...]:
    """Parts of the picture in which the log passes, and no box ends; the most passed first."""
    if not len(views):
        return ()
    width, height = frames.image_size_px
    foot = views.foot_px
    low = max(0.0, float(foot[:, 1].min()) - 1.0)
    high = min(float(height), float(foot[:, 1].max()) + 1.0)
    columns = np.linspace(0.0, width, _COLUMNS + 1)
    rows = np.linspace(low, high, _ROWS + 1)
    box = pairs.boxes.xyxy_px
    ends = np.stack([0.5 * (box[:, 0] + box[:, 2]), box[:, 3]], axis=1)
    passes, drawn = (
        np.histogram2d(at[:, 0], at[:, 1], bins=[columns, rows])[0] for at in (foot, ends)
    )
    wanted = (drawn == 0) & (passes >= max(2.0, _LEAST_PASSES * len(views)))
    cells = [(int(passes[i, j]), int(i), int(j)) for i, j in np.argwhere(wanted)]
    out = []
    for count, i, j in sorted(cells, reverse=True):
        x1, x2, y1, y2 = columns[i], columns[i + 1], rows[j], rows[j + 1]
        inside = (foot[:, 0] >= x1) & (foot[:, 0] <= x2) & (foot[:, 1] >= y1) & (foot[:, 1] <= y2)
        some = views.logged.frame[inside]
        chosen = some[spread_rows(some.size, _MOST_NAMED)].tolist()
        out.append(ThinCell(float(x1), float(y1), float(x2), float(y2), 0, count, tuple(chosen)))
    return tuple(out)


def _enough(boxes: int, axis_m: float, gain: float, thin: tuple[ThinCell, ...]) -> tuple[bool, str]:
    """Whether more boxes will not help, and why or why not, in a sentence."""
    if not np.isfinite(gain):
        return False, "What more boxes would tell is not known: the log shows no place in view."
    now = f"the median 95 % ellipse reaches {axis_m:.1f} m where the log passes"
    if not np.isfinite(axis_m):
        now = "where the log passes, places are not known yet"
    if boxes < FEWEST_BOXES:
        return False, f"{boxes} boxes; {FEWEST_BOXES} are the fewest that are enough ({now})."
    if gain >= ENOUGH_GAIN:
        share = f"{100.0 * gain:.0f} %"
        return False, f"{MORE_BOXES} boxes more would make ellipses {share} smaller ({now})."
    said = (
        f"More boxes will not help: {MORE_BOXES} more would make ellipses "
        f"{100.0 * gain:.1f} % smaller ({now})."
    )
    if thin:
        said += f" In {len(thin)} parts of the picture where the log passes there is none, though."
    return True, said
