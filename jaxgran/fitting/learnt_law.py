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
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.parameters import as_floats, residuals_and_slopes, with_floats
from jaxgran.fitting.result import Fit
from jaxgran.scene.gas import Gas, law_fields
from jaxgran.scene.laws import RestitutionSpline

NUM_COMPARED = 9
"""Number of speeds over the visited range at which laws are compared."""

NUM_DRAWS = 20_000
"""Number of draws that give the width of a band: its error is 1 %."""

KNOT_MARGIN = 1.5
"""Factor by which knots may lie outside the visited range without a warning."""

MIN_VARIANCE = 1e-4
"""Share of the largest variance below which a combination of these values is ignored: it is known
only through the smoothness prior."""


class RestitutionBand(NamedTuple):
    """A learnt law with its uncertainty.

    Attributes:
        speeds: normal impact speeds, m/s.
        restitution: eps at these speeds.
        low, high: ends of a band that contains the whole law over the visited range with a
            probability of 95 %: some 2.5 standard errors of ln(-ln eps) to each side.
        visited: range of speeds that determines the measured T, m/s
            (`RestitutionSpline.visited_speeds`); outside it eps follows from the form of the law
            and its prior.
        covariance: of ln(-ln eps) at the speeds.

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

    def compare(self, gas: Gas, free: str) -> tuple[float, float, Gas]:
        """Fit a formula with one free number to the learnt law.

        Args:
            gas: with the law to compare.
            free: name of a float of this law, as "dissipative_constant" or "coefficient".

        Returns:
            chi^2 of ln(-ln eps) per degree of freedom, its p-value, and the fitted gas. Values of
            1 or less mean that the band contains a law of this form.
        """
        variances, axes = np.linalg.eigh(self.covariance)
        known = variances > MIN_VARIANCE * variances[-1]
        whiten = axes[:, known].T / np.sqrt(variances[known])[:, None]
        measured, domain = np.log(-np.log(self.restitution)), gas.domains[free]

        def residuals(flat: np.ndarray) -> np.ndarray:
            changed = with_floats(gas, as_floats({free: domain.from_free(flat[0])}))
            return whiten @ (np.asarray(_log_loss(changed, jnp.asarray(self.speeds))) - measured)

        first = np.ravel(domain.to_free(np.asarray(gas.value(free))))
        solution = scipy.optimize.least_squares(residuals, first)
        degrees, chi2 = int(known.sum()) - 1, 2 * float(solution.cost)
        fitted = gas.replace(**{free: domain.from_free(solution.x[0])})
        return chi2 / degrees, float(scipy.stats.chi2.sf(chi2, degrees)), fitted


def visited_speeds(result: Fit) -> tuple[float, float]:
    """Return the range of impact speeds that determines the measured curves of a fit, m/s."""
    data = [m.data for m in result.measurements.values()]
    parts = [np.asarray(x.temperature) for x in data if isinstance(x, CoolingCurve)]
    if not parts:
        raise ValueError("drop tests alone have no T: give a cooling curve, too")
    return RestitutionSpline.visited_speeds(np.concatenate(parts))


def describe_unvisited_knots(result: Fit) -> Iterator[str]:
    """Yield a sentence on knots of a fitted spline outside the visited speeds, if there are any."""
    gas = next(iter(result.gas.values())) if isinstance(result.gas, dict) else result.gas
    if not isinstance(gas.law, RestitutionSpline) or "drops" not in result.names:
        return
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
    gas = next(iter(result.gas.values())) if isinstance(result.gas, dict) else result.gas
    own = [name for name in law_fields(gas.law) if name in result.names]
    if not own:
        raise ValueError(
            f'no number of the law was free, only {", ".join(result.names)}. Fit with free="law"'
        )
    visited = visited_speeds(result)
    grid = np.geomspace(*visited, NUM_COMPARED)
    speeds = grid if speeds is None else speeds
    POSITIVE.check("speeds", speeds, "Give normal impact speeds in m/s.")
    v = np.asarray(speeds, float)
    law = jax.tree_util.Partial(_log_loss, speeds=jnp.asarray(np.append(v, grid)))
    floats = {name: gas.value(name) for name in own}
    log, slopes = residuals_and_slopes(law, gas, floats)
    parts = [np.asarray(slopes[name]) for name in own]
    at = [i for name in own for i, of in enumerate(result.names_of_elements) if of == name]
    slope = np.concatenate(parts, axis=1)
    covariance = result.covariance[np.ix_(at, at)]
    covariance = slope @ covariance @ slope.T
    error = np.sqrt(np.diag(covariance))
    # Quantile of the largest of the standardised errors at the speeds of the grid.
    correlation = (covariance / np.outer(error, error))[v.size :, v.size :]
    draws = np.random.default_rng(0).multivariate_normal(
        np.zeros(grid.size), correlation, NUM_DRAWS, method="eigh"
    )
    factor = np.quantile(np.abs(draws).max(axis=1), 0.95)
    log, error = np.asarray(log)[: v.size], error[: v.size]
    low, middle, high = (np.exp(-np.exp(log + x * error)) for x in (factor, 0, -factor))
    return RestitutionBand(v, middle, low, high, visited, covariance[: v.size, : v.size])


@eqx.filter_jit
def _log_loss(gas: Gas, speeds: Float[Array, "speeds"]) -> Float[Array, "speeds"]:
    eps = gas.restitution(speeds)
    return jnp.log(-jnp.log(eps))
