"""Whether a camera stands where its scene says, as far as its boxes tell.

A place that somebody read off a map is right to some metres, or it is that of another building. So
there are two hypotheses: the prior of the fit, and one that is wide. What a fit under the first has
to say of the second is read off its covariance, which costs nothing; only where that does not
settle it a fit is made under the second as well, and the two are compared by the density of the
data (Bayes' factor), and by the places of targets that were left out.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sightline.camera.calibration import CameraFit
from sightline.camera.parameters import HEADING, POSITION
from sightline.camera.priors import CameraPrior

WRONG_PLACE_SIGMA_M = 300.0
"""Standard deviation of a place that is wrong: another building, or an angle that was cut off after
three decimals or at a minute's third part."""

WRONG_PLACE_SHARE = 0.05
"""How many of the places that people state are wrong: as many as one calls an exception."""

# Nats by which the other hypothesis may seem unlikelier off the covariance and still be looked at:
# it is exact for a linear camera, and one that moves by hundreds of metres is none.
_LINEAR_ERROR = 3.0
# Nats: more than ten are gained now and then where a single passage lets a fit end elsewhere.
_DECISIVE = 20.0
# Of the width of the wide prior: a place that boxes tell no better, they do not tell.
_UNTOLD_SHARE = 0.5
_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def doubtful(fit: CameraFit) -> bool:
    """Whether a fit under the stated place leaves it open that the camera stands elsewhere."""
    return _log_odds(fit) > -_LINEAR_ERROR + _log_share()


def elsewhere(prior: CameraPrior | None) -> CameraPrior:
    """The prior of a camera whose stated place is wrong."""
    prior = prior or CameraPrior()
    return replace(prior, position_sigma_m=math.hypot(prior.position_sigma_m, WRONG_PLACE_SIGMA_M))


def astray(wide: CameraFit, stated: CameraFit | None) -> bool:
    """Whether a fit under the wide prior is none: it went somewhere that explains the data worse.

    What is wide holds what is narrow, so that it can lose no more than its width.
    """
    if stated is None:
        return False
    lost = wide.negative_log_evidence - stated.negative_log_evidence
    width = np.log(wide.prior_sigma[POSITION] / stated.prior_sigma[POSITION]).sum()
    return not lost < float(width) + _LINEAR_ERROR


def relaxed(stated: CameraFit) -> CameraFit:
    """What a fit under the stated place says under the wide prior, were the camera linear.

    The density is left at that of the stated place: that far it tells nothing of which is right.
    """
    sigma_m = float(np.mean(stated.prior_sigma[POSITION]))
    limit_m2 = 1.0 / (1.0 / sigma_m**2 - 1.0 / (sigma_m**2 + WRONG_PLACE_SIGMA_M**2))
    values, vectors = np.linalg.eigh(limit_m2 * np.eye(2) - stated.covariance[POSITION, POSITION])
    gain = (vectors / np.maximum(values, limit_m2 - sigma_m**2)) @ vectors.T
    by_place = stated.covariance[:, POSITION] @ gain
    prior_sigma = stated.prior_sigma.copy()
    prior_sigma[POSITION] = math.hypot(sigma_m, WRONG_PLACE_SIGMA_M)
    return replace(
        stated,
        vector=stated.vector + by_place @ stated.vector[POSITION],
        covariance=stated.covariance + by_place @ stated.covariance[POSITION],
        prior_sigma=prior_sigma,
        left_out_m=0.0,
    )


def share_elsewhere(wide: CameraFit, stated: CameraFit | None) -> float:
    """How likely the camera stands elsewhere, 0 to 1.

    Where targets were left out, they have to be placed no worse. Where there is but one, and where
    the data does not tell the place, the density has to be much higher: how a single passage bends
    another camera explains as well as another place, and Laplace's approximation is coarse there.
    Otherwise nothing was learned of how likely a stated place is wrong.

    Args:
        wide: Under the wide prior.
        stated: Of the same data, under the stated place; None where there is none.
    """
    if stated is None:
        return 1.0
    gain = stated.negative_log_evidence - wide.negative_log_evidence
    untold = _widest_m(wide) > _UNTOLD_SHARE * WRONG_PLACE_SIGMA_M
    alone = not wide.left_out_m > 0.0
    if gain > _DECISIVE and alone:
        return 1.0
    if untold:
        return WRONG_PLACE_SHARE
    share = 1.0 / (1.0 + math.exp(-min(max(gain + _log_share(), -50.0), 50.0)))
    borne_out = not alone and wide.left_out_m <= stated.left_out_m
    return share if borne_out else min(share, WRONG_PLACE_SHARE)


def mixed(fit: CameraFit, other: CameraFit, share: float) -> CameraFit:
    """A fit whose covariance holds that with some probability another one is right.

    Fits of other sources or recordings cannot be mixed, and change nothing.
    """
    if other.vector.shape != fit.vector.shape:
        return fit
    off = other.vector - fit.vector
    off[HEADING] = math.remainder(off[HEADING], 2.0 * math.pi)
    covariance = (1.0 - share) * fit.covariance + share * (other.covariance + np.outer(off, off))
    return replace(fit, covariance=covariance)


def in_words(wide: CameraFit, share: float, *, taken: bool) -> str:
    """What is to be said of where a camera stands; nothing where that is as stated.

    Args:
        wide: The fit under the wide prior.
        share: How likely that is.
        taken: Whether places are reckoned from there.
    """
    check = "check [camera] latitude_deg and longitude_deg"
    widest_m = _widest_m(wide)
    if not taken and widest_m > _UNTOLD_SHARE * WRONG_PLACE_SIGMA_M:
        return (
            "The camera's place is in doubt: it is taken to be where the scene says, but the data "
            f"would be explained as well from within some {widest_m:.0f} m of it; {check}, or let "
            "the fit see targets on other courses."
        )
    if not taken and share < WRONG_PLACE_SHARE:
        return ""
    east, north = wide.vector[POSITION].tolist()
    away_m, bearing_deg = math.hypot(east, north), math.degrees(math.atan2(east, north)) % 360.0
    wind = _WINDS[round(bearing_deg / 45.0) % len(_WINDS)]
    sight = wide.vector[POSITION] / max(away_m, 1e-9)
    sigma_m = math.sqrt(float(sight @ wide.covariance[POSITION, POSITION] @ sight))
    then = "places are reckoned from there" if taken else "it is not sure enough to be used"
    return (
        f"The camera's place is in doubt: the data would have it {away_m:.0f} ± {sigma_m:.0f} m to "
        f"the {wind} (bearing {bearing_deg:.0f}°) of where the scene says, and {then}; {check}."
    )


def surprise(prior: CameraPrior | None) -> float:
    """How much less likely a camera elsewhere is than one where the scene says, nats at least.

    Of the densities at their middles.
    """
    own = prior or CameraPrior()
    return 2.0 * math.log(elsewhere(own).position_sigma_m / own.position_sigma_m) - _log_share()


def _widest_m(fit: CameraFit) -> float:
    """Largest standard deviation of the camera's place, whatever the direction."""
    return math.sqrt(float(np.linalg.eigvalsh(fit.covariance[POSITION, POSITION])[-1]))


def _log_share() -> float:
    return math.log(WRONG_PLACE_SHARE / (1.0 - WRONG_PLACE_SHARE))


def _log_odds(fit: CameraFit) -> float:
    """Logarithm of Bayes' factor of the wide prior over the fit's own, were the camera linear."""
    sigma_m = fit.prior_sigma[POSITION]
    own = fit.covariance[POSITION, POSITION]
    precision = np.linalg.inv(own)
    values, vectors = np.linalg.eigh(precision - np.diag(sigma_m**-2.0))
    # What data without the prior says; where it says nothing, anything.
    spread = (vectors / np.maximum(values, 1e-9)) @ vectors.T
    middle = spread @ precision @ fit.vector[POSITION]

    def log_density(variance_m2: float) -> float:
        whole = spread + variance_m2 * np.eye(2)
        size = float(middle @ np.linalg.solve(whole, middle))
        return -0.5 * (float(np.linalg.slogdet(whole)[1]) + size)

    stated_m2 = float(np.mean(sigma_m**2))
    return log_density(stated_m2 + WRONG_PLACE_SIGMA_M**2) - log_density(stated_m2)
