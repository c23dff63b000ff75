"""Means over replicas, slopes and crossings, and theory compared with direct simulation."""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

import jaxgran
from experiments.support.plots import CONSTANT, DOTS, ELASTIC, VISCOELASTIC
from experiments.support.scenes import beads, cool, hard_beads, restitution_like

PACKING = 0.05
"""Packing fraction of the gases of `gases_of`."""

ENSKOG = jaxgran.KineticTheory(
    corrections=jaxgran.KineticTheory.all_corrections - {"softness", "correlations"}
)


def replicas_of(curve: jaxgran.CoolingCurve, name: str) -> np.ndarray:
    """Return a quantity of each replica, shape (replicas, times)."""
    return np.asarray(getattr(curve.replicas, name))


def mean_and_error(each: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over the replicas, the first axis, and its standard error."""
    each = np.asarray(each)
    return each.mean(axis=0), each.std(axis=0, ddof=1) / len(each) ** 0.5


def with_error(name: str, each: Any) -> dict[str, np.ndarray]:
    """Return the mean over the replicas and its standard error, by name."""
    mean, error = mean_and_error(each)
    return {name: mean, f"{name}_error": error}


def ratio(one: tuple, other: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Return the ratio of two values with errors, and its error."""
    (a, a_error), (b, b_error) = one, other
    return a / b, np.hypot(a_error, a / b * b_error) / np.abs(b)


def over(one: tuple, other: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Return the ratio of two values with errors, less 1, and its error."""
    value, error = ratio(one, other)
    return value - 1, error


def interpolate(x: Any, where: np.ndarray, values: np.ndarray) -> Any:
    """Interpolate linearly in ln x."""
    return np.interp(np.log(x), np.log(where), values)


def interpolate_logs(x: Any, where: np.ndarray, values: Any) -> np.ndarray:
    """Interpolate ln y linearly in ln x."""
    return np.asarray(np.exp(interpolate(x, where, np.log(values))))


def from_here(inside: np.ndarray, x: np.ndarray) -> float:
    """Return the first x after which `inside` is always true; nan if the last is false."""
    outside = np.flatnonzero(~inside)
    start = outside[-1] + 1 if outside.size else 0
    return float(x[start]) if start < x.size else float("nan")


def slope(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return midpoints between neighbouring x, and d ln y / d ln x there, on the last axis."""
    x, y = np.log(x), np.log(y)
    return np.exp((x[1:] + x[:-1]) / 2), np.diff(y) / np.diff(x)


def crossing(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """Return the first x at which y reaches a level, by linear interpolation; nan if never."""
    above = np.flatnonzero(y >= level)
    if not above.size or above[0] == 0:
        return float("nan")
    i = above[0]
    return float(x[i - 1] + (level - y[i - 1]) / (y[i] - y[i - 1]) * (x[i] - x[i - 1]))


def fit_quietly(measurement: jaxgran.Measurement, **options: Any) -> jaxgran.Fit:
    """Return a fit without the warning that a parameter is not determined, which is recorded."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return jaxgran.fit(measurement, **options)


def gases_of(beta: float) -> dict[str, tuple[jaxgran.Gas, str, str]]:
    """Return gases, the last two with one initial cooling rate, with their colour and label."""
    viscoelastic = beads(PACKING, beta)
    e, delta = restitution_like(viscoelastic), float(viscoelastic.delta)
    return {
        "elastic": (hard_beads(PACKING, 1.0), ELASTIC, "elastic"),
        "constant": (hard_beads(PACKING, e), CONSTANT, f"constant ε = {e:.3f}"),
        "viscoelastic": (viscoelastic, VISCOELASTIC, f"viscoelastic, δ = {delta:.3f}"),
    }


def compared(
    gas: jaxgran.Gas, quantity: str, tau: np.ndarray, config: dict, theory: Any = ENSKOG
) -> tuple[jaxgran.CoolingCurve, jaxgran.CoolingCurve, "Compared"]:
    """Return the curves of theory and of DSMC, and T/T_0 or <dr^2>/(T_0 tau_c(0)^2) of both."""
    unit = float(gas.temperature * (gas.mean_free_time**2 if quantity == "displacement" else 1))
    of = cool(gas, tau * float(gas.mean_free_time), theory)
    at = np.geomspace(0.1, config["last"], config["points"])
    model = jaxgran.DSMC(config["num_particles"], config["replicas"])
    dsmc = cool(gas, at * float(gas.mean_free_time), model, config["seed"])
    each = replicas_of(dsmc, quantity) / unit
    return of, dsmc, Compared(tau, np.asarray(getattr(of, quantity)) / unit, at, each)


@dataclass
class Compared:
    """A quantity of a gas over time: theory at many times, and DSMC at some.

    Attributes:
        tau, theory: times in mean free times, and kinetic theory there.
        where, local: midpoints of these times, and d ln theory / d ln t there.
        at, each: times of DSMC, and its values in each replica.
        mean, error: their mean and standard error.
        middle, exponent, exponent_error: midpoints of these times, local exponents and errors.
    """

    tau: np.ndarray
    theory: np.ndarray
    at: np.ndarray
    each: np.ndarray

    def __post_init__(self) -> None:
        self.mean, self.error = mean_and_error(self.each)
        self.where, self.local = slope(self.tau, self.theory)
        self.middle, exponents = slope(self.at, self.each)
        self.exponent, self.exponent_error = mean_and_error(exponents)

    @property
    def miss(self) -> np.ndarray:
        """Return DSMC over theory, minus 1."""
        return self.mean / interpolate_logs(self.at, self.tau, self.theory) - 1

    def draw(self, values: Axes, exponents: Axes | None, color: str, label: str, power=None):
        """Draw theory as a line and DSMC as points, their local exponents, and the paper's."""
        values.plot(self.tau, self.theory, color=color, label=label)
        values.errorbar(self.at, self.mean, self.error, color=color, **DOTS)
        if exponents is not None:
            exponents.plot(self.where, self.local, color=color, label=label)
            exponents.errorbar(self.middle, self.exponent, self.exponent_error, color=color, **DOTS)
            if power is not None:
                exponents.axhline(power, color=color, ls=":", lw=1)


def draw_forms(
    axes: Axes, of: Compared, delta: float, labels: tuple, leading: Any, formula: Any, powers: range
) -> dict:
    """Draw relative errors of closed forms, and return them at powers of ten, by the short label.

    The forms are the leading term, and the formula at (tau, delta), as printed and corrected.
    """
    rows, printed = {}, formula(of.tau, delta, corrected=False)
    forms = ((leading, ":"), (printed, "--"), (formula(of.tau, delta), "-"))
    for label, (values, style) in zip(labels, forms, strict=True):
        miss = np.asarray(values) / of.theory - 1
        axes.plot(of.tau, miss, style, color=VISCOELASTIC, label=label)
        short = label.split(":")[0].replace("$^2$", "^2")
        rows[short] = {f"{10.0**k:g}": interpolate(10.0**k, of.tau, miss) for k in powers}
    return rows
