"""Geodesy: latitude and longitude <-> metres in a local plane, and from UTM."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from sightline.errors import InputError

FloatArray = NDArray[np.float64]


@lru_cache(maxsize=64)
def _projection(latitude_deg: float, longitude_deg: float) -> pyproj.Proj:
    return pyproj.Proj(
        proj="aeqd", lat_0=latitude_deg, lon_0=longitude_deg, datum="WGS84", units="m"
    )


def check_geographic(latitude_deg: ArrayLike, longitude_deg: ArrayLike, where: str = "") -> None:
    """Raise InputError for coordinates that are no place on the earth.

    Args:
        latitude_deg: (N,) degrees north.
        longitude_deg: (N,) degrees east.
        where: What the coordinates belong to, for the message.

    Raises:
        InputError: A value is not finite, or outside ±90° or ±180°; names the first one.
    """
    latitude = np.atleast_1d(np.asarray(latitude_deg, dtype=float))
    longitude = np.atleast_1d(np.asarray(longitude_deg, dtype=float))
    bad = ~((np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 180.0))
    if bad.any():
        i = int(np.argmax(bad))
        raise InputError(
            f"{where + ': ' if where else ''}latitude {latitude[i]:g}, longitude {longitude[i]:g} "
            f"(row {i + 1}) is not on the earth; latitudes lie within ±90 degrees, longitudes "
            "within ±180 (are the columns swapped?)"
        )


@dataclass(frozen=True)
class LocalPlane:
    """An azimuthal equidistant plane that touches the earth at its origin.

    Distances and directions from the origin are exact; elsewhere within 10 km they are true to
    better than a part in a million.

    Attributes:
        latitude_deg: Latitude of the origin, degrees north (WGS 84).
        longitude_deg: Longitude of the origin, degrees east (WGS 84).
    """

    latitude_deg: float
    longitude_deg: float

    def __post_init__(self) -> None:
        check_geographic(self.latitude_deg, self.longitude_deg, "origin of the local plane")

    def to_plane(
        self, latitude_deg: ArrayLike, longitude_deg: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Metres east and north of the origin.

        Args:
            latitude_deg: (N,) degrees north; NaN stays NaN.
            longitude_deg: (N,) degrees east.

        Returns:
            Two (N,) float64 arrays, metres.
        """
        return _apply(self.latitude_deg, self.longitude_deg, longitude_deg, latitude_deg, False)

    def to_geographic(self, east_m: ArrayLike, north_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude of points in the plane, degrees, two (N,) float64 arrays."""
        longitude, latitude = _apply(self.latitude_deg, self.longitude_deg, east_m, north_m, True)
        return latitude, longitude


def _apply(
    latitude_deg: float, longitude_deg: float, x: ArrayLike, y: ArrayLike, inverse: bool
) -> tuple[FloatArray, FloatArray]:
    x_in, y_in = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
    known = np.isfinite(x_in) & np.isfinite(y_in)
    x_out, y_out = np.full(x_in.shape, np.nan), np.full(x_in.shape, np.nan)
    if known.any():
        projection = _projection(latitude_deg, longitude_deg)
        x_out[known], y_out[known] = projection(x_in[known], y_in[known], inverse=inverse)
    return x_out, y_out


def from_utm(
    easting_m: ArrayLike, northing_m: ArrayLike, zone: int, *, north: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude of UTM coordinates (WGS 84).

    Args:
        easting_m: (N,) metres; values beyond the zone's edge are meant as such.
        northing_m: (N,) metres.
        zone: 1 to 60.
        north: Whether the zone is of the northern hemisphere.

    Returns:
        Two (N,) float64 arrays, degrees.

    Raises:
        InputError: There is no such zone.
    """
    if not 1 <= zone <= 60:
        raise InputError(f"UTM zone {zone} does not exist; zones run from 1 to 60")
    transformer = _transformer(f"EPSG:{(32600 if north else 32700) + zone}", "EPSG:4326")
    longitude, latitude = transformer.transform(
        np.asarray(easting_m, dtype=float), np.asarray(northing_m, dtype=float)
    )
    return np.asarray(latitude), np.asarray(longitude)


@lru_cache(maxsize=64)
def _transformer(source: str, target: str) -> pyproj.Transformer:
    return pyproj.Transformer.from_crs(source, target, always_xy=True)
