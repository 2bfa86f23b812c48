"""Fast path of `CameraRegressor.predict` for a single box, in plain numbers.

A live tracker asks for one box and waits for the answer. Then nearly all the time of array
operations is that of calling them, some hundred of them; numbers take a few microseconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from sightline.camera.calibration import CameraFit
from sightline.camera.pinhole import BY_ABOVE, BY_COLUMN, BY_ROW, Camera, locate_one
from sightline.camera.priors import ANY_ASPECT, ANY_ASPECT_SPREAD
from sightline.georeferencing.residual_gp import ResidualProcess
from sightline.types import FloatArray

MOST_SQUARED = 4.0
"""Squared relative deviations beyond this tell nothing, and would only overflow."""


class FittedCamera(Protocol):
    """Protocol of what `place_one` needs of a fitted `CameraRegressor`."""

    camera_: Camera
    fit_: CameraFit
    above_sigma_m: float
    range_process_: ResidualProcess | None
    bearing_process_: ResidualProcess | None
    half_m: FloatArray
    aboard_m2: float
    lasting_m2: float
    clock_variance: float

    def bias_root(self, source: str) -> tuple[float, float, FloatArray, FloatArray]:
        """Bias of a source, pixels and metres, and a root of the covariance of all parameters."""
        ...


def place_one(
    model: FittedCamera,
    box: FloatArray,
    source: str,
    largest_sigma: Callable[[float], float],
    above_m: float = 0.0,
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Position of one box.

    Args:
        model: A fitted model.
        box: (4,) pixels.
        source: Who made the box.
        largest_sigma: By a range, its largest standard deviation; where it is less certain there
            is no position.
        above_m: How high the water stands above the plane that the camera's height is over.

    Returns:
        Place (1, 2), covariance (1, 2, 2), and the part of it that a target shares with itself
        (1, 2, 2); None where there is no position.
    """
    x1, y1, x2, y2 = box.tolist()
    camera = model.camera_
    bias_px, bias_m, root, of_target = model.bias_root(source)
    height_m = camera.height_m - above_m
    half_length, half_beam = model.half_m.tolist()
    sizes = model.fit_.sizes
    length = beam = ANY_ASPECT
    spread = ANY_ASPECT_SPREAD

    def hull(distance_m: float) -> float:
        nonlocal length, beam, spread
        if sizes is not None:
            slant_m = math.hypot(distance_m, height_m)
            length, beam, *rest = sizes.reach_one((x2 - x1) * slant_m / camera.focal_px)
            spread = (rest[0], rest[1], rest[2])
        return float(half_length * length + half_beam * beam)

    at = locate_one(camera, 0.5 * (x1 + x2), y2 - bias_px, bias_m + above_m, hull)
    if at is None:
        return None
    distance, sine, cosine, by = at
    shift = root @ by[:BY_COLUMN]
    shift[:, 0] += of_target @ (length, beam)
    (along, mixed), (_, across) = (shift.T @ shift).tolist()
    skewed = ranges_variance(along, distance) - along
    along += (model.above_sigma_m * float(by[BY_ABOVE, 0])) ** 2
    slant = np.array([camera.focal_px**2 / (distance * distance + height_m**2)])
    of_column, of_row = (float(one[0]) for one in model.fit_.noise.variances_px2(slant))
    (row_along, row_across), (column_along, column_across) = by[[BY_ROW, BY_COLUMN]].tolist()
    noise = model.fit_.noise
    last_column, last_row = noise.lasting_px2()
    last_along = last_column * column_along**2 + last_row * row_along**2
    last_along += model.lasting_m2 + model.aboard_m2 * (length**2 + spread[0])
    last_along += half_length**2 * spread[0] + half_beam**2 * spread[1]
    last_along += 2.0 * half_length * half_beam * spread[2]
    last_across = last_column * column_across**2 + last_row * row_across**2
    last_across += model.lasting_m2 + model.aboard_m2 * (beam**2 + spread[1])
    last_mixed = last_column * column_along * column_across + last_row * row_along * row_across
    own_along = of_column * column_along**2 + of_row * row_along**2 + noise.place_m**2
    own_along += last_along
    own_across = of_column * column_across**2 + of_row * row_across**2 + noise.place_m**2
    own_across += last_across
    if not along + own_along < largest_sigma(distance) ** 2:
        return None
    along += skewed + model.clock_variance
    across += model.clock_variance
    # Of the box's noise, the part that a moment later is the same.
    alike_along, alike_across = last_along / own_along, last_across / own_across
    own_mixed = 0.0
    if model.range_process_ is None or model.bearing_process_ is None:
        own_mixed = of_column * column_along * column_across + of_row * row_along * row_across
        own_mixed += last_mixed
    else:
        last_mixed = 0.0
        heading = math.radians(camera.heading_deg)
        sin_h, cos_h = math.sin(heading), math.cos(heading)
        per_pixel = distance / camera.focal_px
        inputs = (
            math.atan2(sine * cos_h - cosine * sin_h, cosine * cos_h + sine * sin_h),
            math.log(distance),
            math.log(max(y2 - y1 - bias_px, 0.5) * per_pixel),
            math.log((x2 - x1) * per_pixel),
        )
        noise_along = model.range_process_.hyperparameters.noise * math.sqrt(own_along) / distance
        noise_across = (
            model.bearing_process_.hyperparameters.noise * math.sqrt(own_across) / distance
        )
        stretch, stretch_variance = model.range_process_.predict_one(inputs)
        turn, turn_variance = model.bearing_process_.predict_one(inputs)
        distance *= math.exp(stretch)
        scale = distance * distance
        along += stretch_variance * scale
        across += turn_variance * scale
        own_along, own_across = noise_along**2 * scale, noise_across**2 * scale
        sin_t, cos_t = math.sin(turn), math.cos(turn)
        sine, cosine = sine * cos_t + cosine * sin_t, cosine * cos_t - sine * sin_t
    place = np.array([[camera.east_m + distance * sine, camera.north_m + distance * cosine]])
    same_along, same_across = along + alike_along * own_along, across + alike_across * own_across
    shared = _turned(same_along, same_across, mixed + last_mixed, sine, cosine)
    whole = _turned(along + own_along, across + own_across, mixed + own_mixed, sine, cosine)
    return place, np.array(whole), np.array(shared)


def ranges_variance(along_m2: float, distance_m: float) -> float:
    """Variance of a range about its likeliest value, from that of a linear camera.

    What parameters make of a range they multiply it by: a height that is known to a factor is a
    range that is known to one. So it is taken to be log-normal, and the ellipse about the likeliest
    range is as wide as the second moment about that. Of small variances it is the same.
    """
    squared = min(along_m2 / (distance_m * distance_m), MOST_SQUARED)
    return distance_m * distance_m * (math.expm1(2.0 * squared) - 2.0 * math.expm1(0.5 * squared))


def _turned(
    along: float, across: float, mixed: float, sine: float, cosine: float
) -> list[list[list[float]]]:
    ss, cc, sc = sine * sine, cosine * cosine, sine * cosine
    both = (along - across) * sc + mixed * (cc - ss)
    twice = 2.0 * mixed * sc
    return [[[along * ss + across * cc + twice, both], [both, along * cc + across * ss - twice]]]
