"""Rivals of a fitted law: what else could have made a measured curve, and what A would then be.

Each rival adds a loss of energy, or an error of the measurement, to the fitted model. Its amplitude
is varied from nothing to all of the curve while the free parameters are fitted anew. chi^2 as a
function of the amplitude says whether the curve asks for the rival, or excludes it; where it does
neither, the parameters are known only as well as the amplitude is.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.profile import Profile, Trial, fit_trials
from jaxgran.fitting.residuals import chi2_scale
from jaxgran.fitting.result import Fit
from jaxgran.scene.restitution import ConstantRestitution

SHARES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 0.995)
"""Amplitudes of an added loss, as shares of the first cooling rate, and of a noise floor, as shares
of the last temperature."""

DRAG_SHARES = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.9)
"""The same of drag, which gains on collisions as the gas cools."""

DELAYS = (0.003, 0.01, 0.03, 0.1, 0.3, -0.001, -0.003, -0.01, -0.03, -0.1, -0.3)
"""Errors of the start of the clock, over the first cooling time."""

ASKED = 6.63
"""chi^2 by which a rival must fit better for the curve to ask for it (1 % by chance)."""

ALLOWED = 3.84
"""chi^2 over the best one up to which an amplitude is allowed (5 % by chance)."""

TOLD_APART = 0.1
"""Relative change of an estimate below which an allowed rival does not matter."""


class Rival(NamedTuple):
    """One rival of a fitted law.

    Attributes:
        name: the words for it.
        amplitude: the best one, see `Trial`.
        allowed: the smallest and the largest amplitude that the curve allows.
        improvement: chi^2 of the fitted law less that of the best amplitude, over the scale of
            chi^2 (1 for independent errors of the given size).
        low, high: range of each free parameter over the allowed amplitudes, SI, 95 %.
        asked: whether the curve asks for this rival (1 % by chance).
        told_apart: whether the curve tells the rival apart from the fitted law, so that it changes
            the first parameter by less than 10 %, over the fitted law's own error.
        sharper: factor by which the errors must be smaller to tell it apart; 1 if it is.
    """

    name: str
    amplitude: float
    allowed: tuple[float, float]
    improvement: float
    low: Float[np.ndarray, "p"]
    high: Float[np.ndarray, "p"]
    asked: bool
    told_apart: bool
    sharper: float


def rivals(result: Fit, curve: CoolingCurve) -> tuple[Rival, ...]:
    """Compare a fitted law with its rivals, by T alone.

    The course of T comes from `jaxgran.theory.table_of_times`; what the fitted model has besides is
    added to all trials alike.

    Args:
        result: of `jaxgran.fit`, of one curve.
        curve: the measured curve.

    Returns:
        The rivals, those that fit best first; () where the fitted gas does not cool or is driven,
        of which T is not a table of times, or where
        floats of its elements were free, whose losses are such rivals themselves.
    """
    if free_elements(result) or result.gas.drive is not None:
        return ()
    kinds = _kinds(result)
    weights, residuals = _weighted(result, curve)
    measured = np.log(curve.temperature)
    fitted = measured - residuals / np.where(weights > 0, weights, 1.0)
    ratios, T_rot = np.zeros_like(measured), result.curve.rotational_temperature
    if T_rot is not None:
        ratios = np.asarray(T_rot / result.curve.temperature)
    columns = _padded(np.asarray(curve.times), measured, weights, fitted)
    rows = columns[0].size - ratios.size
    columns[3] = np.pad(fitted, (0, rows), "edge")
    columns.append(np.pad(ratios, (0, rows), "edge"))
    profile = fit_trials(
        result.gas,
        result.names,
        *map(jnp.asarray, columns),
        trials=_trials(kinds),
        accuracy=jnp.max(result.clock_error),
        priors=result.priors,
    )
    profile = jax.tree.map(np.asarray, profile)
    if not np.isfinite(profile.chi2[0]):
        return ()
    best = profile.residuals[int(np.nanargmin(profile.chi2))]
    scale = float(chi2_scale(jnp.asarray(best), len(result.names)))
    # What trials, which have no noise of their own, cannot tell.
    beside = [result.error_budget.get(part, 0.0) for part in ("simulation", "few particles")]
    noise = np.hypot(*map(np.asarray, beside)) / scale**0.5
    profile = profile._replace(error=np.hypot(profile.error, noise))
    found, begin = [], 1
    for name, _, amplitudes in kinds:
        rows = np.array([0, *range(begin, begin + len(amplitudes))])
        order = np.argsort([0.0, *amplitudes])
        each = np.array([0.0, *amplitudes])[order]
        found.append(_rival(name, each, profile, rows[order], scale))
        begin += len(amplitudes)
    return tuple(sorted(found, key=lambda rival: -rival.improvement))


def free_elements(result: Fit) -> tuple[str, ...]:
    """The free parameters that are floats of the elements of the scene."""
    plain = dataclasses.replace(result.gas, surface=None, container=None, drag=None, drive=None)
    return tuple(name for name in result.names if name not in plain.domains)


def _kinds(result: Fit) -> list[tuple[str, str, tuple[float, ...]]]:
    """The words, the field of `Trial` and the amplitudes of each rival that the fit can have."""
    kinds = [
        ("linear drag, as of air", "drag", DRAG_SHARES),
        ("a noise floor in T", "floor", SHARES),
    ]
    elements = result.gas.elements
    if not isinstance(result.gas.law, ConstantRestitution):
        words = "a further loss at constant eps"
        causes = {"container": "walls", "surface": "rough grains"}
        left = [cause for name, cause in causes.items() if name not in elements]
        words += f", as of {' or '.join(left)}" if left else ""
        kinds.insert(0, (words, "constant", SHARES))
    if "temperature" not in result.names:
        kinds.append(("a wrong start of the clock, or a wrong T_0", "delay", DELAYS))
    return kinds


def _trials(kinds: list[tuple[str, str, tuple[float, ...]]]) -> Trial:
    """The fitted law itself, then each amplitude of each rival, the others being 0."""
    rows = [np.zeros(len(Trial._fields))]
    for _, field, amplitudes in kinds:
        own = np.zeros((len(amplitudes), len(Trial._fields)))
        own[:, Trial._fields.index(field)] = amplitudes
        rows += list(own)
    return Trial(*jnp.asarray(np.array(rows).T))


def _weighted(
    result: Fit, curve: CoolingCurve
) -> tuple[Float[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """Inverse relative errors of T, 0 where the fit used none, and the residuals over the errors.

    Where the errors are unknown they are the scatter of the residuals.
    """
    residuals = np.asarray(result.residuals)
    used = residuals != 0
    if result.scatter is not None:
        return used / np.asarray(result.scatter), residuals
    error = np.where(used, np.asarray(curve.temperature_error), 1.0)
    return np.where(used, np.asarray(curve.temperature) / error, 0.0), residuals


def _padded(times: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """The times and other columns, with rows of 0 up to a power of two.

    Curves of many lengths then share a compiled program.
    """
    rows = max(32, 2 ** (times.size - 1).bit_length()) - times.size
    return [np.pad(times, (0, rows), "edge"), *(np.pad(column, (0, rows)) for column in columns)]


def _rival(
    name: str,
    amplitudes: Float[np.ndarray, "rows"],
    profile: Profile,
    rows: np.ndarray,
    scale: float,
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
        low=np.array(low),
        high=np.array(high),
        asked=improvement > ASKED,
        told_apart=bool(wider < TOLD_APART),
        sharper=float(max(wider / TOLD_APART, 1.0)),
    )


def ranges(
    result: Fit, found: tuple[Rival, ...]
) -> dict[str, tuple[Float[np.ndarray, "size"], Float[np.ndarray, "size"]]]:
    """The range of each free parameter, 95 %, over all rivals that fit as well as the best.

    Args:
        result: of `jaxgran.fit`.
        found: its rivals.
    """
    best = max(rival.improvement for rival in found)
    equal = [rival for rival in found if rival.improvement >= best - ALLOWED]
    low = np.min([rival.low for rival in equal], axis=0)
    high = np.max([rival.high for rival in equal], axis=0)
    sizes = [result.gas.value(name).size for name in result.names]
    parts = (np.split(x, np.cumsum(sizes)[:-1]) for x in (low, high))
    return dict(zip(result.names, zip(*parts, strict=True), strict=True))
