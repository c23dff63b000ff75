"""Fits of the parameters of a gas to one measured cooling curve, or to several together."""

import warnings
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import checked_int, float_array, no_type_check
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.curve_file import DropTest
from jaxgran.fitting.error_budget import clock_accuracy, with_scene_errors
from jaxgran.fitting.optimise import SEARCHES, fit_deterministic, least_squares
from jaxgran.fitting.parameters import (
    START_TIME,
    Parameters,
    Priors,
    domain_of,
    guess_from_data,
    guess_start_time,
    halving_time,
    size_of,
)
from jaxgran.fitting.residuals import (
    Comparison,
    check_curve,
    check_deterministic,
    smooth_errors,
    unused_rotation,
)
from jaxgran.fitting.result import SIGNIFICANCE, Fit, describe_minima
from jaxgran.fitting.stochastic import fit_stochastic
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_gas, checked_key, checked_model
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas

MAX_JOINT_STEPS = 100
"""Maximum number of iterations of a joint fit."""

START_TIME_PRIOR = 1.0
"""Standard error of the prior of t0 where T_0 is free too, over the time in which T halves."""


@no_type_check
def fit(
    gas: Gas,
    curve: CoolingCurve,
    *,
    model: AbstractModel | None = None,
    free: tuple[str, ...] | None = None,
    priors: dict[str, tuple[float, float]] | None = None,
    start: Gas | None = None,
    num_particles: int | None = None,
    replicas: int = 1,
    method: Literal["levenberg-marquardt", "lbfgs"] = "levenberg-marquardt",
    max_steps: int | None = None,
    key: PRNGKeyArray | None = None,
    progress: bool = True,
) -> Fit:
    """Estimate parameters of a gas from its measured cooling curve.

    Minimises ``chi^2 = sum [(ln T_measured - ln T_model) / (T_err/T)]^2``, plus the same sums for
    <dr^2> and for T_rot where they are measured with a known error, over the free parameters in an
    unconstrained scale (the logarithm of a positive one). Points with an error of 0 (a prepared
    state at t = 0) have no weight. <dr^2> is compared to within the model's accuracy (kinetic
    theory in 3D: 1.7 %), which applies both to each point and to a common factor of the diffusive
    part.

    A deterministic model is fitted by least squares; this works under `jax.vmap` and `jax.jit`. A
    stochastic model is fitted to T and T_rot by Gauss-Newton steps, each on one simulation, that
    start at the fit of kinetic theory (or at `start`). The errors then include the noise of the
    simulations, estimated from their replicas. A bias of the derivatives by some per cent slows the
    search and scales the standard error by the same factor, but does not shift the estimate, at
    which the residuals vanish.

    Args:
        gas: the scene. Its values of free parameters are not used where the data give a guess (A,
            T_0, a constant restitution); the others are the guess.
        curve: the measurement. If T has no errors, a relative error that is the same at all times
            is estimated from the scatter.
        model: a `jaxgran.AbstractModel`, by default `jaxgran.KineticTheory()`; a stochastic model
            needs two or more replicas.
        free: names of the free parameters: floats of the gas or its law, such as "temperature"
            (T_0), or "t0", the time at which the gas had T_0 and began to cool, if the clock was
            not started then. By default A (or a constant restitution) and, if T has no errors, T_0.
            A cooling gas forgets its initial temperature: a free T_0 compensates for any start of
            the clock, and a curve does not determine both T_0 and t0; if both are free, t0 is
            constrained to 0 within the time in which T halves. If t0 is free, <dr^2> is not used.
        priors: known values and standard errors, SI, by name, as
            ``{"packing_fraction": (0.05, 0.002)}``: of floats of the gas, of "density", which lets
            the mass vary, or of "t0". Each prior is Gaussian in the unconstrained scale, and its
            parameter is fitted along with the free ones; for a stochastic model the errors are
            propagated with the derivatives of kinetic theory.
        start: a gas whose values are a further guess. A deterministic model starts at this guess or
            at that from the data, whichever fits better; a stochastic model starts at this one.
        num_particles: N of the measured gas, if known. It gives the errors due to the randomness of
            single collisions and due to a flow that grows in the box, and corrects a deterministic
            model for the faster cooling of few particles (a particle model needs as many particles
            as were measured). If <dr^2> has no error, its relative error is ``sqrt(2 / (d N))``
            over the root of `replicas`; without either, or if T has no errors, <dr^2> is not used,
            because the weights could not be compared.
        replicas: number of measured runs over which the curve is a mean. From 2 on, the errors are
            taken to be estimated from the scatter of these runs: they are smoothed along the curve,
            and their uncertainty is accounted for (`jaxgran.fitting.residuals.smooth_errors`).
        method: Levenberg-Marquardt, or L-BFGS by reverse mode (deterministic models only).
        max_steps: maximum number, >= 1, of steps of Levenberg-Marquardt or of evaluations of
            L-BFGS, by default 100, or of simulations of a stochastic model, by default 8.
        key: key of the random numbers of a stochastic model, by default `jax.random.key(0)`: two
            calls without a key return the same numbers.
        progress: show progress bars on a terminal during simulations.

    Returns:
        `Fit`; `jaxgran.diagnose` interprets it in words. Under `jax.vmap` and `jax.jit` its errors
        contain the model's ``derivative_accuracy`` instead of the error of the clock in this scene,
        and omit the randomness of few particles.

    Raises:
        ValueError: for an unknown parameter or method, an invalid curve (see `CoolingCurve.check`),
            no more points with a weight than parameters, or a scene that the model does not support
            or cannot fit.
        RuntimeError: if the model cannot compute the curve where the search ends. Under `jax.vmap`,
            where nothing can be raised, chi2 and the errors of that fit are nan, `converged` is
            False and `curve.status` holds the reason.

    >>> result = jaxgran.fit(gas.replace(dissipative_constant=0.0), curve)
    >>> f"{float(result.estimate[0]):.3g} s"
    '3e-06 s'
    """
    names = free_by_default(gas, curve) if free is None else free
    _check_request(gas, curve, names, max_steps, num_particles, replicas)
    names, key, all_priors = tuple(names), checked_key(key), Priors.of(gas, priors)
    degenerate = {START_TIME, "temperature"}
    if degenerate <= {*names} and not degenerate & {*all_priors.names}:
        all_priors = all_priors.add(START_TIME, 0.0, START_TIME_PRIOR * halving_time(curve))
    if unused := unused_rotation(gas, curve):
        warnings.warn(unused, stacklevel=2)
    curve, error_degrees = smooth_errors(curve, replicas)
    model = KineticTheory() if model is None else model
    _check_model(model, method, names, all_priors, gas)
    if model.stochastic:
        steps = 8 if max_steps is None else max_steps
        result = fit_stochastic(
            gas, curve, model, names, start, key, progress, steps, all_priors, error_degrees
        )
    else:
        guesses = [guess_from_data(gas, curve, names)] + ([] if start is None else [start])
        model.check_scene(guesses[-1])
        steps = 100 if max_steps is None else max_steps
        # Arrays, so that other numbers reuse the compiled program.
        N = None if num_particles is None else float_array(num_particles)
        clock = None
        if all_priors.names and not any_traced(curve, gas):  # the clock is then a free parameter
            clock = clock_accuracy(guesses[0], curve, model, num_particles)
        result = fit_deterministic(
            gas,
            curve,
            model,
            names,
            guesses,
            N,
            float_array(replicas),
            method,
            steps,
            all_priors,
            error_degrees,
            clock,
        )
    if not any_traced(result.chi2, curve, gas):
        _check_computed(result)
        _warn(result)
        if np.isfinite(result.chi2):
            result = with_scene_errors(result, num_particles, replicas)
    return result


@no_type_check
def free_by_default(gas: Gas, curve: CoolingCurve) -> tuple[str, ...]:
    """Return A, or a constant restitution, and T_0 if the errors of T are not known."""
    check_curve(gas, curve)
    constants = [name for name in ("dissipative_constant", "coefficient") if name in gas.domains]
    if not constants:
        raise ValueError(
            f"the law {type(gas.law).__name__} has neither A nor a constant coefficient: give "
            f"free, names among {', '.join(gas.domains)}"
        )
    if curve.temperature_error is None:
        return (constants[0], "temperature")
    return (constants[0],)


@no_type_check
def _check_request(
    gas: Gas,
    curve: CoolingCurve,
    free: tuple[str, ...],
    max_steps: int | None,
    num_particles: int | None,
    replicas: int,
) -> None:
    check_curve(gas, curve)
    if isinstance(free, str) or not free or len(set(free)) < len(free):
        raise ValueError(f"free must be a tuple of different names, got {free!r}")
    for name in free:
        domain_of(gas, name)
    checked_int("replicas", replicas, 1)
    for name, given in (("max_steps", max_steps), ("num_particles", num_particles)):
        if given is not None and not (isinstance(given, int | np.integer) and given >= 1):
            raise ValueError(f"{name} must be a whole number >= 1, or None, got {given!r}")
    size, points = sum(size_of(gas, name) for name in free), curve.times.shape[-1]
    if curve.temperature_error is not None and not isinstance(curve.temperature_error, Tracer):
        points = int(np.sum(np.asarray(curve.temperature_error) > 0))
    if points <= size:
        raise ValueError(
            f"{points} points (those with an error of 0 not counted) cannot determine {size} "
            "parameters; free fewer of them"
        )


@no_type_check
def _check_model(
    model: AbstractModel, method: str, names: tuple[str, ...], priors: Priors, gas: Gas
) -> None:
    if method not in SEARCHES:
        known = " or ".join(f'"{name}"' for name in SEARCHES)
        raise ValueError(f"method must be {known}, got {method!r}")
    if isinstance(model, str):
        raise ValueError(f"model must be a jaxgran model, got {model!r}. See jaxgran.choose_model")
    checked_model(model)
    if model.stochastic and method != "levenberg-marquardt":
        raise ValueError(
            f'a stochastic model is fitted by least squares, got method="{method}". Use '
            'method="levenberg-marquardt"'
        )
    if model.stochastic and START_TIME in (*names, *priors.names):
        raise ValueError(
            f"{START_TIME} is fitted through kinetic theory only, got {type(model).__name__}. Fit "
            "it by kinetic theory, subtract it from the times, and leave it out of free and priors"
        )
    if model.stochastic and priors.names and "friction" in gas.elements:
        raise ValueError(
            f"priors with {type(model).__name__} are propagated by kinetic theory, which does not "
            "support friction. Leave priors out, or add those parameters to free"
        )
    both = [name for name in priors.names if name in names]
    if model.stochastic and both:
        raise ValueError(
            f"{both[0]} is in free and in priors, which a stochastic model does not support: "
            f"leave {both[0]} out of free (its prior then widens the errors) or out of priors"
        )
    replicas = getattr(model, "replicas", None)
    if model.stochastic and isinstance(replicas, int) and replicas < 2:
        raise ValueError(
            f"a fit through {type(model).__name__} needs replicas >= 2 to estimate its noise, got "
            f"{replicas}"
        )
    model.check_fit(names)


def _check_computed(result: Fit) -> None:
    fault = status.OK if result.curve.status is None else int(result.curve.status)
    if fault != status.OK:
        values = zip(result.names, np.asarray(result.estimate), strict=False)
        at = ", ".join(f"{name} = {value:.3g}" for name, value in values)
        raise RuntimeError(
            f"{type(result.model).__name__} could not compute the curve at {at}, where the search "
            f"ended: {status.explain(fault)}"
        )


def _warn(result: Fit) -> None:
    if result.chi2.dtype == jnp.float32:
        warnings.warn(
            "fitting in float32: relative errors below 1e-4 are round-off. Call "
            'jax.config.update("jax_enable_x64", True) first',
            stacklevel=3,
        )
    group = result.undetermined()
    if group:
        why = "it hardly depends on this parameter"
        if len(group) > 1:
            why = "it depends only on a combination of them"
        if START_TIME in group:
            why += " (a cooling gas forgets its initial temperature)"
        elif {"dissipative_constant", "youngs_modulus"} <= {*group}:
            why += " (in a gas of hard spheres A and Y enter only as A Y^(2/5))"
        warnings.warn(
            f"the curve does not determine {' and '.join(group)}: {why}. Free fewer parameters",
            stacklevel=3,
        )
    if others := describe_minima(result.names, result.degenerate_solutions()):
        warnings.warn(f"{others}: the curve does not distinguish them", stacklevel=3)


class JointFit(NamedTuple):
    """Result of a fit of several measurements with shared parameters.

    Attributes:
        estimate: estimate of each shared parameter by name, SI.
        standard_error: standard error of each shared parameter by name, SI; it includes the errors
            of all measurements and of the model's clock.
        separate: estimate and standard error of each separate parameter, SI, by the label of the
            measurement and by name.
        weight: fraction of the information on each shared parameter that a measurement
            contributes, by label and name; the fractions add up to 1.
        chi2: chi^2 of each measurement at the shared estimate, by label.
        decrease: decrease of chi^2 of each measurement if all parameters were fitted to it alone,
            to first order, by label.
        p_value: probability of so large a total decrease by chance.
        agree: True if `p_value` exceeds 1 %: the measurements do not contradict each other.
        converged: True if the search reached its tolerance.

    >>> joint = jaxgran.fit_jointly({"a": (gas, curve), "b": (gas, curve)})
    >>> f"{float(joint.estimate['dissipative_constant']):.3g}"
    '3e-06'
    """

    estimate: dict[str, Float[np.ndarray, "..."]]
    standard_error: dict[str, Float[np.ndarray, "..."]]
    separate: dict[str, dict[str, tuple[float, float]]]
    weight: dict[str, dict[str, float]]
    chi2: dict[str, float]
    decrease: dict[str, float]
    p_value: float
    agree: bool
    converged: bool


@no_type_check
def fit_jointly(
    measurements: dict[str, tuple[Gas, CoolingCurve | DropTest]],
    *,
    shared: tuple[str, ...] = ("dissipative_constant",),
    separate: tuple[str, ...] = (),
    model: AbstractModel | None = None,
) -> JointFit:
    """Estimate the parameters that several measurements of one material share.

    Minimises the sum of all chi^2. The clock of each curve is free within the accuracy of the model
    in its scene, and each curve has separate values of the parameters `separate`; the standard
    errors include both.

    Args:
        measurements: pairs by label: the gas (its diameter, packing fraction, ...) and its cooling
            curve, whose T must have errors, or a drop test of such spheres.
        shared: parameters of the gas or its law that all measurements share.
        separate: parameters with a separate value for each curve, such as "temperature" or "t0",
            the time at which cooling began (see `jaxgran.fit`).
        model: a deterministic model, by default `jaxgran.KineticTheory()`.

    Returns:
        `JointFit`.

    Raises:
        ValueError: for unknown names, a curve without errors, or a stochastic model.
        RuntimeError: if the model cannot compute a curve where the search ends.

    >>> joint = jaxgran.fit_jointly({"a": (gas, curve), "b": (gas, curve)})
    >>> sorted(joint.weight), joint.agree
    (['a', 'b'], True)
    """
    model = KineticTheory() if model is None else model
    _check_measurements(measurements, shared, separate, model)
    labels, pairs = tuple(measurements), tuple(measurements.values())
    shared, separate = tuple(shared), tuple(separate)
    accuracies = [
        jnp.zeros(())
        if isinstance(data, DropTest)
        else jnp.max(clock_accuracy(guess_from_data(gas, data, (*shared, *separate)), data, model))
        for gas, data in pairs
    ]
    flat, residuals, jacobians, converged = _search_jointly(
        pairs, shared, separate, model, accuracies
    )
    if not all(np.all(np.isfinite(part)) for part in residuals):
        raise RuntimeError("the model could not compute a curve where the joint search ended")
    return _joint_result(labels, pairs, shared, separate, flat, residuals, jacobians, converged)


def _check_measurements(measurements, shared, separate, model) -> None:
    if not isinstance(measurements, dict) or len(measurements) < 2:
        raise ValueError(
            "fit_jointly takes two or more measurements, as {'first': (gas, curve), 'second': "
            "(gas, drop_test)}. For one curve use jaxgran.fit"
        )
    check_deterministic(model, "a joint fit")
    names = (*shared, *separate)
    if not shared or len(set(names)) < len(names) or START_TIME in shared:
        raise ValueError(
            f"shared and separate must be different names, got shared = {shared}, separate = "
            f"{separate}. shared needs one name or more; each curve has its own {START_TIME}"
        )
    for label, pair in measurements.items():
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise ValueError(f"measurement {label!r} must be (gas, curve), got {pair!r:.60}")
        gas, data = pair
        checked_gas(gas)
        for name in names:
            domain_of(gas, name)
        if isinstance(data, DropTest):
            continue
        if not isinstance(data, CoolingCurve):
            raise ValueError(
                f"measurement {label!r} must hold a jaxgran.CoolingCurve or a jaxgran.DropTest, "
                f"got {type(data).__name__}"
            )
        check_curve(gas, data)
        model.check_scene(gas)
        if data.temperature_error is None:
            raise ValueError(
                f"the curve of {label!r} has no errors, which a joint fit needs as weights: give "
                "temperature_error (jaxgran.fit of this curve alone estimates its scatter)"
            )


@eqx.filter_jit
def _search_jointly(
    pairs: tuple[tuple[Gas, CoolingCurve | DropTest], ...],
    shared: tuple[str, ...],
    separate: tuple[str, ...],
    model: AbstractModel,
    clock_accuracies: list[Float[Array, ""]],
) -> tuple[Array, list[Array], list[Array], Bool[Array, ""]]:
    """Return the unknowns, and the residuals of each measurement with their Jacobians."""
    first, layout = _initial_unknowns(pairs, shared, separate)
    num_shared = first.size - sum(size for _, size in layout)

    def residuals(unknowns: Array) -> list[Array]:
        common, begin, parts = unknowns[:num_shared], num_shared, []
        for (gas, data), (names, size), accuracy in zip(
            pairs, layout, clock_accuracies, strict=True
        ):
            separate_unknowns = unknowns[begin : begin + size]
            begin += size
            if isinstance(data, DropTest):
                parts.append(data.residuals(Parameters(gas, shared).gas(common)))
                continue
            T, error = data.temperature, data.temperature_error
            curve_of_T = CoolingCurve(times=data.times, temperature=T, temperature_error=error)
            comparison = Comparison.of(gas, curve_of_T, model, (*shared, *names), None)
            clock = jnp.exp(accuracy * separate_unknowns[-1])
            flat = jnp.concatenate([common, separate_unknowns[:-1]])
            parts.append(
                jnp.concatenate([comparison.evaluate(flat, clock)[0], separate_unknowns[-1:]])
            )
        return parts

    unknowns, _, converged = least_squares(
        lambda x: jnp.concatenate(residuals(x)), first, MAX_JOINT_STEPS
    )
    return unknowns, residuals(unknowns), jax.jacfwd(residuals)(unknowns), converged


def _initial_unknowns(
    pairs: tuple[tuple[Gas, CoolingCurve | DropTest], ...],
    shared: tuple[str, ...],
    separate: tuple[str, ...],
) -> tuple[Array, list[tuple[tuple[str, ...], int]]]:
    """Return the first values of all unknowns: the shared ones, then those of each measurement.

    The list has the names of the separate parameters of each measurement, and the number of its
    unknowns including its clock.
    """
    separate_unknowns, layout, common = [], [], None
    for gas, data in pairs:
        if isinstance(data, DropTest):
            layout.append(((), 0))
            continue
        guess = guess_from_data(gas, data, (*shared, *separate))
        common = Parameters(gas, shared).flat(guess) if common is None else common
        start = guess_start_time(guess, data, (*shared, *separate))
        flat = jnp.zeros(0)
        if separate:
            flat = Parameters(gas, separate, halving_time(data)).flat(guess, start)
        separate_unknowns += [flat, jnp.zeros(1)]
        layout.append((separate, flat.size + 1))
    if common is None:  # drop tests alone: the values of the gas
        common = Parameters(pairs[0][0], shared).flat(pairs[0][0])
    return jnp.concatenate([common, *separate_unknowns]), layout


def _joint_result(
    labels, pairs, shared, separate, flat, residuals, jacobians, converged
) -> JointFit:
    gas = pairs[0][0]
    parameters = Parameters(gas, shared)
    p = parameters.flat(gas).size
    jacobians = [np.asarray(part) for part in jacobians]
    residuals = [np.asarray(part) for part in residuals]
    covariance = np.linalg.pinv(sum(part.T @ part for part in jacobians))
    scale = np.asarray(jax.jacfwd(parameters.estimates)(flat[:p]))
    errors = np.sqrt(np.diag(scale @ covariance[:p, :p] @ scale.T))
    estimates = np.asarray(parameters.estimates(flat[:p]))
    information = [_information(part, p) for part in jacobians]
    total = np.maximum(sum(np.diag(part) for part in information), 1e-300)
    decrease = [_decrease(part, r) for part, r in zip(jacobians, residuals, strict=True)]
    informative = sum(bool(np.any(np.diag(part) > 0)) for part in information)
    p_value = float(jax.scipy.stats.chi2.sf(sum(decrease), max(p * (informative - 1), 1)))
    ends = np.cumsum([size_of(gas, name) for name in shared])[:-1]

    def by_name(values):
        return dict(zip(shared, map(np.squeeze, np.split(values, ends)), strict=True))

    weights = [
        {name: float(np.mean(x)) for name, x in by_name(np.diag(part) / total).items()}
        for part in information
    ]
    return JointFit(
        estimate=by_name(estimates),
        standard_error=by_name(errors),
        separate=_separate_estimates(
            labels, pairs, separate, flat, p, np.sqrt(np.diag(covariance))
        ),
        weight=dict(zip(labels, weights, strict=True)),
        chi2={k: float(np.sum(r**2)) for k, r in zip(labels, residuals, strict=True)},
        decrease=dict(zip(labels, decrease, strict=True)),
        p_value=p_value,
        agree=p_value > SIGNIFICANCE,
        converged=bool(converged),
    )


def _separate_estimates(labels, pairs, separate, flat, begin, deviations):
    """Return the separate parameters of each curve, SI, with their errors."""
    estimates = {}
    for label, (scene, data) in zip(labels, pairs, strict=True):
        if isinstance(data, DropTest):
            continue
        size = 0
        if separate:
            parameters = Parameters(scene, separate, halving_time(data))
            size = parameters.flat(scene).size
            unknowns = flat[begin : begin + size]
            slope = np.diag(np.asarray(jax.jacfwd(parameters.estimates)(unknowns)))
            errors = np.abs(slope) * deviations[begin : begin + size]
            values = np.asarray(parameters.estimates(unknowns))
            values_and_errors = zip(values.tolist(), errors.tolist(), strict=True)
            estimates[label] = dict(zip(separate, values_and_errors, strict=True))
        begin += size + 1  # the clock
    return estimates


def _information(jacobian: Float[np.ndarray, "residuals q"], p: int) -> Float[np.ndarray, "p p"]:
    """Information of one measurement on the first p unknowns, its other unknowns being free."""
    common, others = jacobian[:, :p], jacobian[:, p:]
    others = others[:, np.any(others != 0, axis=0)]
    if others.shape[1]:
        common = common - others @ (np.linalg.pinv(others) @ common)
    return common.T @ common


def _decrease(
    jacobian: Float[np.ndarray, "residuals q"], residuals: Float[np.ndarray, "r"]
) -> float:
    """Decrease of chi^2, to first order, if all unknowns were fitted to this measurement."""
    used = jacobian[:, np.any(jacobian != 0, axis=0)]
    return float(residuals @ used @ np.linalg.pinv(used) @ residuals)
