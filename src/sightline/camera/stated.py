"""Statements of the user about a camera, with standard deviations, and the prior that they make."""

from __future__ import annotations

import math
from collections.abc import Collection, Container, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sightline.camera.parameters import (
    CURVATURE,
    HEADING,
    LOG_FOCAL,
    LOG_HEIGHT,
    PITCH,
    PRINCIPAL_DX,
    PRINCIPAL_DY,
    ROLL,
)
from sightline.camera.pinhole import EARTH_RADIUS_M, Camera
from sightline.camera.priors import CameraPrior

# Standard deviations of what is stated without one.
STATED_HEIGHT_SHARE = 0.1
"""Of the height: read off a plan, and the water is not always where the plan has it."""

STATED_FOCAL_SHARE = 0.05
"""Of the focal length, and of the field of view: data sheets round, and zooms are set by hand."""

PICTURE_FOCAL_SHARE = 0.08
"""Of a focal length that pictures carry: its 35-mm equivalent is one by the width for some makers
and by the diagonal for others, and stabilisation crops."""

STATED_HEADING_DEG = 5.0
"""Of the heading: that of a compass near iron, or of a line on a map."""

STATED_PITCH_DEG = 2.0
"""Of the pitch: of the lens, and not of the housing that an inclinometer is held to."""

STATED_ROLL_DEG = 1.0
"""Of the roll: people see a slanting horizon."""

STATED_RADIUS_SHARE = 0.1
"""Of the effective radius of the earth: refraction differs as much from one hour to the next."""

# Nothing is known better than this, and nothing else could be told beside it.
_LEAST_SHARE, _LEAST_DEG, _LEAST_PX = 1e-4, 1e-3, 0.01
# What is to hold nothing has so many times the usual standard deviation.
_WIDE = 5.0


Stated = tuple[float, float]
"""A value and its standard deviation."""


@dataclass(frozen=True)
class StatedCamera:
    """Beliefs of the user about a camera, each with its standard deviation, or None.

    Attributes:
        height_m: Above the water or the road, metres.
        horizontal_fov_deg: Angle between the left and the right edge of the picture, degrees.
        focal_px: Focal length, pixels.
        heading_deg: Bearing of the optical axis, degrees clockwise from north, or from the bow.
        pitch_deg: Of the optical axis below the horizontal, degrees.
        roll_deg: Positive where the right end of the horizon lies lower, degrees.
        principal_point_px: Column, row and the standard deviation of either, which may be NaN: as
            that of any lens.
        effective_earth_radius_m: Of the water as sight lines see it, that refraction bends.
        focal_in_pictures: Whether the focal length was read from the pictures.
    """

    height_m: Stated | None = None
    horizontal_fov_deg: Stated | None = None
    focal_px: Stated | None = None
    heading_deg: Stated | None = None
    pitch_deg: Stated | None = None
    roll_deg: Stated | None = None
    principal_point_px: tuple[float, float, float] | None = None
    effective_earth_radius_m: Stated | None = None
    focal_in_pictures: bool = False

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of what is stated."""
        return tuple(key for key in SLOTS if getattr(self, key) is not None)

    @property
    def parameters(self) -> tuple[int, ...]:
        """Slots of the camera of which something is stated."""
        return tuple(slot for key in self.keys for slot in SLOTS[key])

    def prior(
        self, usual: CameraPrior, image_size_px: tuple[int, int], *, wide: Collection[str] = ()
    ) -> CameraPrior:
        """The prior with what is stated in place of what is usual.

        Args:
            usual: What is believed of all that nothing is stated of.
            image_size_px: Width and height.
            wide: Keys whose values are to hold next to nothing: their standard deviations are so
                wide that the data decides.
        """
        out = usual
        if self.principal_point_px is not None:
            out = self._about_the_principal_point(out, image_size_px)
        if self.height_m is not None:
            out = replace(
                out, height_m=self.height_m[0], log_height_sigma=_log_sigma(self.height_m)
            )
        if self.focal_px is not None:
            focal_px, sigma = self.focal_px[0], _log_sigma(self.focal_px)
            out = replace(out, focal_widths=focal_px / image_size_px[0], log_focal_sigma=sigma)
        elif self.horizontal_fov_deg is not None:
            out = self._of_the_field_of_view(out, self.horizontal_fov_deg, image_size_px)
        if self.heading_deg is not None:
            out = replace(out, heading_deg=_angle(self.heading_deg))
        if self.pitch_deg is not None:
            out = replace(out, pitch_deg=_angle(self.pitch_deg))
        if self.roll_deg is not None:
            out = replace(out, roll_deg=_angle(self.roll_deg))
        if self.effective_earth_radius_m is not None:
            radius_m, sigma_m = self.effective_earth_radius_m
            left = EARTH_RADIUS_M / radius_m
            out = replace(out, curvature=(left, max(left * sigma_m / radius_m, _LEAST_SHARE)))
        return _widened(out, wide) if wide else out

    def wanted(self, key: str, camera: Camera, sigma: float) -> tuple[str, str]:
        """What is stated of a key, and what a camera has in its place, as a reader writes them.

        Args:
            key: One of ``keys``.
            camera: Fitted.
            sigma: Standard deviation of its parameter, as a parameter vector holds it.
        """
        width, height = camera.image_size_px
        if key == "principal_point_px":
            assert self.principal_point_px is not None, "a key of those that are stated"
            column, row, _ = self.principal_point_px
            at = (0.5 * width + camera.principal_dx_px, 0.5 * height + camera.principal_dy_px)
            return f"[{column:.0f}, {row:.0f}]", f"[{at[0]:.0f}, {at[1]:.0f}] ± {sigma:.0f}"
        value, own = getattr(self, key)
        if key == "height_m":
            found, of_found = camera.height_m, sigma * camera.height_m
        elif key == "focal_px":
            found, of_found = camera.focal_px, sigma * camera.focal_px
        elif key == "horizontal_fov_deg":
            found = horizontal_fov_deg(camera)
            of_found = sigma * float(np.degrees(np.sin(np.radians(found))))
        elif key == "effective_earth_radius_m":
            if camera.curvature <= 0.0:
                return f"{value:.3g} ± {own:.2g}", "none, the water being flat"
            found = EARTH_RADIUS_M / camera.curvature
            of_found = found * sigma / camera.curvature
            return f"{value:.3g} ± {own:.2g}", f"{found:.3g} ± {of_found:.2g}"
        else:
            found, of_found = getattr(camera, key), float(np.degrees(sigma))
        return _in_words(value, own), _in_words(found, of_found)

    def _about_the_principal_point(
        self, usual: CameraPrior, image_size_px: tuple[int, int]
    ) -> CameraPrior:
        assert self.principal_point_px is not None, "the caller has looked"
        (width, height), (column, row, sigma_px) = image_size_px, self.principal_point_px
        # A picture whose axis is not in its middle was cut out of one as large as this at least.
        times = max(
            2.0 * max(column, width - column) / width, 2.0 * max(row, height - row) / height
        )
        sigma = usual.principal_sigma_widths * times
        if not math.isnan(sigma_px):
            sigma = max(sigma_px, _LEAST_PX) / width
        return replace(
            usual,
            principal_widths=((column - 0.5 * width) / width, (row - 0.5 * height) / width),
            principal_sigma_widths=sigma,
            focal_widths=usual.focal_widths * times,
        )

    def _of_the_field_of_view(
        self, usual: CameraPrior, field_deg: Stated, image_size_px: tuple[int, int]
    ) -> CameraPrior:
        width = image_size_px[0]
        column = 0.5 * width + usual.principal_widths[0] * width
        angle, sigma = np.radians(field_deg).tolist()
        focal_px = _focal_px(width, column, angle)
        slope = math.log(_focal_px(width, column, angle * 1.001) / focal_px) / (angle * 0.001)
        # How much of the angle is the lens's distortion, nobody says.
        edge = max(abs(column), abs(width - column)) / focal_px
        spread = math.hypot(slope * sigma, usual.k1_sigma * edge**2, usual.k2_sigma * edge**4)
        return replace(
            usual,
            focal_widths=focal_px / width,
            log_focal_sigma=min(spread, usual.log_focal_sigma),
        )


SLOTS: dict[str, tuple[int, ...]] = {
    "height_m": (LOG_HEIGHT,),
    "horizontal_fov_deg": (LOG_FOCAL,),
    "focal_px": (LOG_FOCAL,),
    "heading_deg": (HEADING,),
    "pitch_deg": (PITCH,),
    "roll_deg": (ROLL,),
    "principal_point_px": (PRINCIPAL_DX, PRINCIPAL_DY),
    "effective_earth_radius_m": (CURVATURE,),
}
"""Slots of a parameter vector that each key of `StatedCamera` is about."""


def stated_camera(values: Mapping[str, float | list[float] | None]) -> StatedCamera:
    """Beliefs from values without standard deviations, or with them.

    Args:
        values: By key of `StatedCamera`: the value alone, or with its standard deviation.
    """
    shares = {
        "height_m": STATED_HEIGHT_SHARE,
        "focal_px": STATED_FOCAL_SHARE,
        "horizontal_fov_deg": STATED_FOCAL_SHARE,
        "effective_earth_radius_m": STATED_RADIUS_SHARE,
    }
    sigmas = {
        "heading_deg": STATED_HEADING_DEG,
        "pitch_deg": STATED_PITCH_DEG,
        "roll_deg": STATED_ROLL_DEG,
    }
    found: dict[str, Stated] = {}
    for key in {**shares, **sigmas}:
        stated = values.get(key)
        if isinstance(stated, list):
            found[key] = (stated[0], stated[1])
        elif stated is not None:
            own = sigmas[key] if key in sigmas else shares[key] * stated
            found[key] = (float(stated), own)
    point = values.get("principal_point_px")
    return StatedCamera(
        height_m=found.get("height_m"),
        horizontal_fov_deg=found.get("horizontal_fov_deg"),
        focal_px=found.get("focal_px"),
        heading_deg=found.get("heading_deg"),
        pitch_deg=found.get("pitch_deg"),
        roll_deg=found.get("roll_deg"),
        principal_point_px=(point[0], point[1], point[2] if len(point) > 2 else math.nan)
        if isinstance(point, list)
        else None,
        effective_earth_radius_m=found.get("effective_earth_radius_m"),
    )


def horizontal_fov_deg(camera: Camera) -> float:
    """Angle between the left and the right edge of a camera's picture, degrees.

    Without the distortion, where the lens model folds before an edge.
    """
    width = camera.image_size_px[0]
    row = 0.5 * camera.image_size_px[1] + camera.principal_dy_px
    for lens in (camera, replace(camera, k1=0.0, k2=0.0)):
        left, right = lens.rays([[0.0, row], [float(width), row]])
        if np.isfinite([left, right]).all():
            break
    return float(np.degrees(np.arccos(np.clip(left @ right, -1.0, 1.0))))


def _focal_px(width: float, column: float, angle: float) -> float:
    """Focal length of a lens without distortion that sees the width of a picture at an angle."""
    cosine, sine = math.cos(angle), math.sin(angle)
    inside = (width * cosine) ** 2 + 4.0 * column * (width - column) * sine**2
    return (width * cosine + math.sqrt(max(inside, 0.0))) / (2.0 * sine)


def _in_words(value: float, sigma: float) -> str:
    """A value with as many digits as its standard deviation leaves it."""
    digits = min(max(1 - math.floor(math.log10(max(sigma, 1e-9))), 0), 3)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _log_sigma(stated: Stated) -> float:
    """Standard deviation of the logarithm of a positive value."""
    return math.sqrt(math.log1p(max(stated[1] / stated[0], _LEAST_SHARE) ** 2))


def _angle(stated: Stated) -> Stated:
    return stated[0], max(stated[1], _LEAST_DEG)


def _widened(prior: CameraPrior, keys: Container[str]) -> CameraPrior:
    """The prior with the standard deviations of some keys so wide that they hold next to nothing.

    Wider than the usual ones by far: that a camera is no ordinary one is no word against a key.
    """
    usual, out = CameraPrior(), prior
    if "height_m" in keys:
        out = replace(out, log_height_sigma=_WIDE * usual.log_height_sigma)
    if "focal_px" in keys or "horizontal_fov_deg" in keys:
        out = replace(out, log_focal_sigma=_WIDE * usual.log_focal_sigma)
    if "heading_deg" in keys:
        out = replace(out, heading_deg=None)
    if "pitch_deg" in keys:
        out = replace(out, pitch_deg=(prior.pitch_deg[0], _WIDE * usual.pitch_deg[1]))
    if "roll_deg" in keys:
        out = replace(out, roll_deg=(prior.roll_deg[0], _WIDE * usual.roll_deg[1]))
    if "principal_point_px" in keys:
        widths = _WIDE * max(usual.principal_sigma_widths, prior.principal_sigma_widths)
        out = replace(out, principal_sigma_widths=widths)
    if "effective_earth_radius_m" in keys:
        out = replace(out, curvature=(prior.curvature[0], _WIDE * usual.curvature[1]))
    return out
