"""The law of restitution that a fit has learnt: eps(v) with its band, compared with formulas."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxgran._utils.validation import POSITIVE
from jaxgran.data.curve import CoolingCurve, above_noise
from jaxgran.data.drop_test import DropTest
from jaxgran.fitting.parameters import residuals_and_slopes, with_values
from jaxgran.fitting.result import Fit, by_label
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import RestitutionSpline
from jaxgran.scene.parameter_fields import law_fields

NUM_COMPARED = 9
"""Number of speeds over the visited range at which laws are compared."""

NUM_DRAWS = 20_000
"""Number of draws that give the width of a band: its error is 1 %."""

KNOT_MARGIN = 1.5
"""Factor by which knots may lie outside the visited range without a warning."""

RELATIVE_SPEEDS = np.linspace(0.005, 4.0, 800)
"""Impact speeds over 2 sqrt(T)."""

MIN_VARIANCE = 1e-4
"""Relative eigenvalue of the covariance of ln eps below which a combination of its values is
ignored: it is known only through the smoothness prior."""


class FittedFormula(NamedTuple):
    """A formula fitted to a learnt law.

    Attributes:
        chi2: chi^2 of ``L = -ln eps`` per degree of freedom; 1 or less means that the band contains
            a law of this form.
        p_value: probability of a larger chi^2.
        gas: with the fitted number.
    """

    chi2: float
    p_value: float
    gas: Gas


class RestitutionBand(NamedTuple):
    """A learnt law with its uncertainty.

    Attributes:
        speeds: normal impact speeds, m/s.
        restitution: eps at these speeds.
        low, high: ends of a band that contains the whole law over the visited range with a
            probability of 95 %: some 2.5 standard errors of ``L = -ln eps`` to each side, L >= 0.
        visited: range of speeds that determines the measured T, m/s: by 5 % of the losses at the
            lowest T and 95 % at the highest, with the learnt law; outside it eps follows from the
            form of the law and its prior.
        covariance: of L at the speeds.

    >>> band = jaxgran.restitution_band(result)
    >>> bool(band.low[0] < band.restitution[0] < band.high[0])
    True
    """

    speeds: Float[np.ndarray, "speeds"]
    restitution: Float[np.ndarray, "speeds"]
    low: Float[np.ndarray, "speeds"]
    high: Float[np.ndarray, "speeds"]
    visited: tuple[float, float]
    covariance: Float[np.ndarray, "speeds speeds"]

    def compare(self, gas: Gas, free: str) -> FittedFormula:
        """Fit a formula with one free number to the learnt law.

        Args:
            gas: with the law to compare.
            free: name of a float of this law, as "dissipative_constant" or "coefficient".

        Raises:
            ValueError: for a band with one independent value.
        """
        variances, axes = np.linalg.eigh(self.covariance)
        known = variances > MIN_VARIANCE * variances[-1]
        whiten = axes[:, known].T / np.sqrt(variances[known])[:, None]
        degrees = int(known.sum()) - 1
        if degrees < 1:
            raise ValueError(
                "one independent value of the band cannot test a formula with one free number: "
                "give more speeds, or free more numbers of the law"
            )
        measured = -np.log(self.restitution)
        domain = gas.domains[free]

        def residuals(flat: np.ndarray) -> np.ndarray:
            changed = with_values(gas, {free: domain.from_free(flat[0])})
            return whiten @ (np.asarray(_log_loss(changed, jnp.asarray(self.speeds))) - measured)

        first = np.ravel(domain.to_free(np.asarray(gas.value(free))))
        solution = scipy.optimize.least_squares(residuals, first)
        chi2 = 2 * float(solution.cost)
        fitted = gas.replace(**{free: domain.from_free(solution.x[0])})
        return FittedFormula(chi2 / degrees, float(scipy.stats.chi2.sf(chi2, degrees)), fitted)


def visited_speeds(result: Fit) -> tuple[float, float]:
    """Return the range of impact speeds that determines the measured curves of a fit, m/s.

    It is from the 5 % quantile of the losses ``(1 - eps^2) v^3 exp(-v^2/(4 T))`` at the lowest T to
    the 95 % quantile at the highest, with the fitted law.
    """
    data = [m.data for m in result.measurements.values()]
    curves = [x for x in data if isinstance(x, CoolingCurve)]
    parts = [np.asarray(x.temperature)[above_noise(x)] for x in curves]
    if not parts:
        raise ValueError("drop tests alone have no T: give a cooling curve, too")
    T = np.concatenate(parts)
    T = T[T > 0]
    gas = _first_gas(result)

    def quantile(share: float, temperature: float) -> float:
        relative = RELATIVE_SPEEDS
        speeds = 2 * np.sqrt(temperature) * relative
        lost = 1 - np.asarray(gas.restitution(jnp.asarray(speeds))) ** 2
        weights = np.maximum(lost, np.finfo(float).tiny) * relative**3 * np.exp(-(relative**2))
        sums = np.cumsum(weights)
        return float(np.interp(share * sums[-1], sums, speeds))

    return quantile(0.05, T.min()), quantile(0.95, T.max())


def _first_gas(result: Fit) -> Gas:
    """Return the first of the fitted gases, which share their law."""
    return next(iter(by_label(result.gas).values()))


def describe_unvisited_knots(result: Fit) -> Iterator[str]:
    """Yield a sentence on knots of a fitted spline outside the visited speeds, if there are any."""
    gas = _first_gas(result)
    if not isinstance(gas.law, RestitutionSpline) or "drops" not in result.names:
        return
    if all(isinstance(m.data, DropTest) for m in result.measurements.values()):
        return  # impacts at given speeds
    low, high = visited_speeds(result)
    knots = np.asarray(gas.law.speeds)
    outside = [f"{v:.2g}" for v in knots if not low / KNOT_MARGIN < v < high * KNOT_MARGIN]
    if outside:
        yield (
            f"the knots at {', '.join(outside)} m/s lie outside the impact speeds {low:.2g} to "
            f"{high:.2g} m/s that the gas visited: there eps follows from the smoothness prior "
            "alone. Choose knots within RestitutionSpline.visited_speeds(T)"
        )


def restitution_band(result: Fit, speeds: Any = None) -> RestitutionBand:
    """Return eps(v) of a fitted law with its band, from all errors of the fit.

    Args:
        result: a fit in which numbers of the law were free.
        speeds: normal impact speeds, m/s, > 0; by default nine over the visited range.

    Raises:
        ValueError: if no number of the law was free, or for a speed that is not positive.

    >>> band = jaxgran.restitution_band(result, [0.1])
    >>> bool(band.low[0] < band.restitution[0] < band.high[0])
    True
    """
    names = _names_of_law(result)
    visited = visited_speeds(result)
    grid = np.geomspace(*visited, NUM_COMPARED)
    speeds = grid if speeds is None else speeds
    POSITIVE.check("speeds", speeds, "Give normal impact speeds in m/s.")
    v = np.asarray(speeds, float)
    learnt, of_all = _log_loss_with_covariance(result, names, np.append(v, grid))
    learnt = learnt[: v.size]
    covariance = of_all[: v.size, : v.size]
    half_width = _simultaneous_factor(of_all[v.size :, v.size :]) * _standard_errors(covariance)
    low = np.exp(-(learnt + half_width))
    high = np.exp(-np.maximum(learnt - half_width, 0.0))
    return RestitutionBand(v, np.exp(-learnt), low, high, visited, covariance)


def _names_of_law(result: Fit) -> list[str]:
    """Return the free parameters that belong to the law."""
    names = [name for name in law_fields(_first_gas(result).law) if name in result.names]
    if not names:
        raise ValueError(
            f'no number of the law was free, only {", ".join(result.names)}. Fit with free="law"'
        )
    return names


def _log_loss_with_covariance(
    result: Fit, names: list[str], speeds: Float[np.ndarray, "speeds"]
) -> tuple[Float[np.ndarray, "speeds"], Float[np.ndarray, "speeds speeds"]]:
    """Return L at some speeds with its covariance, by all errors of some parameters."""
    gas = _first_gas(result)
    law = jax.tree_util.Partial(_log_loss, speeds=jnp.asarray(speeds))
    values = {name: jnp.asarray(gas.value(name)) for name in names}
    learnt, slopes = residuals_and_slopes(law, gas, values)
    slope = np.concatenate([np.asarray(slopes[name]) for name in names], axis=1)
    elements = list(enumerate(result.names_of_elements))
    places = [i for name in names for i, element in elements if element == name]
    return np.asarray(learnt), slope @ result.covariance[np.ix_(places, places)] @ slope.T


def _standard_errors(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n"]:
    """Return the standard errors of values, > 0."""
    return np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))


def _simultaneous_factor(covariance: Float[np.ndarray, "n n"]) -> float:
    """Return how many standard errors all values together depart by, with a probability of 95 %."""
    error = _standard_errors(covariance)
    correlation = covariance / np.outer(error, error)
    draws = np.random.default_rng(0).multivariate_normal(
        np.zeros(error.size), correlation, NUM_DRAWS, method="eigh"
    )
    return float(np.quantile(np.abs(draws).max(axis=1), 0.95))


@eqx.filter_jit
def _log_loss(gas: Gas, speeds: Float[Array, "speeds"]) -> Float[Array, "speeds"]:
    """Return L = -ln eps."""
    return -jnp.log(gas.restitution(speeds))
