"""Fits of the parameters of a gas to one measurement, or to several together."""

import warnings
from collections.abc import Iterator
from itertools import permutations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxgran._utils.validation import check_bool, checked_int
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import DENSITY, START_TIME, Measurement, Priors
from jaxgran.fitting.descent import Descent, is_transformation
from jaxgran.fitting.estimate import fit_without_noise
from jaxgran.fitting.guesses import halving_time
from jaxgran.fitting.learnt_law import describe_unvisited_knots
from jaxgran.fitting.measured_rows import unused_displacements, unused_rotation
from jaxgran.fitting.parameters import SHARED, SMOOTHNESS, domain_of, with_names_of_law
from jaxgran.fitting.reasons import describe_search
from jaxgran.fitting.result import Fit
from jaxgran.fitting.setup import Request
from jaxgran.fitting.simulated_fit import fit_through_simulations
from jaxgran.fitting.simulations import MAX_LINEARISED
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_gas, checked_key, checked_model
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import RestitutionLaw
from jaxgran.scene.parameter_fields import law_fields
from jaxgran.scene.parameters import BY_SYMBOL, MATERIAL, PARAMETERS, symbol_of

GRAIN_PARAMETERS = ("diameter", "diameter_sd", DENSITY)
"""Parameters of a scene that several measurements of the same grains share."""

START_TIME_PRIOR = 1.0
"""Standard error of the prior of t0 where T_0 is free too, over the time in which T halves."""

DEFAULT_STEPS = {
    (False, False): 100,
    (False, True): 1000,
    (True, False): 8,
    (True, True): 100,
}
"""Default of `max_steps`, by whether the model is stochastic and whether optax searches."""

HOW_TO_MEASURE = (
    "Make one by jaxgran.read_measurement(path), or by jaxgran.Measurement(gas, "
    "jaxgran.CoolingCurve(t, T))"
)
"""End of messages on other objects."""


def fit(
    measurement: Measurement | dict[str, Measurement],
    *,
    model: AbstractModel | None = None,
    free: tuple[str, ...] | str | None = None,
    separate: tuple[str, ...] = (),
    start: Gas | None = None,
    solver: Any = None,
    max_steps: int | None = None,
    key: PRNGKeyArray | None = None,
    progress: bool = True,
    throw: bool = True,
    quick: bool = False,
) -> Fit:
    """Estimate parameters of a gas from one measurement, or from several together.

    Maximises the likelihood L of the measured values over the free parameters in an unconstrained
    scale (the logarithm of a positive one). The residuals of ln T, and of ln T_rot where it is
    measured, are Gaussian with the covariance that kinetic theory gives to a run of N grains
    (`jaxgran.KineticTheory.covariance`), the errors of the measurement, and a smooth error of
    theory's cooling rate; <dr^2> is compared within its errors and the accuracy of the model.
    Then the alternative explanations of the data are fitted, too: the range of each parameter is
    that over all explanations which the data do not exclude.

    Several measurements share the parameters `free`.

    A model without noise is fitted by Newton's method. A stochastic model is fitted to T and T_rot
    by Gauss-Newton steps, each on one simulation, that start at the fit of kinetic theory (or at
    `start`). The errors then include the noise of the simulations, estimated from their replicas,
    and the range comes from kinetic theory about the fitted curve. A bias of the derivatives by
    some per cent slows the search and scales the standard error by the same factor, but does not
    shift the estimate, at which the residuals vanish.

    Args:
        measurement: a `jaxgran.Measurement`, or a dictionary of them by label: measurements of one
            material.
        model: a `jaxgran.extend.AbstractModel`, by default `jaxgran.KineticTheory()`; a stochastic
            model needs two or more replicas.
        free: names of the free parameters: numbers of the gas or its law, such as "temperature"
            (T_0), or their symbols in files, such as "T0"; or "t0", the time at which the gas had
            T_0 and began to cool, if the clock was not started then; "law" stands for all numbers
            and arrays of the law. A single name needs no tuple. By default A (or a constant
            restitution) and, if T has no errors, T_0. A cooling gas forgets its initial
            temperature: a free T_0 compensates for any start of the clock, and a curve does not
            determine both T_0 and t0; if both are free, t0 is constrained to 0 within the time in
            which T halves. If t0 is free, <dr^2> is not used.
        separate: names of further free parameters that each of several curves has separately, such
            as "temperature" or "t0"; in the result their names begin with the label, "dense: t0".
        start: a gas whose values are a further guess. A model without noise starts at this guess or
            at that from the data, whichever fits better; a stochastic model starts at this one.
        solver: a gradient transformation of optax, such as ``optax.adam(0.05)``, for laws of many
            parameters: each step takes one gradient of -2 ln L in the unconstrained scale, through
            a stochastic model from one simulation with new random numbers, and the estimate is
            then the mean of the last half of the steps. Its course is ``result.trace``. With more
            than 30 parameters and a stochastic model the errors are nan.
        max_steps: maximum number of steps, >= 1, by default 100 (of optax, 1000), or of simulations
            of a stochastic model, by default 8 (of optax, 100).
        key: key of the random numbers of a stochastic model, by default `jax.random.key(0)`: two
            calls without a key return the same numbers.
        progress: show progress bars on a terminal during simulations.
        throw: raise RuntimeError if a descent by optax diverges. With False the result is the best
            step so far, and `converged` is False.
        quick: leave the search of alternatives out, which takes most of the time; then there are no
            ranges.

    Returns:
        `Fit`. `print` shows the range first.

    Raises:
        ValueError: for something else than measurements, an unknown parameter or solver, no more
            points with a weight than parameters, or a scene that the model does not support or
            cannot fit.
        RuntimeError: if a descent diverges, or the model cannot compute the curve where the search
            ends.

    >>> result = jaxgran.fit(jaxgran.Measurement(gas, curve, num_particles=10**6))
    >>> f"{float(result.estimate[0]):.3g} s"
    '3e-06 s'
    """
    check_bool(progress=progress, throw=throw, quick=quick)
    measurements = _checked_measurements(measurement)
    model = KineticTheory() if model is None else model
    first = next(iter(measurements.values()))  # a curve, unless there are drop tests alone
    gas = first.gas
    separate = _names(separate, gas)
    if free is None:
        defaults = free_by_default(first)
        names = tuple(name for name in defaults if name not in separate)
    else:
        names = _names(free, gas)
    _check_free(measurements, names, separate)
    if max_steps is not None:
        checked_int("max_steps", max_steps, 1)
    key = checked_key(key)
    priors = _priors_by_label(measurements)
    if _is_smoothed(gas.law, names):
        _check_smoothed(gas.law, model, solver)
        priors = _with_prior(priors, SHARED, SMOOTHNESS, 1.0)
    for text in _unused_columns(measurements):
        warnings.warn(text, stacklevel=2)
    _check_solver(solver)
    _check_model(model, (*names, *separate), priors.get(SHARED, {}), measurements)
    for label, width in _widths_of_start_time(measurements, names, separate, priors).items():
        priors = _with_prior(priors, label, START_TIME, width)
    _check_priors(priors, separate)
    if model.stochastic:  # of one curve, whose parameters are all its own
        names = (*names, *separate)
        separate = ()
    request = Request(
        measurements=measurements,
        model=model,
        names=names,
        separate=separate,
        priors=priors,
        start=start,
        quick=quick,
    )
    descent = None if solver is None else Descent(solver, progress, throw)
    if max_steps is None:
        max_steps = DEFAULT_STEPS[bool(model.stochastic), descent is not None]
    if model.stochastic:
        key = jax.random.key(0) if key is None else key
        result = fit_through_simulations(request, key, progress, max_steps, descent)
    else:
        result = fit_without_noise(request, max_steps, descent)
    for text in _warnings(result, model):
        warnings.warn(text, stacklevel=2)
    return result


def _checked_measurements(measurement: Any) -> dict[str, Measurement]:
    """Return measurements by label, drop tests last; the label of a single measurement is ""."""
    if isinstance(measurement, Measurement):
        return {"": measurement}
    if not isinstance(measurement, dict):
        raise ValueError(
            f"expected a jaxgran.Measurement, got a {type(measurement).__name__}. {HOW_TO_MEASURE}"
        )
    if not measurement:
        raise ValueError("no measurement is given: give one or more, as {'first': measurement}")
    for label, value in measurement.items():
        if not isinstance(label, str) or not label or ": " in label:
            raise ValueError(f'labels of measurements are texts without ": ", got {label!r}')
        if not isinstance(value, Measurement):
            raise ValueError(
                f"{label!r} must be a jaxgran.Measurement, got a {type(value).__name__}. "
                f"{HOW_TO_MEASURE}"
            )
    _check_no_copies(measurement)
    # Curves come first: their gases have the parameters that drop tests do not depend on.
    return dict(sorted(measurement.items(), key=lambda pair: isinstance(pair[1].data, DropTest)))


def _check_no_copies(measurements: dict[str, Measurement]) -> None:
    """Raise ValueError if another measurement has all values of one of them."""
    rows = {label: _rows_of(m.data) for label, m in measurements.items()}
    for a, b in permutations(rows, 2):
        if rows[a] <= rows[b]:
            raise ValueError(
                f"{a!r} and {b!r} hold the same values: two fits of one measurement would count it "
                "twice. Give each measurement once"
            )


def _rows_of(data: CoolingCurve | DropTest) -> set[tuple[str, ...]]:
    """Return the measured values as texts of 6 digits, in which copies in other units agree."""
    if isinstance(data, DropTest):
        columns = [data.speed, data.restitution, data.error]
        if data.is_oblique:
            columns += [data.tangential_speed, data.tangential_restitution]
    else:
        columns = [data.times, data.temperature]
    rows = zip(*(np.asarray(x).tolist() for x in columns), strict=True)
    return {tuple(f"{x:.6g}" for x in row) for row in rows}


def _names(names: Any, gas: Gas) -> tuple[str, ...]:
    """Return names of parameters in place of symbols of files, and of "law"."""
    names = () if names is None else names
    names = (names,) if isinstance(names, str) else names
    if not isinstance(names, tuple | list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"free and separate must be tuples of names, got {names!r}")
    known = gas.domains
    names = [
        BY_SYMBOL[name].name if name in BY_SYMBOL and name not in known else name for name in names
    ]
    return with_names_of_law(tuple(names), gas)


def free_by_default(measurement: Measurement) -> tuple[str, ...]:
    """Return A, or a constant restitution, and T_0 if the errors of T are not known."""
    gas = measurement.gas
    constants = [name for name in ("dissipative_constant", "coefficient") if name in gas.domains]
    if not constants:
        raise ValueError(
            f"the law {type(gas.law).__name__} has neither A nor a constant coefficient: give "
            f"free, names among {', '.join(gas.domains)}"
        )
    data = measurement.data
    is_bare = isinstance(data, CoolingCurve) and data.temperature_error is None
    return (constants[0], "temperature") if is_bare else (constants[0],)


def _check_free(
    measurements: dict[str, Measurement], free: tuple[str, ...], separate: tuple[str, ...]
) -> None:
    """Raise ValueError unless free and separate are names of different parameters."""
    if not free or len(set(free)) < len(free):
        raise ValueError(f"free must be a tuple of different names, got {free!r}")
    names = (*free, *separate)
    if len(set(names)) < len(names) or (START_TIME in free and len(measurements) > 1):
        raise ValueError(
            f"free and separate must be different names, got {free} and {separate}; of several "
            f"measurements each has its own {START_TIME}: put it into separate"
        )
    for label, m in measurements.items():
        # Spheres of drop tests beside curves need not have the elements of the curves.
        if not isinstance(m.data, DropTest) or len(measurements) == 1:
            _check_free_of(label, m, names)


def _check_free_of(label: str, m: Measurement, names: tuple[str, ...]) -> None:
    """Raise ValueError unless a measurement has all free parameters, and no other guess."""
    for name in names:
        try:
            domain_of(m.gas, name)
        except ValueError as error:
            symbol = symbol_of(name)
            hint = f". Give the header line `# {symbol}: guess`" if symbol in BY_SYMBOL else ""
            raise ValueError(f"{error}{hint}") from None
    if missing := [symbol_of(name) for name in m.guesses if name not in names]:
        place = f" of {label!r}" if label else ""
        raise ValueError(
            f"the value{place} of {missing[0]} is a guess: free it, too, or give its value"
        )


def _priors_by_label(measurements: dict[str, Measurement]) -> dict[str, Priors]:
    """Return the priors of shared parameters (`SHARED`) and of each measurement.

    Several measurements share the parameters of the material and, if they tell of the same grains,
    those of the grains.
    """
    parts: dict[str, Priors] = {}
    of_grains = _common_to_all_grains(measurements)
    for label, m in measurements.items():
        for name, pair in m.priors.items():
            of_material = name in PARAMETERS and PARAMETERS[name].belongs_to == MATERIAL
            is_shared = (of_material and name != DENSITY) or name in of_grains
            place = SHARED if is_shared else label
            known = parts.setdefault(place, {}).setdefault(name, pair)
            if not all(np.array_equal(x, y) for x, y in zip(known, pair, strict=True)):
                raise ValueError(
                    f"the measurements share {name}, but give different values of it, "
                    f"{float(known[0]):g} +- {float(known[1]):g} and {float(pair[0]):g} +- "
                    f"{float(pair[1]):g}: give one of them"
                )
    return parts


def _common_to_all_grains(measurements: dict[str, Measurement]) -> set[str]:
    """Return the parameters of single grains of which all measurements have one knowledge."""
    gases = [m.gas for m in measurements.values()]
    sizes = {(float(np.ravel(x.diameter)[0]), float(np.ravel(x.mass)[0])) for x in gases}
    if len(sizes) > 1:
        return set()

    def is_common(name: str) -> bool:
        pairs = [m.priors[name] for m in measurements.values() if name in m.priors]
        return all(np.array_equal(pair, pairs[0]) for pair in pairs)

    return {name for name in GRAIN_PARAMETERS if is_common(name)}


def _with_prior(
    priors: dict[str, Priors], label: str, name: str, width: float
) -> dict[str, Priors]:
    """Return priors with a further one, of mean 0."""
    prior = (jnp.asarray(0.0), jnp.asarray(width))
    return priors | {label: priors.get(label, {}) | {name: prior}}


def _is_smoothed(law: RestitutionLaw, names: tuple[str, ...]) -> bool:
    """Tell whether a law has a prior of its own on parameters that are free."""
    return bool(law.prior_residuals().size) and not {*names}.isdisjoint(law_fields(law))


def _check_smoothed(law: RestitutionLaw, model: Any, solver: Any) -> None:
    """Raise ValueError if the prior of a law is not supported by the search."""
    if getattr(model, "stochastic", False) and solver is None:
        raise ValueError(
            f"a smoothness prior, which {type(law).__name__} has, needs KineticTheory() or a "
            f"solver of optax, as optax.adam(0.05), got {type(model).__name__} without solver"
        )


def _curves(measurements: dict[str, Measurement]) -> dict[str, Measurement]:
    return {label: m for label, m in measurements.items() if isinstance(m.data, CoolingCurve)}


def _unused_columns(measurements: dict[str, Measurement]) -> Iterator[str]:
    """Yield warnings about measured values that the fit does not use."""
    for m in _curves(measurements).values():
        for unused in (unused_rotation(m), unused_displacements(m)):
            if unused is not None:
                yield unused


def _check_solver(solver: Any) -> None:
    """Raise ValueError unless a solver is a gradient transformation, or None."""
    if not (solver is None or is_transformation(solver)):
        raise ValueError(
            "solver must be a gradient transformation of optax, such as optax.adam(0.05), or left "
            f"out, got {solver!r:.60}"
        )


def _check_model(
    model: Any, names: tuple[str, ...], priors: Priors, measurements: dict[str, Measurement]
) -> None:
    """Raise ValueError unless a model can be fitted to measurements.

    Args:
        model: of the user.
        names: of all free parameters.
        priors: of shared parameters.
        measurements: by label.
    """
    checked_gas(next(iter(measurements.values())).gas)
    name = type(checked_model(model)).__name__
    curves = _curves(measurements)
    if START_TIME in {*names, *priors} and not curves:
        raise ValueError(f"{START_TIME} needs a cooling curve, and there are drop tests alone")
    if model.stochastic:
        if [*curves] != [""]:
            raise ValueError(
                "several measurements and drop tests are fitted by a model without noise, got "
                f"{name}. Use jaxgran.KineticTheory(), or fit the curves one by one"
            )
        _check_simulated(model, names, priors, curves[""])
    model.check_fit(names)


def _check_simulated(
    model: AbstractModel, names: tuple[str, ...], priors: Priors, measurement: Measurement
) -> None:
    """Raise ValueError unless a curve can be fitted through simulations."""
    name = type(model).__name__
    gas = measurement.gas
    if not np.all(np.asarray(measurement.curve.temperature) > 0):
        raise ValueError(
            f"T below 0 is compared by kinetic theory only, got {name}. Fit the curve up to "
            "where T falls below some T_err"
        )
    T_rot = measurement.curve.rotational_temperature
    if gas.surface is not None and T_rot is not None and not np.all(np.asarray(T_rot) > 0):
        raise ValueError(
            f"T_rot of 0 or less is compared by kinetic theory only, got {name}. Leave the "
            "column out, or the times at which T_rot is not above 0"
        )
    if START_TIME in {*names, *priors}:
        raise ValueError(
            f"{START_TIME} is fitted through kinetic theory only, got {name}. Fit it by "
            "kinetic theory, subtract it from the times, and leave it out of free and priors"
        )
    if priors and "friction" in gas.elements:
        raise ValueError(
            f"priors with {name} are propagated by kinetic theory, which does not support "
            "friction. Leave priors out, or add those parameters to free"
        )
    if both := [x for x in priors if x in names]:
        raise ValueError(
            f"{both[0]} is in free and in priors, which a stochastic model does not support: "
            f"leave {both[0]} out of free (its prior then widens the errors) or out of priors"
        )
    replicas = getattr(model, "replicas", None)
    if isinstance(replicas, int) and replicas < 2:
        raise ValueError(
            f"a fit through {name} needs replicas >= 2 to estimate its noise, got {replicas}"
        )


def _widths_of_start_time(
    measurements: dict[str, Measurement],
    free: tuple[str, ...],
    separate: tuple[str, ...],
    priors: dict[str, Priors],
) -> dict[str, float]:
    """Return standard errors of t0, by label, where T_0 is free too and neither is known."""
    known = {name for some in priors.values() for name in some}
    if not {START_TIME, "temperature"} <= {*free, *separate} - known:
        return {}
    curves = _curves(measurements)
    first = next(iter(curves))
    labels = curves if START_TIME in separate else [SHARED]
    return {
        label: START_TIME_PRIOR * float(halving_time(curves[label or first].curve))
        for label in labels
    }


def _check_priors(priors: dict[str, Priors], separate: tuple[str, ...]) -> None:
    """Raise ValueError if a parameter that curves have separately has a common prior."""
    if both := [name for name in separate if name in priors.get(SHARED, {})]:
        raise ValueError(
            f"{both[0]} is fitted separately for each curve, and the curves have one common prior "
            "of it: free it for all, or leave its error out of the headers"
        )


def _warnings(result: Fit, model: AbstractModel) -> Iterator[str]:
    """Yield what a user should know before the result is used."""
    yield from describe_unvisited_knots(result)
    yield from describe_search(result)
    if jnp.result_type(float) == jnp.float32:
        yield (
            "fitting in float32: relative errors below 1e-4 are round-off. Call "
            'jax.config.update("jax_enable_x64", True) first'
        )
    if model.stochastic and len(result.estimate) > MAX_LINEARISED:
        yield (
            f"no errors are given of {len(result.estimate)} parameters fitted through "
            f"{type(model).__name__}: judge them by several fits with other keys"
        )
