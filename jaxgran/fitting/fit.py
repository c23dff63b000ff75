"""Fits of the parameters of a gas to one measurement, or to several together."""

import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, array_module
from jaxgran._utils.validation import check_bool, checked_int
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.curve_file import DropTest
from jaxgran.fitting.diagnosis import checked_absent, describe_search, diagnose
from jaxgran.fitting.error_budget import clock_accuracy, with_scene_errors
from jaxgran.fitting.learnt_law import describe_unvisited_knots
from jaxgran.fitting.optimise import Problem, best_of_starts, is_transformation, search
from jaxgran.fitting.parameters import (
    SHARED,
    SMOOTHNESS,
    START_TIME,
    Priors,
    checked_priors,
    domain_of,
    guess_from_data,
    guess_from_drops,
    guess_start_time,
    halving_time,
    known_start_time,
    with_names_of_law,
)
from jaxgran.fitting.residuals import (
    DropTestRows,
    Measurement,
    check_curve,
    unused_rotation,
    uses_rotation,
    with_errors_of_particles,
)
from jaxgran.fitting.result import Fit, assemble_fit
from jaxgran.fitting.stochastic import MAX_LINEARISED, Descent, fit_stochastic
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_gas, checked_key, checked_model
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas, law_fields

START_TIME_PRIOR = 1.0
"""Standard error of the prior of t0 where T_0 is free too, over the time in which T halves."""

Data = CoolingCurve | DropTest


def fit(
    gas: Gas | dict[str, Gas],
    data: Data | dict[str, Data],
    *,
    model: AbstractModel | None = None,
    free: tuple[str, ...] | str | None = None,
    separate: tuple[str, ...] = (),
    priors: dict[str, tuple[float, float]] | None = None,
    start: Gas | None = None,
    num_particles: int | dict[str, int] | None = None,
    replicas: int | dict[str, int] = 1,
    solver: Any = None,
    max_steps: int | None = None,
    key: PRNGKeyArray | None = None,
    progress: bool = True,
    throw: bool = True,
    absent: tuple[str, ...] = (),
) -> Fit:
    """Estimate parameters of a gas from one measurement, or from several together.

    Minimises ``chi^2 = sum [(ln T_measured - ln T_model) / (T_err/T)]^2``, plus the same sums for
    <dr^2> and for T_rot where they are measured with a known error, over the free parameters in an
    unconstrained scale (the logarithm of a positive one). Points with an error of 0 (a prepared
    state at t = 0) have no weight. <dr^2> is compared to within the model's accuracy (kinetic
    theory in 3D: 1.7 %), which applies both to each point and to a common factor of the diffusive
    part.

    Several measurements share the parameters `free`. The clock of each curve is then free within
    the accuracy of the model in its scene, as it is with priors.

    A deterministic model is fitted by least squares; this works under `jax.vmap` and `jax.jit`. A
    stochastic model is fitted to T and T_rot by Gauss-Newton steps, each on one simulation, that
    start at the fit of kinetic theory (or at `start`). The errors then include the noise of the
    simulations, estimated from their replicas. A bias of the derivatives by some per cent slows the
    search and scales the standard error by the same factor, but does not shift the estimate, at
    which the residuals vanish.

    Args:
        gas: the scene, or for several measurements a dictionary of scenes by label. Its values of
            free parameters are not used where the data give a guess (A, T_0, a constant
            restitution); the others are the guess.
        data: a `CoolingCurve`, a `DropTest`, or a dictionary of them by label: measurements of one
            material. If T has no errors, a relative error that is the same at all times is
            estimated from the scatter; of several measurements each needs errors.
        model: a `jaxgran.AbstractModel`, by default `jaxgran.KineticTheory()`; a stochastic model
            needs two or more replicas.
        free: names of the free parameters: floats of the gas or its law, such as "temperature"
            (T_0), or "t0", the time at which the gas had T_0 and began to cool, if the clock was
            not started then; "law" stands for all numbers and arrays of the law. A single name
            needs no tuple. By default A (or a constant restitution) and, if T has no errors, T_0.
            A cooling gas forgets its initial temperature: a free T_0 compensates for any start of
            the clock, and a curve does not determine both T_0 and t0; if both are free, t0 is
            constrained to 0 within the time in which T halves. If t0 is free, <dr^2> is not used.
        separate: names of further free parameters that each of several curves has separately, such
            as "temperature" or "t0"; in the result their names begin with the label, "dense: t0".
        priors: known values and standard errors, SI, by name, as
            ``{"packing_fraction": (0.05, 0.002)}``: of floats of the gas, of "density", which lets
            the mass vary, or of "t0". Each prior is Gaussian in the unconstrained scale, and its
            parameter is fitted along with the free ones; for a stochastic model the errors are
            propagated with the derivatives of kinetic theory. Names of several measurements may
            begin with a label, "dense: packing_fraction".
        start: a gas whose values are a further guess. A deterministic model starts at this guess or
            at that from the data, whichever fits better; a stochastic model starts at this one.
        num_particles: N of the measured gas, if known; or N by label. It gives the errors due to
            the randomness of single collisions and due to a flow that grows in the box, and
            corrects a deterministic model for the faster cooling of few particles (a particle model
            needs as many particles as were measured). If <dr^2> has no error, its relative error is
            ``sqrt(2 / (d N))`` over the root of `replicas`; without either, or if T has no errors,
            <dr^2> is not used, because the weights could not be compared.
        replicas: number of measured runs over which the curve is a mean; or this by label. From 2
            on, the errors are taken to be estimated from the scatter of these runs: they are
            smoothed along the curve, and their uncertainty is accounted for
            (`jaxgran.fitting.residuals.smooth_errors`).
        solver: of optimistix, such as ``optimistix.BFGS(rtol=1e-8, atol=1e-8)``, which is compiled
            for this fit (deterministic models only); by default Levenberg-Marquardt, on the host
            around one program that all fits of such gases share. Or a gradient transformation of
            optax, such as ``optax.adam(0.05)``, for laws of many parameters: each step takes one
            gradient of chi^2 in the unconstrained scale, through a stochastic model that of one
            simulation with new random numbers, and the estimate is then the mean of the last half
            of the steps. Its course is ``result.minima.trace``. With more than 30 parameters and a
            stochastic model the errors are nan.
        max_steps: maximum number of steps, >= 1, by default 100 (of optax, 1000), or of simulations
            of a stochastic model, by default 8 (of optax, 100).
        key: key of the random numbers of a stochastic model, by default `jax.random.key(0)`: two
            calls without a key return the same numbers.
        progress: show progress bars on a terminal during simulations.
        throw: raise RuntimeError if a descent by optax diverges. With False the result is the best
            step so far, and `converged` is False.
        absent: effects that are known to be absent, of "walls", "roughness", "drag" and "friction":
            `jaxgran.diagnose` then does not consider these explanations. The estimates do not
            depend on it.

    Returns:
        `Fit`; `jaxgran.diagnose` gives the range of the parameters over all explanations that the
        data do not exclude, and `print` shows it first. Under `jax.vmap` and `jax.jit` its errors
        contain the model's ``derivative_accuracy`` instead of the error of the clock in this scene,
        and omit the randomness of few particles.

    Raises:
        ValueError: for an unknown parameter or solver, an invalid curve (see `CoolingCurve.check`),
            no more points with a weight than parameters, or a scene that the model does not support
            or cannot fit.
        RuntimeError: if a descent diverges, or the model cannot compute the curve where the search
            ends. Under `jax.vmap`,
            where nothing can be raised, chi2 and the errors of that fit are nan, `converged` is
            False and `curve.status` holds the reason.

    >>> result = jaxgran.fit(gas.replace(dissipative_constant=0.0), curve)
    >>> f"{float(result.estimate[0]):.3g} s"
    '3e-06 s'
    """
    check_bool(progress=progress, throw=throw)
    if any_traced(gas, data):
        gas, data = _without_derivative((gas, data))
    scenes, data = _by_label(gas, data)
    model = KineticTheory() if model is None else model
    curves = {label: x for label, x in data.items() if isinstance(x, CoolingCurve)}
    counts = _numbers_by_label("num_particles", num_particles, data)
    runs = _numbers_by_label("replicas", replicas, data)
    first = next(iter(curves), next(iter(data)))
    names = free
    if free is None:
        names = tuple(x for x in free_by_default(scenes[first], data[first]) if x not in separate)
    names = with_names_of_law(names, next(iter(scenes.values())))
    _check_request(scenes, names, separate)
    if max_steps is not None:
        checked_int("max_steps", max_steps, 1)
    absent = checked_absent(absent)
    names, separate, key = tuple(names), tuple(separate), checked_key(key)
    all_priors = _priors_by_label(scenes, priors)
    law = next(iter(scenes.values())).law
    if law.prior_residuals().size and not {*names}.isdisjoint(law_fields(law)):
        if getattr(model, "stochastic", False) and solver is None:
            raise ValueError(
                f"a smoothness prior, which {type(law).__name__} has, needs KineticTheory() or a "
                f"solver of optax, as optax.adam(0.05), got {type(model).__name__} without solver"
            )
        smooth = {SMOOTHNESS: (jnp.asarray(0.0), jnp.asarray(1.0))}
        all_priors[SHARED] = all_priors.get(SHARED, {}) | smooth
    as_given = dict(curves)
    for label, curve in as_given.items():
        curve = with_errors_of_particles(scenes[label], curve, counts[label], runs[label] or 1)
        curves[label] = data[label] = curve
        if unused := unused_rotation(scenes[label], curve):
            warnings.warn(unused, stacklevel=2)
    shared = all_priors.get(SHARED, {})
    _check_model(model, solver, (*names, *separate), shared, scenes[first], [*curves])
    known = {name for some in all_priors.values() for name in some}
    if {START_TIME, "temperature"} <= {*names, *separate} - known:
        for label in curves if START_TIME in separate else [SHARED]:
            width = START_TIME_PRIOR * halving_time(curves[label or first])
            start_time = {START_TIME: (jnp.asarray(0.0), jnp.asarray(width))}
            all_priors[label] = all_priors.get(label, {}) | start_time
    descent = None
    if is_transformation(solver) and not any_traced(data, scenes, priors):
        solver = descent = Descent(solver, progress, throw)
    if model.stochastic:
        steps = (8 if descent is None else 100) if max_steps is None else max_steps
        if any_traced(scenes, data, start, model, key):
            raise ValueError(
                "a fit of a stochastic model cannot run inside jax.jit or jax.vmap: fit one curve "
                "at a time, outside of them"
            )
        gas, curve, key = scenes[first], curves[first], jax.random.key(0) if key is None else key
        m = Measurement.of(first, gas, curve, model, None, runs[first] or 1, use_displacement=False)
        guess = _guess_of_kinetic_theory(gas, curve, names, start)
        shared = {k: x for k, x in all_priors.get(SHARED, {}).items() if k != SMOOTHNESS}
        search_by = None if descent is None else descent.by_simulation
        result = fit_stochastic(m, model, names, guess, key, progress, steps, shared, search_by)
    else:
        result = _fit_deterministic(
            scenes, data, model, names, separate, all_priors, start, counts, runs, solver, max_steps
        )
    if any_traced(result.chi2, data, scenes):
        return result
    if descent is not None:
        result = replace(result, minima=result.minima._replace(trace=descent.trace))
    comparisons = {
        label: c._replace(
            num_particles=counts[label],
            replicas=runs[label] or 1,
            errors_of_particles=data[label] is not as_given.get(label, data[label]),
        )
        for label, c in result.comparisons.items()
    }
    result = replace(result, comparisons=comparisons, absent=absent, interpret=diagnose)
    curves = result.curve.values() if isinstance(result.curve, dict) else [result.curve]
    _check_computed(model, result.names, result.estimate, [vars(c) for c in curves if c])
    _warn(result)
    if np.isfinite(result.chi2):
        result = with_scene_errors(result)
    if model.stochastic and len(result.estimate) > MAX_LINEARISED:
        warnings.warn(
            f"no errors are given of {len(result.estimate)} parameters fitted through "
            f"{type(model).__name__}: judge them by several fits with other keys",
            stacklevel=2,
        )
        missing = {name: jnp.full_like(x, jnp.nan) for name, x in result.covariances.items()}
        result = replace(result, covariances=missing)
    return result


def _fit_deterministic(
    scenes: dict[str, Gas],
    data: dict[str, Data],
    model: AbstractModel,
    names: tuple[str, ...],
    separate: tuple[str, ...],
    priors: dict[str, Priors],
    start: Gas | None,
    counts: dict[str, int | None],
    runs: dict[str, int | None],
    solver: Any,
    max_steps: int | None,
) -> Fit:
    """Fit a deterministic model, starting at the best of some guesses."""
    free = (*names, *separate)
    clock_is_free = bool(priors) or len(data) > 1
    prior_names = {name for some in priors.values() for name in some}
    measurements: list[Measurement | DropTestRows] = []
    guesses = {}
    for label, measured in data.items():
        gas = scenes[label]
        if isinstance(measured, DropTest):
            measurements.append(DropTestRows(label, gas, measured))
            guesses[label] = guess_from_drops(gas, measured, free)
            continue
        model.check_scene(gas if start is None else start)
        m = Measurement.of(
            label,
            gas,
            measured,
            model,
            counts[label],
            runs[label] or 1,
            use_displacement=START_TIME not in (*free, *prior_names),
        )
        clocks = (START_TIME,) if START_TIME in prior_names else ()
        since = m.curve
        if "temperature" in free:
            known = known_start_time(priors, label)[0]
            xp = array_module(since, known)
            since = replace(since, times=xp.asarray(since.times) - xp.asarray(known))
        guesses[label] = guess_from_data(m.gas, since, (*free, *clocks))
        if clock_is_free and not any_traced(measured, gas):
            accuracy = clock_accuracy(guesses[label], m, model, counts[label])
            m = replace(m, clock_accuracy=accuracy)
        measurements.append(m)
    problem = Problem.of(
        tuple(measurements), model, names, separate, priors, clock_is_free=clock_is_free
    )
    for m in measurements:  # drop tests begin at the shared values of the first curve
        if isinstance(m, DropTestRows) and problem.curves:
            guesses[m.label] = with_values_of(m.gas, guesses[problem.curves[0].label], names)
    problem.check_points()
    first = problem.flat(_values_of_guesses(problem, guesses))
    if start is not None:
        complete = {m.label: with_values_of(guesses[m.label], start, free) for m in measurements}
        xp = array_module(first, complete)
        flats = xp.stack([first, problem.flat(_values_of_guesses(problem, complete))])
        costs = xp.stack([xp.sum(problem.evaluate(flat)[1] ** 2) for flat in flats])
        first = flats[xp.argmin(xp.where(xp.isnan(costs), xp.inf, costs))]
    steps = (1000 if isinstance(solver, Descent) else 100) if max_steps is None else max_steps
    (flat, iterations, converged), ends = best_of_starts(problem, first, steps, solver)
    if not any_traced(flat, data, scenes):
        _, fields = problem.evaluate(flat)[2:]
        _check_computed(model, free, problem.estimates(flat), fields.values())
    if any(m.curve.temperature_error is None for m in problem.curves):
        problem = problem.with_scatter_as_error(flat)
        if priors:  # search again with the correct weight of the priors
            flat, more, converged = search(problem, flat, steps, solver)
            problem, iterations = problem.with_scatter_as_error(flat), iterations + more
    rows, _, jacobian, fields = problem.evaluate(flat)
    computed = {m.label: m.as_curve(fields[m.label]) for m in problem.curves}
    return assemble_fit(
        problem,
        flat,
        (rows, jacobian, computed),
        ends=ends,
        iterations=iterations,
        converged=converged,
    )


def _values_of_guesses(problem: Problem, guesses: dict[str, Gas]) -> dict[str, dict[str, Any]]:
    """Return the values of gases and a guess of t0, by label and name."""
    values = {label: gas.floats for label, gas in guesses.items()}
    for m in problem.curves:
        names = tuple(u.name for u in problem.unknowns if u.label in (None, m.label))
        known = known_start_time(problem.priors, m.label)
        values[m.label][START_TIME] = guess_start_time(guesses[m.label], m.curve, names, known)
    return values


def _guess_of_kinetic_theory(
    gas: Gas, curve: CoolingCurve, names: tuple[str, ...], start: Gas | None
) -> Gas:
    """Return the start or, without one, a fit of those parameters that theory determines."""
    smooth = replace(gas, surface=None) if "friction" in gas.elements else gas  # not supported
    determined = {"dissipative_constant", "coefficient", "temperature"}
    if uses_rotation(smooth, curve):
        determined |= {"tangential_restitution", "rotational_temperature"}
    free = tuple(name for name in names if name in determined)
    if start is not None or not free:
        return gas if start is None else start
    count: dict[str, int | None] = {"": None}
    result = _fit_deterministic(
        {"": smooth}, {"": curve}, KineticTheory(), free, (), {}, None, count, count, None, None
    )
    return with_values_of(gas, result.gas, free)


def with_values_of(gas: Gas, other: Gas, names: tuple[str, ...]) -> Gas:
    """Return a gas with the values that another one has for some parameters."""
    return gas.replace(**{n: other.value(n) for n in names if n in other.domains})


def _by_label(gas: Any, data: Any) -> tuple[dict[str, Gas], dict[str, Data]]:
    """Return scenes and measurements by label; the label of a single measurement is ""."""
    if not isinstance(data, dict):
        if isinstance(data, DropTest):
            checked_gas(gas)
        else:
            check_curve(gas, data)
        return {"": gas}, {"": data}
    if not data:
        raise ValueError("data is empty: give one measurement or more, as {'first': curve}")
    if isinstance(gas, dict) and set(gas) != set(data):
        raise ValueError(
            f"gas and data must have the same labels, got {', '.join(map(str, gas))} and "
            f"{', '.join(map(str, data))}"
        )
    scenes = gas if isinstance(gas, dict) else dict.fromkeys(data, gas)
    for label, measured in data.items():
        if not isinstance(label, str) or ": " in label:
            raise ValueError(f'labels of measurements are texts without ": ", got {label!r}')
        if not isinstance(measured, CoolingCurve | DropTest):
            raise ValueError(
                f"measurement {label!r} must be a jaxgran.CoolingCurve or a jaxgran.DropTest, "
                f"got {type(measured).__name__}"
            )
        if isinstance(measured, DropTest):
            checked_gas(scenes[label])
            continue
        check_curve(scenes[label], measured)
        if measured.temperature_error is None and len(data) > 1:
            raise ValueError(
                f"the curve of {label!r} has no errors, which a fit of several measurements needs "
                "as weights: give temperature_error (jaxgran.fit of this curve alone estimates its "
                "scatter)"
            )
    return {label: scenes[label] for label in data}, dict(data)


def _numbers_by_label(name: str, given: Any, data: dict[str, Data]) -> dict[str, int | None]:
    numbers = given if isinstance(given, dict) else dict.fromkeys(data, given)
    if unknown := set(numbers) - set(data):
        given = min(map(str, unknown))
        raise ValueError(f"{name}: no measurement {given!r}; there are {', '.join(data)}")
    for value in numbers.values():
        if value is not None:
            checked_int(name, value, 1)
    return {label: numbers.get(label) for label in data}


def _priors_by_label(scenes: dict[str, Gas], priors: Any) -> dict[str, Priors]:
    """Return the priors of shared parameters (`SHARED`) and of those of each measurement."""
    gas = next(iter(scenes.values()))
    if priors is None:
        return {}
    if not isinstance(priors, dict):
        raise ValueError(
            f"priors must be a dictionary of names, as {{'packing_fraction': (0.05, 0.002)}}, "
            f"got {priors!r:.60}"
        )
    parts: dict[str, dict[str, Any]] = {}
    for name, pair in priors.items():
        label, _, short = str(name).rpartition(": ")
        if label and label not in scenes:
            raise ValueError(f"priors: no measurement {label!r}; there are {list(scenes)}")
        parts.setdefault(label, {})[short] = pair
    return {label: checked_priors(scenes.get(label, gas), some) for label, some in parts.items()}


def free_by_default(gas: Gas, data: Data) -> tuple[str, ...]:
    """Return A, or a constant restitution, and T_0 if the errors of T are not known."""
    constants = [name for name in ("dissipative_constant", "coefficient") if name in gas.domains]
    if not constants:
        raise ValueError(
            f"the law {type(gas.law).__name__} has neither A nor a constant coefficient: give "
            f"free, names among {', '.join(gas.domains)}"
        )
    is_bare = isinstance(data, CoolingCurve) and data.temperature_error is None
    return (constants[0], "temperature") if is_bare else (constants[0],)


def _check_request(scenes: dict[str, Gas], free: Any, separate: Any) -> None:
    """Raise ValueError unless free and separate are names of different parameters."""
    names = (free, separate)
    if any(isinstance(x, str) for x in names) or not free or len(set(free)) < len(free):
        raise ValueError(f"free must be a tuple of different names, got {free!r}")
    names = (*free, *separate)
    if len(set(names)) < len(names) or (START_TIME in free and len(scenes) > 1):
        raise ValueError(
            f"free and separate must be different names, got {free} and {separate}; of several "
            f"measurements each has its own {START_TIME}: put it into separate"
        )
    for gas in scenes.values():
        for name in names:
            domain_of(gas, name)


def _check_model(
    model: Any, solver: Any, names: tuple[str, ...], priors: Priors, gas: Gas, curves: list[str]
) -> None:
    """Raise ValueError unless a solver can fit a model to measurements; `curves` are labels."""
    kinds = optx.AbstractLeastSquaresSolver, optx.AbstractMinimiser
    if not (solver is None or isinstance(solver, kinds) or is_transformation(solver)):
        raise ValueError(
            "solver must be a least-squares solver or a minimiser of optimistix, such as "
            "optimistix.BFGS(rtol=1e-8, atol=1e-8), or a gradient transformation of optax, such as "
            f"optax.adam(0.05), got {solver!r:.60}"
        )
    name, needs_start_time = type(checked_model(model)).__name__, START_TIME in {*names, *priors}
    if needs_start_time and not curves:
        raise ValueError(f"{START_TIME} needs a cooling curve, and there are drop tests alone")
    if model.stochastic:
        if not (solver is None or is_transformation(solver)):
            raise ValueError(
                "a stochastic model is fitted by least squares, without a solver, or by a gradient "
                f"transformation of optax, such as optax.adam(0.05), got {solver!r:.60}"
            )
        if curves != [""]:
            raise ValueError(
                "several measurements and drop tests are fitted by a model without noise, got "
                f"{name}. Use jaxgran.KineticTheory(), or fit the curves one by one"
            )
        if needs_start_time:
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
    model.check_fit(names)


@jax.custom_jvp
def _without_derivative(tree: Any) -> Any:
    return tree


@_without_derivative.defjvp
def _refuse_derivative(primals: Any, tangents: Any) -> Any:
    raise ValueError(
        "jaxgran.fit has no derivative in the gas or the measurements: differentiate "
        "jaxgran.log_likelihood, or take differences of fits. result.comparison.gain tells how far "
        "each point moves the estimate"
    )


def _check_computed(model: AbstractModel, names: Any, estimate: Any, curves: Iterable[Any]) -> None:
    """Raise RuntimeError if one of the curves, dictionaries of fields, was not computed."""
    for curve in curves:
        fault = int(curve.get("status") or status.OK)
        if fault != status.OK:
            values = zip(names, np.asarray(estimate), strict=False)
            at = ", ".join(f"{name} = {value:.3g}" for name, value in values)
            raise RuntimeError(
                f"{type(model).__name__} could not compute the curve at {at}, where the search "
                f"ended: {status.explain(fault)}"
            )


def _warn(result: Fit) -> None:
    if result.chi2.dtype == jnp.float32:
        warnings.warn(
            "fitting in float32: relative errors below 1e-4 are round-off. Call "
            'jax.config.update("jax_enable_x64", True) first',
            stacklevel=3,
        )
    for clause in (*describe_unvisited_knots(result), *describe_search(result)):
        warnings.warn(clause, stacklevel=3)
