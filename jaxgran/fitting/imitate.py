"""Imitations of a measurement: runs of the fitted scene by particles, each of them fitted."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils.formatting import text_table
from jaxgran._utils.validation import check_bool, checked_int
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import START_TIME, Measurement
from jaxgran.fitting.drawn_errors import imitations
from jaxgran.fitting.fit import fit
from jaxgran.fitting.measured_rows import with_errors_that_count
from jaxgran.fitting.result import CONDITIONAL, Fit
from jaxgran.fitting.twins import AS_GIVEN, Truth, strongest_effect
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_key
from jaxgran.models.choose import choose_model
from jaxgran.models.cool import cool
from jaxgran.models.dsmc import DSMC
from jaxgran.models.hard_spheres import HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.parameters import symbol_of

TOLERANCE = 0.02
"""Relative error of T of the model that imitates."""

MAX_GRAINS = 5_000_000
"""Largest number of grains of all runs together."""

MANY_RUNS = 10**6
"""Number of runs for which a model is chosen: its noise does not count."""

NORMAL = 1.96
"""Half of the 95 % interval of a Gaussian, in standard errors."""


@dataclass(frozen=True, eq=False)
class Imitation:
    """Fits of runs of one gas, whose parameters are known.

    Attributes:
        truth: what the gas contains, in words.
        parameter: name of the first free parameter.
        value: its true value, SI.
        model_name: the model of the runs.
        asked: number of runs asked for.
        low, high: ends of the 95 % range in each fitted run, SI, shape (runs,); nan without one.
        estimate, error: estimate and standard error "assuming no other effect", shape (runs,).
        grades: of the fits, see `jaxgran.Fit`.
        strongest: imitations with the strongest alternative as the truth; None without one.

    >>> small = dataclasses.replace(measurement, num_particles=50)
    >>> imitation = jaxgran.imitate(jaxgran.fit(small), runs=2, progress=False)
    >>> imitation.runs, imitation.held <= 2
    (2, True)
    """

    truth: str
    parameter: str
    value: float
    model_name: str
    asked: int
    low: Float[np.ndarray, "runs"]
    high: Float[np.ndarray, "runs"]
    estimate: Float[np.ndarray, "runs"]
    error: Float[np.ndarray, "runs"]
    grades: tuple[str, ...]
    strongest: "Imitation | None" = None

    @property
    def runs(self) -> int:
        """Number of runs that were fitted."""
        return self.low.size

    @property
    def held(self) -> int:
        """Number of runs whose range over all explanations holds the true value."""
        return int(np.sum((self.low <= self.value) & (self.value <= self.high)))

    @property
    def held_alone(self) -> int:
        """The same of the error assuming no other effect, 1.96 standard errors."""
        return int(np.sum(np.abs(self.estimate - self.value) <= NORMAL * self.error))

    @property
    def width(self) -> float:
        """Median width of the range, over the true value."""
        known = np.isfinite(self.low)
        widths = (self.high - self.low)[known] / self.value
        return float(np.median(widths)) if np.any(known) else float("nan")

    @property
    def headline(self) -> str:
        """How many ranges held the true value, in a sentence."""
        text = f"the range held the true {symbol_of(self.parameter)} in {self.held} of {self.runs} "
        return text + f"imitations, its median width is {100 * self.width:.0f} %"

    def __repr__(self) -> str:
        """Table of the shares of the runs."""
        rows = [
            ("truth", f"{self.truth}, {self.value:.4g}, by {self.model_name}"),
            (CONDITIONAL, f"held it in {self.held_alone} of {self.runs}"),
            ("verdicts", _counted(self.grades)),
        ]
        if self.runs < self.asked:
            rows.append(("interrupted", f"after {self.runs} of {self.asked} runs"))
        lines = [text_table(self.headline, rows)]
        return "\n".join(lines if self.strongest is None else [*lines, repr(self.strongest)])


def imitate(
    result: Fit,
    runs: int = 100,
    *,
    model: AbstractModel | None = None,
    key: PRNGKeyArray | None = None,
    progress: bool = True,
) -> Imitation:
    """Simulate the fitted scene many times, fit each run, and count how often the range holds.

    Each run has the times, N, number of runs and errors of the measurement, of the scale of T and
    of the scene (those that the fit counts, or found), begins with T_0, and is fitted by kinetic
    theory. The same is done with the alternative that widens the range most as the truth, at half
    of its largest allowed amplitude; if the data prefer one, at its own amplitude and estimate.
    Contacts of the runs have no duration; <dr^2> is left out.

    Args:
        result: a fit of one curve, with N.
        runs: number of imitations of each truth, >= 2.
        model: particle model of N particles; by default DSMC, or hard spheres between walls, in
            boxes above L_c and in dense gases. Its number of replicas is set to the number of all
            runs.
        key: key of the random numbers, by default `jax.random.key(0)`.
        progress: show a progress bar on a terminal.

    Returns:
        `Imitation`. Ctrl-C ends it early, with the runs that were fitted.

    Raises:
        ValueError: for a fit of several measurements or without N, more than 5e6 grains in all, or
            runs below 2.
        KeyboardInterrupt: if it is interrupted before the first fit.

    >>> small = dataclasses.replace(measurement, num_particles=50)
    >>> imitation = jaxgran.imitate(jaxgran.fit(small), runs=2, progress=False)
    >>> imitation.headline[:23]
    'the range held the true'
    """
    check_bool(progress=progress)
    runs = checked_int("runs", runs, 2)
    measurement = _checked(result, runs)
    key = checked_key(key)
    key = jax.random.key(0) if key is None else key
    strongest = strongest_effect(result)
    found = _imitated(result, measurement, AS_GIVEN, runs, model, key, progress)
    if strongest is None or found.runs < runs:
        return found
    truth, values = strongest
    shifted = replace(measurement, gas=measurement.gas.replace(**values))
    try:
        other = _imitated(result, shifted, truth, runs, model, jax.random.fold_in(key, 1), progress)
    except KeyboardInterrupt:
        return found
    return replace(found, strongest=other)


def _checked(result: Any, runs: int) -> Measurement:
    """Return the measurement of a fit with the fitted gas, or raise ValueError."""
    if not isinstance(result, Fit):
        raise ValueError(
            f"expected the result of jaxgran.fit, got a {type(result).__name__}: call "
            "jaxgran.imitate(jaxgran.fit(measurement))"
        )
    if [*result.measurements] != [""] or not isinstance(result.curve, CoolingCurve):
        raise ValueError("imitate takes a fit of one curve: imitate the curves one by one")
    measurement = result.measurements[""]
    N = measurement.num_particles
    if N is None:
        raise ValueError("imitate needs N, the number of grains: give num_particles (key N)")
    grains = N * measurement.replicas * runs
    if grains > MAX_GRAINS:
        fewer = int(MAX_GRAINS / (N * measurement.replicas))
        raise ValueError(
            f"{runs} imitations of {measurement.replicas} x {N} grains are {grains:.2g} grains; "
            f"{MAX_GRAINS:.2g} are allowed: ask for {fewer} runs or fewer"
        )
    if result.names[0] not in result.gas.domains:
        raise ValueError(
            "imitate counts ranges of the first free parameter, which must be one of the gas, got "
            f"{result.names[0]}: free another one first"
        )
    curve = replace(measurement.curve, displacement=None, displacement_error=None)
    priors = dict(measurement.priors)
    if START_TIME in priors:
        priors[START_TIME] = jnp.asarray(result.start_time[""]), priors[START_TIME][1]
    imitated = replace(measurement, gas=result.gas, data=curve, rounding={}, priors=priors)
    # Particles start with exactly T_0, so that it is the T_0 of each run.
    return replace(with_errors_that_count(imitated), ensemble_start=False)


def _imitated(
    result: Fit,
    measurement: Measurement,
    truth: Truth,
    runs: int,
    model: AbstractModel | None,
    key: PRNGKeyArray,
    progress: bool,
) -> Imitation:
    """Return fits of runs of a truth."""
    gas = truth.gas(measurement.gas)
    N = measurement.num_particles
    assert N is not None
    times = measurement.curve.times
    if model is None and "container" in truth.elements:  # these walls do not enclose N grains
        model = DSMC(N)
    if model is None:
        models = (DSMC(N, replicas=MANY_RUNS), HardSpheres(N, replicas=MANY_RUNS))
        model = choose_model(gas, times, TOLERANCE, N, models=models).model
    several: Any = replace(model, replicas=runs * measurement.replicas)
    of_start, of_errors = jax.random.split(key)
    since = times - jnp.asarray(result.start_time[""])
    if since[0] < 0:
        raise ValueError(
            f"the gas of this fit began at t0 = {result.start_time['']:g} s, after the first time: "
            "imitations begin with the gas. Leave the earlier rows out"
        )
    curve = cool(gas, since, model=several, key=of_start, progress=progress)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(of_errors)))
    twins = imitations(measurement, result, curve, runs, rng)
    without = {"softness", "correlations"} if isinstance(model, DSMC) else {"softness"}
    theory = KineticTheory(corrections=KineticTheory.all_corrections - without)
    fits: list[Fit] = []
    bar = tqdm(twins, desc="fits", delay=3, disable=None if progress else True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            for one in bar:
                fits.append(fit(one, model=theory, free=result.names))
        except KeyboardInterrupt:
            if not fits:
                raise
    name = result.names[0]
    ends = np.array([[np.ravel(x)[0] for x in f.ranges.get(name, (np.nan,) * 2)] for f in fits])
    values = np.array([[np.ravel(x)[0] for x in f.value(f.names[0])] for f in fits])
    return Imitation(
        truth=truth.name,
        parameter=name,
        value=float(np.ravel(measurement.gas.value(name))[0]),
        model_name=model.name,
        asked=runs,
        low=ends[:, 0],
        high=ends[:, 1],
        estimate=values[:, 0],
        error=values[:, 1],
        grades=tuple(f.grade for f in fits),
    )


def _counted(grades: tuple[str, ...]) -> str:
    """Return how often each verdict came."""
    return ", ".join(f"{grade} {grades.count(grade)}" for grade in sorted({*grades}))
