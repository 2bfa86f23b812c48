"""Fit report: parameters, biases, residuals, and sentences for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from sightline.camera.calibration import CameraFit
from sightline.camera.observations import Landmarks
from sightline.camera.parameters import PARAMETERS, TARGET, TARGET_PARAMETERS
from sightline.camera.stated import StatedCamera
from sightline.clock_offset import ClockOffset, RecordingClock
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.models import BoxModel
from sightline.types import BoolArray, FloatArray

# Residuals of control points that are larger than so rarely by chance are said.
_BY_CHANCE = 1e-3
_UNITS = {"_m": "m", "_deg": "degrees", "_px": "px"}


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter of the camera or the target.

    Attributes:
        name: As in `PARAMETERS`, then `TARGET_PARAMETERS` where there were boxes.
        value: In ``unit``.
        sigma: Standard deviation, in ``unit``.
        unit: ``"m"``, ``"degrees"``, ``"px"`` or ``""``.
        determined: Whether the data, not the prior, determines it.
    """

    name: str
    value: float
    sigma: float
    unit: str
    determined: bool


@dataclass(frozen=True)
class SourceBias:
    """The lower-edge bias of a source of boxes.

    Attributes:
        name: Of the annotator or detector.
        n: Boxes of it in the fit.
        bias_px: How many pixels too low its lower edges lie, whatever the range.
        bias_m: At what height above the water or road its lower edges lie, metres; negative is
            too low.
        sigma_px: Standard deviation of ``bias_px``.
        sigma_m: Standard deviation of ``bias_m``.
    """

    name: str
    n: int
    bias_px: float
    bias_m: float
    sigma_px: float
    sigma_m: float


@dataclass(frozen=True)
class FittedBox:
    """Residual and leverage of one box of the fit.

    Attributes:
        recording: Its recording.
        frame: Its frame, -1 if it had none.
        source: Who made it.
        error_m: Between the model's place and the log's.
        residual_px: Between its foot and where the camera expects it, pixels; NaN where the model
            has no camera.
        leverage: Its leverage on the fit, NaN where the model does not tell.
        outlier: Whether the fit took it for one.
    """

    recording: str
    frame: int
    source: str
    error_m: float
    residual_px: float
    leverage: float
    outlier: bool


@dataclass(frozen=True)
class FittedPoint:
    """Residual and leverage of one control point of the fit.

    Attributes:
        number: In the order of the scene, the first is 1.
        x_px: Its column.
        y_px: Its row.
        error_m: Between where the camera puts its pixel and its place; NaN above the horizon.
        residual_px: Between its pixel and where the camera expects it, pixels.
        sigmas: The same over its standard deviation, root mean square of column and row.
        leverage: Its leverage on the fit.
        outlier: Whether the fit took it for one.
    """

    number: int
    x_px: float
    y_px: float
    error_m: float
    residual_px: float
    sigmas: float
    leverage: float
    outlier: bool


@dataclass(frozen=True)
class FitReport:
    """Report of a fit.

    Attributes:
        model: Name of the model.
        n: Correspondences that it learned from.
        asked: Boxes that there were.
        control_points: Control points that it learned from.
        recordings: Their names.
        rmse_m: Root mean square error of the pairs themselves and of the control points, metres; of
            those pairs whose places are certain, where there are gaps in the logs.
        median_m: Median error of these, metres.
        parameters: Of the camera; none for the paper's models.
        sources: Of the boxes; none for the paper's models.
        clock_offset_s: By recording, how far its clock is to be moved on to agree with the log: of
            the other sign than ``clocks``, which it was there before.
        boxes: One a pair.
        points: One a control point.
        statements: Sentences for people: what could not be determined, what stands out.
        clocks: By recording, how far its clock is ahead of the log's, with its standard deviation.
    """

    model: str
    n: int
    asked: int
    control_points: int
    recordings: tuple[str, ...]
    rmse_m: float
    median_m: float
    parameters: tuple[Parameter, ...] = ()
    sources: tuple[SourceBias, ...] = ()
    clock_offset_s: dict[str, float] = field(default_factory=dict)
    boxes: tuple[FittedBox, ...] = ()
    points: tuple[FittedPoint, ...] = ()
    statements: tuple[str, ...] = ()
    clocks: dict[str, ClockOffset] = field(default_factory=dict)

    def with_clocks(self, clocks: Mapping[str, ClockOffset]) -> FitReport:
        """The report with clock offsets, and a sentence for each that is used."""
        said = [
            f"The clock of recording {name} is {clock.words}; its tracks and scores are in the "
            "log's time."
            for name, clock in clocks.items()
            if clock.used_s
        ]
        return replace(
            self,
            clocks=dict(clocks),
            clock_offset_s={name: -clock.offset_s for name, clock in clocks.items()},
            statements=(*said, *self.statements),
        )

    def to_dict(self) -> dict[str, object]:
        """The report as JSON can hold it; NaN and infinities become None."""
        return {key: _jsonable(value) for key, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> FitReport:
        """Restore the report from `to_dict`.

        Raises:
            LookupError: A field is missing.
            TypeError: There are others than there should be.
        """

        def number(value: float | None) -> float:
            return float("nan") if value is None else float(value)

        fields = dict(content)
        fields["rmse_m"], fields["median_m"] = number(fields["rmse_m"]), number(fields["median_m"])
        fields["recordings"] = tuple(fields["recordings"])
        fields["statements"] = tuple(fields["statements"])
        fields["parameters"] = tuple(Parameter(**p) for p in fields["parameters"])
        fields["sources"] = tuple(SourceBias(**s) for s in fields["sources"])
        fields["clocks"] = {
            name: ClockOffset(**own) for name, own in fields.get("clocks", {}).items()
        }
        fields["boxes"] = tuple(
            FittedBox(**{**b, **{k: number(b[k]) for k in ("error_m", "residual_px", "leverage")}})
            for b in fields["boxes"]
        )
        numbers = ("error_m", "residual_px", "sigmas", "leverage")
        fields["points"] = tuple(
            FittedPoint(**{**p, **{k: number(p[k]) for k in numbers}})
            for p in fields.get("points", ())
        )
        return cls(**fields)


def _jsonable(value: object) -> object:
    if isinstance(value, dict):
        return {str(k): _jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def fit_report(
    model: str,
    regressor: BoxModel,
    pairs: Correspondences,
    places: FloatArray,
    control: Landmarks,
    *,
    clocks: Mapping[str, RecordingClock],
    stated: StatedCamera | None = None,
) -> FitReport:
    """The report of a fit.

    Args:
        model: Name of the model.
        regressor: Fitted.
        pairs: What it learned from.
        places: (N, 2) metres east and north, where it puts their boxes.
        control: Control points that it learned from.
        clocks: What was known of the recordings' clocks before the fit.
        stated: What was known of the camera. Absent: nothing.
    """
    error = np.hypot(*(places - pairs.east_north_m).T)
    certain = error[pairs.certain_rows()]
    n = len(pairs)
    leverage, outlier = np.full(n, np.nan), np.zeros(n, dtype=bool)
    residual = np.full(n, np.nan)
    more: dict[str, Any] = {}
    points: tuple[FittedPoint, ...] = ()
    if isinstance(regressor, CameraRegressor):
        points = _points(regressor, n, control)
        leverage, outlier = regressor.fit_.leverage[:n], regressor.fit_.outlier[:n]
        residual = np.hypot(*regressor.fit_.residual_px[:n].T)
        more = _camera_report(regressor, pairs, len(control), outlier)
        stated = stated or StatedCamera()
        told = [PARAMETERS[slot] for slot in stated.parameters]
        undetermined = on_undetermined(more["parameters"], told)
        of_points = _on_points(points, stated)
        more["statements"] = (*of_points, *undetermined, *more["statements"])
    errors = np.concatenate([certain, [point.error_m for point in points]])
    known = np.isfinite(errors).any()
    report = FitReport(
        model=model,
        n=n,
        asked=pairs.asked,
        control_points=len(points),
        recordings=tuple(str(name) for name in np.unique(pairs.recording)),
        rmse_m=float(np.sqrt(np.nanmean(errors**2))) if known else float("nan"),
        median_m=float(np.nanmedian(errors)) if known else float("nan"),
        points=points,
        boxes=tuple(
            FittedBox(
                recording=str(pairs.recording[i]),
                frame=int(pairs.boxes.frame[i]),
                source=str(pairs.boxes.source[i]),
                error_m=float(error[i]),
                residual_px=float(residual[i]),
                leverage=float(leverage[i]),
                outlier=bool(outlier[i]),
            )
            for i in range(n)
        ),
        **more,
    )
    return report.with_clocks(_clocks(regressor, pairs, clocks))


def _points(regressor: CameraRegressor, n: int, control: Landmarks) -> tuple[FittedPoint, ...]:
    """Control points of a fit, whose rows follow those of its N boxes."""
    if not len(control):
        return ()
    fitted = regressor.fit_
    found = np.stack(fitted.camera.locate(control.pixel_px), axis=1)
    error = np.hypot(*(found - control.east_north_m).T)
    return tuple(
        FittedPoint(
            number=i + 1,
            x_px=float(control.pixel_px[i, 0]),
            y_px=float(control.pixel_px[i, 1]),
            error_m=float(error[i]),
            residual_px=float(np.hypot(*fitted.residual_px[n + i])),
            sigmas=float(fitted.standard_residual[n + i]),
            leverage=float(fitted.leverage[n + i]),
            outlier=bool(fitted.outlier[n + i]),
        )
        for i in range(len(control))
    )


def _on_points(points: Sequence[FittedPoint], stated: StatedCamera) -> list[str]:
    """What is to be said of control points that lie elsewhere than the camera sees them."""
    out = []
    wrong = [point for point in points if point.outlier]
    if wrong:
        where = ", ".join(
            f"{p.number} at {p.x_px:.0f}, {p.y_px:.0f} px by {p.residual_px:.0f} px"
            for p in wrong[:5]
        )
        out.append(
            f"{len(wrong)} of {len(points)} control points disagree with all others and count "
            f"little ({where})."
        )
    others = points if 2 * len(wrong) >= len(points) else [p for p in points if not p.outlier]
    # What the fit took of their 2 N numbers is as much less to be expected.
    left = 2.0 * len(others) - sum(point.leverage for point in others)
    squares = 2.0 * sum(point.sigmas**2 for point in others)
    if others and left > 0.0 and chi2.sf(squares, max(left, 1.0)) < _BY_CHANCE:
        off_px = np.sqrt(np.mean([point.residual_px**2 for point in others]))
        cut = "" if stated.principal_point_px else ", or the picture was cut out of a larger one"
        mend = "" if stated.principal_point_px else " (state [camera] principal_point_px)"
        out.append(
            f"Control points lie {off_px:.1f} px RMSE from where the camera sees them, "
            f"{np.sqrt(squares / max(left, 1.0)):.1f} times what is assumed of them: pixels or "
            f"places are wrong{cut}{mend}; the stated uncertainty is too small."
        )
    return out


def _clocks(
    regressor: BoxModel, pairs: Correspondences, known: Mapping[str, RecordingClock]
) -> dict[str, ClockOffset]:
    """Clock offsets after the fit: those that it estimated, and others as they were found."""
    learned = np.unique(pairs.recording).tolist()
    out = {name: known[name].found for name in learned if name in known and known[name].found}
    if isinstance(regressor, CameraRegressor):
        fitted = regressor.fit_
        sigma = np.sqrt(np.diag(fitted.covariance))[fitted.layout.clocks]
        for group, late_s, own in zip(
            fitted.clock_groups, fitted.clock_offset_s, sigma, strict=True
        ):
            if group < len(learned):
                before = known.get(learned[group], RecordingClock())
                out[learned[group]] = before.after(float(late_s), float(own))
    return {name: clock for name, clock in sorted(out.items()) if clock is not None}


def _camera_report(
    regressor: CameraRegressor, pairs: Correspondences, control_points: int, outlier: BoolArray
) -> dict[str, Any]:
    fitted = regressor.fit_
    sigma = np.sqrt(np.diag(fitted.covariance))
    sources = []
    for i, name in enumerate(regressor.sources_):
        in_px, in_m = fitted.layout.bias_px(i), fitted.layout.bias_m(i)
        sources.append(
            SourceBias(
                name=name,
                n=int(np.sum(pairs.boxes.source == name)),
                bias_px=float(fitted.vector[in_px]),
                bias_m=float(fitted.vector[in_m]),
                sigma_px=float(sigma[in_px]),
                sigma_m=float(sigma[in_m]),
            )
        )
    return {
        "parameters": fitted_parameters(fitted, of_target=bool(len(pairs))),
        "sources": tuple(sources),
        "statements": _statements(fitted, pairs, control_points, outlier),
    }


def fitted_parameters(fitted: CameraFit, *, of_target: bool) -> tuple[Parameter, ...]:
    """Parameters of a fit as a report has them: with their units, and which the data determines.

    Args:
        fitted: The fit.
        of_target: Whether there were boxes, which tell the size of the target.
    """
    camera, determined = fitted.camera, fitted.determined()
    sigma = np.sqrt(np.diag(fitted.covariance))
    parameters = []
    for i, name in enumerate(PARAMETERS):
        value = float(getattr(camera, name))
        scale = {"height_m": value, "focal_px": value}.get(
            name, np.degrees(1.0) if name.endswith("_deg") else 1.0
        )
        unit = next((u for end, u in _UNITS.items() if name.endswith(end)), "")
        parameters.append(
            Parameter(name, value, float(sigma[i] * scale), unit, bool(determined[i]))
        )
    if of_target:
        known = fitted.target_determined()
        for i, name in enumerate(TARGET_PARAMETERS):
            value = float(fitted.vector[TARGET][i])
            own_sigma = float(sigma[TARGET][i])
            parameters.append(Parameter(name, value, own_sigma, "m", bool(known[i])))
    return tuple(parameters)


def on_undetermined(parameters: Sequence[Parameter], told: Sequence[str]) -> list[str]:
    """What is to be said of parameters that the data does not determine."""
    unknown = [p.name for p in parameters if p.name in PARAMETERS and not p.determined]
    usual, stated = ([n for n in unknown if (n in told) == known] for known in (False, True))
    out = []
    if usual:
        out.append(
            f"The data does not determine {', '.join(usual)}: what is assumed of an ordinary "
            "camera decides, and positions away from the training boxes are unsurer for it."
        )
    if stated:
        out.append(f"What is stated decides more than the data does: {', '.join(stated)}.")
    return out


def _statements(
    fitted: CameraFit,
    pairs: Correspondences,
    control_points: int,
    outlier: BoolArray,
) -> tuple[str, ...]:
    out = []
    if fitted.noise.heave_m > 0.0:
        share = fitted.noise.heave_m / fitted.camera.height_m
        out.append(
            f"The camera rises and falls by {fitted.noise.heave_m:.2f} m (standard deviation), and "
            f"with it all ranges by {100.0 * share:.1f} %; that is part of the stated uncertainty."
        )
    if fitted.starts_agreeing < 0.5 * fitted.starts:
        out.append(
            f"Only {fitted.starts_agreeing} of {fitted.starts} starts ended at this camera; "
            "another may explain the data as well."
        )
    if outlier.any():
        where = ", ".join(
            f"{pairs.recording[i]}/{pairs.boxes.frame[i]}" for i in np.flatnonzero(outlier)[:5]
        )
        out.append(
            f"{int(outlier.sum())} of {len(pairs)} boxes disagree with all others and count "
            f"little (recording/frame {where})."
        )
    heavy = fitted.leverage.max(initial=0.0)
    if heavy > 1.5 and len(pairs) + control_points > 8:
        what = "box" if np.argmax(fitted.leverage) < len(pairs) else "control point"
        out.append(
            f"A single {what} carries {heavy:.1f} parameters of the fit; more {what}"
            f"{'es' if what == 'box' else 's'} near it would make the camera surer."
        )
    return tuple(out)
