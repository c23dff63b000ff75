"""Imitations of a measurement: runs of the fitted scene by particles, each of them fitted."""

import contextlib
import warnings
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils.formatting import text_table
from jaxgran._utils.validation import check_bool, checked_int
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import START_TIME, Measurement
from jaxgran.fitting.drawn_errors import imitations
from jaxgran.fitting.fit import fit
from jaxgran.fitting.measured_rows import with_errors_that_count
from jaxgran.fitting.parameters import magnitude_of
from jaxgran.fitting.result import CONDITIONAL, Fit
from jaxgran.fitting.threads import quiet_threads
from jaxgran.fitting.twins import AS_GIVEN, Truth, strongest_effect
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_key
from jaxgran.models.choose import choose_model
from jaxgran.models.cool import cool
from jaxgran.models.dsmc import DSMC
from jaxgran.models.hard_spheres import HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import symbol_of

MIN_RUNS = 2
"""Smallest number of imitations."""

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
        strongest: imitations with the strongest alternative as the truth; None without one, or if
            they were interrupted before the first fit.

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
        """Number of runs whose estimate, assuming no other effect, is 1.96 errors or less off."""
        return int(np.sum(np.abs(self.estimate - self.value) <= NORMAL * self.error))

    @property
    def width(self) -> float:
        """Median width of the range, over the true value."""
        known = np.isfinite(self.low)
        widths = (self.high - self.low)[known] / magnitude_of(self.value)
        return float(np.median(widths)) if np.any(known) else float("nan")

    @property
    def headline(self) -> str:
        """How many ranges held the true value, in a sentence."""
        return (
            f"the range held the true {symbol_of(self.parameter)} in {self.held} of {self.runs} "
            f"imitations, its median width is {100 * self.width:.0f} %"
        )

    def __repr__(self) -> str:
        """Table of the shares of the runs."""
        counts = [f"{grade} {self.grades.count(grade)}" for grade in sorted({*self.grades})]
        rows = [
            ("truth", f"{self.truth}, {self.value:.4g}, by {self.model_name}"),
            (CONDITIONAL, f"held it in {self.held_alone} of {self.runs}"),
            ("verdicts", ", ".join(counts)),
        ]
        if self.runs < self.asked:
            rows.append(("interrupted", f"after {self.runs} of {self.asked} runs"))
        tables = [text_table(self.headline, rows)]
        if self.strongest is not None:
            tables.append(repr(self.strongest))
        return "\n".join(tables)


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
        `Imitation`. Ctrl-C ends it early, with the runs that were fitted; a warning says if these
        are runs of the fitted scene alone.

    Raises:
        ValueError: for a fit of several measurements or without N, a model of another number of
            particles, more than 5e6 grains in all, or runs below 2.
        KeyboardInterrupt: if it is interrupted before the first fit.

    >>> small = dataclasses.replace(measurement, num_particles=50)
    >>> imitation = jaxgran.imitate(jaxgran.fit(small), runs=2, progress=False)
    >>> imitation.headline[:23]
    'the range held the true'
    """
    check_bool(progress=progress)
    runs = checked_int("runs", runs, MIN_RUNS)
    _check(result, runs, model)
    measurement = _at_the_estimate(result)
    key = checked_key(key)
    key = jax.random.key(0) if key is None else key
    imitate_truth = partial(
        _imitate_truth, result=result, runs=runs, model=model, progress=progress
    )
    strongest = strongest_effect(result)
    found = imitate_truth(AS_GIVEN, measurement, key=key)
    if strongest is None:
        return found
    if found.runs == runs:
        beside = replace(measurement, gas=measurement.gas.replace(**strongest.values))
        with contextlib.suppress(KeyboardInterrupt):
            other = imitate_truth(strongest.truth, beside, key=jax.random.fold_in(key, 1))
            return replace(found, strongest=other)
    text = f'interrupted before an imitation "{strongest.truth.name}" was fitted'
    warnings.warn(f"{text}: the result holds those of the fitted scene alone", stacklevel=2)
    return found


def _check(result: Any, runs: int, model: AbstractModel | None) -> None:
    """Raise ValueError unless a result can be imitated."""
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
    number = N if model is None else getattr(model, "num_particles", None)
    if number != N:
        raise ValueError(
            f"imitate needs a particle model of the {N} grains of the measurement, got "
            f"{type(model).__name__} of {number or 'no'} particles: give num_particles={N}, or "
            "leave model out"
        )
    if result.names[0] not in result.gas.domains:
        raise ValueError(
            "imitate counts ranges of the first free parameter, which must be one of the gas, got "
            f"{result.names[0]}: free another one first"
        )


def _at_the_estimate(result: Fit) -> Measurement:
    """Return the measurement of a fit, of the fitted gas, with the errors that count."""
    measurement = result.measurements[""]
    curve = replace(measurement.curve, displacement=None, displacement_error=None)
    priors = dict(measurement.priors)
    if START_TIME in priors:
        _, error = priors[START_TIME]
        priors[START_TIME] = jnp.asarray(result.start_time[""]), error
    fitted = replace(measurement, gas=result.gas, data=curve, rounding={}, priors=priors)
    # Particles start with exactly T_0, so that it is the T_0 of each run.
    return replace(with_errors_that_count(fitted), ensemble_start=False)


def _imitate_truth(
    truth: Truth,
    measurement: Measurement,
    *,
    key: PRNGKeyArray,
    result: Fit,
    runs: int,
    model: AbstractModel | None,
    progress: bool,
) -> Imitation:
    """Return fits of runs of a truth, with the measurement at its values."""
    gas = truth.gas(measurement.gas)
    times = _times_since_start(measurement, result)
    if model is None:
        model = _particle_model(truth, gas, times, measurement.num_particles)
    of_runs, of_errors = jax.random.split(key)
    curve = _simulate(model, gas, times, runs * measurement.replicas, of_runs, progress)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(of_errors)))
    measured = imitations(measurement, result, curve, runs, rng)
    fits = _fits(measured, _theory_of(model), result.names, progress)
    name = result.names[0]
    return Imitation(
        truth=truth.name,
        parameter=name,
        value=float(np.ravel(measurement.gas.value(name))[0]),
        model_name=model.name,
        asked=runs,
        grades=tuple(found.grade for found in fits),
        **_ranges_and_estimates(fits, name),
    )


def _simulate(
    model: AbstractModel,
    gas: Gas,
    times: Float[Array, "times"],
    replicas: int,
    key: PRNGKeyArray,
    progress: bool,
) -> CoolingCurve:
    """Return the curve of many replicas of a particle model."""
    of_particles: Any = model
    several = replace(of_particles, replicas=replicas)
    return cool(gas, times, model=several, key=key, progress=progress)


def _ranges_and_estimates(fits: list[Fit], name: str) -> dict[str, Any]:
    """Return the ranges and estimates of a parameter, by their names in an `Imitation`."""
    unknown = np.nan, np.nan
    ranges = [found.ranges.get(name, unknown) for found in fits]
    values = [found.value(name) for found in fits]
    return {
        "low": _first_elements([low for low, _ in ranges]),
        "high": _first_elements([high for _, high in ranges]),
        "estimate": _first_elements([estimate for estimate, _ in values]),
        "error": _first_elements([error for _, error in values]),
    }


def _first_elements(values: list[Any]) -> Float[np.ndarray, "runs"]:
    return np.array([np.ravel(value)[0] for value in values])


def _particle_model(
    truth: Truth, gas: Gas, times: Float[Array, "times"], N: int | None
) -> AbstractModel:
    """Return the model of N particles that imitates a gas."""
    assert N is not None
    if "container" in truth.elements:  # these walls do not enclose N grains
        return DSMC(N)
    models = (DSMC(N, replicas=MANY_RUNS), HardSpheres(N, replicas=MANY_RUNS))
    return choose_model(gas, times, TOLERANCE, N, models=models).model


def _times_since_start(measurement: Measurement, result: Fit) -> Float[Array, "times"]:
    """Return the times since the fitted t0, or raise ValueError if one of them is before it."""
    t0 = result.start_time[""]
    since_start = measurement.curve.times - jnp.asarray(t0)
    if since_start[0] < 0:
        raise ValueError(
            f"the gas of this fit began at t0 = {t0:g} s, after the first time: imitations begin "
            "with the gas. Leave the earlier rows out"
        )
    return since_start


def _theory_of(model: AbstractModel) -> KineticTheory:
    """Return kinetic theory of the gas that a model simulates."""
    without = set()
    if not model.has_contacts:
        without.add("softness")
    if isinstance(model, DSMC):
        without.add("correlations")
    return KineticTheory(corrections=KineticTheory.all_corrections - without)


def _fits(
    measurements: list[Measurement], theory: KineticTheory, free: tuple[str, ...], progress: bool
) -> list[Fit]:
    """Return the fits of imitations, those before an interruption; without any it is raised."""
    fits: list[Fit] = []
    hidden = None if progress else True  # None hides the bar where there is no terminal
    with quiet_threads() as threads:
        found = threads.map(lambda one: fit(one, model=theory, free=free), measurements)
        try:
            for result in tqdm(found, "fits", len(measurements), delay=3, disable=hidden):
                fits.append(result)
        except KeyboardInterrupt:
            if not fits:
                raise
    return fits
