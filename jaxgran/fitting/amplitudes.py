"""What a rival of a fitted law is found to be, from the fits with each of its amplitudes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxgran.fitting.profile import Profile

ASKED = 6.63
"""chi^2 by which a rival must fit better for the curve to ask for it (1 % by chance)."""

ALLOWED = 3.84
"""chi^2 over the best one up to which an amplitude is allowed (5 % by chance)."""

TOLD_APART = 0.1
"""Relative change of an estimate below which an allowed rival does not matter."""


Kind = tuple[str, str, tuple[float, ...]]
"""The words of a rival, its field of `Trial`, and its amplitudes."""


class Rival(NamedTuple):
    """One rival of a fitted law.

    Attributes:
        name: the words for it.
        amplitude: the best one, see `Trial`.
        allowed: the smallest and the largest amplitude that the curve allows.
        improvement: chi^2 of the fitted law less that of the best amplitude, over the scale of
            chi^2 (1 for independent errors of the given size).
        estimate: of the free parameters at the best amplitude, SI.
        low, high: range of each free parameter over the allowed amplitudes, SI, 95 %.
        asked: whether the curve asks for this rival (1 % by chance).
        told_apart: whether the curve tells the rival apart from the fitted law, so that it changes
            the first parameter by less than 10 %, over the fitted law's own error.
        sharper: factor by which the errors must be smaller to tell it apart; 1 if it is.
        decades: of T through which the gas must be followed further, with as many points in each
            and the same errors, to tell it apart; 0 if it is, inf if more than
            `jaxgran.fitting.rivals.FURTHER` goes are needed, nan where this was not looked for.
    """

    name: str
    amplitude: float
    allowed: tuple[float, float]
    improvement: float
    estimate: Float[np.ndarray, "p"]
    low: Float[np.ndarray, "p"]
    high: Float[np.ndarray, "p"]
    asked: bool
    told_apart: bool
    sharper: float
    decades: float


def compared(
    kinds: list[Kind], profile: Profile, scale: float, positive: Bool[np.ndarray, "p"]
) -> list[Rival]:
    """The rivals in the order of their kinds."""
    found, begin = [], 1
    for name, _, amplitudes in kinds:
        rows = np.array([0, *range(begin, begin + len(amplitudes))])
        order = np.argsort([0.0, *amplitudes])
        each = np.array([0.0, *amplitudes])[order]
        found.append(_rival(name, each, profile, rows[order], scale, positive))
        begin += len(amplitudes)
    return found


def _rival(
    name: str,
    amplitudes: Float[np.ndarray, "rows"],
    profile: Profile,
    rows: np.ndarray,
    scale: float,
    positive: Bool[np.ndarray, "p"],
) -> Rival:
    """A rival, from those rows of the profile that have its amplitudes, in increasing order.

    Between the amplitudes chi^2 and the estimates are interpolated.
    """
    chi2 = np.where(np.isfinite(profile.chi2), profile.chi2, np.inf)
    own = np.where(np.isfinite(chi2[rows]), chi2[rows], 1e30)
    margin = 1.96 * scale**0.5 * profile.error
    place = np.linspace(0, len(rows) - 1, 40 * (len(rows) - 1) + 1)

    def between(values):
        return np.interp(place, np.arange(len(rows)), values)

    allowed = between(own) <= own.min() + ALLOWED * scale
    estimate, spread = profile.estimate[rows], margin[rows]
    columns = range(estimate.shape[1])
    low = [between(estimate[:, k] - spread[:, k])[allowed].min() for k in columns]
    high = [between(estimate[:, k] + spread[:, k])[allowed].max() for k in columns]
    first, own_margin = profile.estimate[0, 0], margin[0, 0]
    wider = max(first - own_margin - low[0], high[0] - first - own_margin) / abs(first)
    improvement = float((chi2[0] - own.min()) / scale)
    reached = between(amplitudes)[allowed]
    return Rival(
        name=name,
        amplitude=float(amplitudes[np.argmin(own)]),
        allowed=(float(reached.min()), float(reached.max())),
        improvement=improvement,
        estimate=np.array(estimate[np.argmin(own)]),
        low=np.where(positive, np.maximum(low, 0.0), low),
        high=np.array(high),
        asked=improvement > ASKED,
        told_apart=bool(wider < TOLD_APART),
        sharper=float(max(wider / TOLD_APART, 1.0)),
        decades=float("nan"),
    )
