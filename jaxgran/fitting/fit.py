"""Fit floats of a gas to a measured cooling curve.

One fit of several measurements of one material.
"""

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
from jaxgran._utils.validation import no_type_check, number, whole_number
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


class JointFit(NamedTuple):
    """Result of a fit of several measurements with shared parameters.

    Attributes:
        estimate: of each shared parameter by name, SI.
        standard_error: of each, SI, with the errors of all measurements and of the model's clock.
        separate: of each measurement by its label, its own parameters by name, and their errors.
        weight: of each measurement by its label, its share of what is known of each shared
            parameter; they add up to 1.
        chi2: of each measurement by its label, at the shared estimate.
        decrease: of each, by how much its chi^2 would fall with parameters of its own.
        p_value: probability of so large a decrease, of all together, by chance.
        agree: whether it is above 1 %: the measurements do not contradict each other.
        converged: whether the search reached its tolerance.

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
    """Estimate what several measurements of one material have in common.

    Minimises the sum of all chi^2. Every curve has a clock of its own, known within the model's
    accuracy in its scene, and its own `separate` parameters; the errors hold both.

    Args:
        measurements: by a label of each, the gas (its diameter, packing fraction, ...) and its
            cooling curve, whose T must have errors, or a drop test of such spheres.
        shared: floats of the gas or its law that all measurements share.
        separate: floats that each curve has for itself, such as "temperature", or "t0", the time
            at which it began (see `jaxgran.fit`).
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
    names = tuple(shared), tuple(separate)
    clocks = [
        jnp.zeros(())
        if isinstance(data, DropTest)
        else jnp.max(clock_accuracy(guess_from_data(gas, data, sum(names, ())), data, model))
        for gas, data in pairs
    ]
    found = _search_jointly(pairs, *names, model, clocks)
    if not all(np.all(np.isfinite(part)) for part in found[1]):
        raise RuntimeError("the model could not compute a curve where the joint search ended")
    return _result(labels, pairs, *names, *found)


def _check_measurements(measurements, shared, separate, model) -> None:
    if not isinstance(measurements, dict) or len(measurements) < 2:
        raise ValueError(
            "fit_jointly takes two or more measurements, as {'first': (gas, curve), 'second': "
            "(gas, drop_test)}; for one curve use jaxgran.fit"
        )
    check_deterministic(model, "a joint fit")
    names = (*shared, *separate)
    if not shared or len(set(names)) < len(names) or START_TIME in shared:
        raise ValueError(
            "shared and separate must be different names, and each curve has its own "
            f"{START_TIME}, got shared = {shared}, separate = {separate}"
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
                f"the curve of {label!r} has no errors, by which measurements are weighed: give "
                "temperature_error (jaxgran.fit tells the scatter of a single curve)"
            )


@eqx.filter_jit
def _search_jointly(
    pairs: tuple[tuple[Gas, CoolingCurve | DropTest], ...],
    shared: tuple[str, ...],
    separate: tuple[str, ...],
    model: AbstractModel,
    clocks: list[Float[Array, ""]],
) -> tuple[Array, list[Array], list[Array], Bool[Array, ""]]:
    """The unknowns, and each measurement's residuals and their derivatives in all unknowns."""
    first, parts = _unknowns(pairs, shared, separate)
    num_shared = first.size - sum(size for _, size in parts)

    def residuals(unknowns: Array) -> list[Array]:
        common, begin, each = unknowns[:num_shared], num_shared, []
        for (gas, data), (names, size), unsure in zip(pairs, parts, clocks, strict=True):
            own = unknowns[begin : begin + size]
            begin += size
            if isinstance(data, DropTest):
                each.append(data.residuals(Parameters(gas, shared).gas(common)))
                continue
            T, error = data.temperature, data.temperature_error
            bare = CoolingCurve(times=data.times, temperature=T, temperature_error=error)
            comparison = Comparison.of(gas, bare, model, (*shared, *names), None)
            clock = jnp.exp(unsure * own[-1])
            at = jnp.concatenate([common, own[:-1]])
            each.append(jnp.concatenate([comparison.evaluate(at, clock)[0], own[-1:]]))
        return each

    unknowns, _, converged = least_squares(
        lambda x: jnp.concatenate(residuals(x)), first, MAX_JOINT_STEPS
    )
    return unknowns, residuals(unknowns), jax.jacfwd(residuals)(unknowns), converged


def _unknowns(
    pairs: tuple[tuple[Gas, CoolingCurve | DropTest], ...],
    shared: tuple[str, ...],
    separate: tuple[str, ...],
) -> tuple[Array, list[tuple[tuple[str, ...], int]]]:
    """First values of all unknowns; of each measurement its own parameters, and how many numbers
    they are with the clock."""
    own, sizes, common = [], [], None
    for gas, data in pairs:
        if isinstance(data, DropTest):
            sizes.append(((), 0))
            continue
        guess = guess_from_data(gas, data, (*shared, *separate))
        common = Parameters(gas, shared).flat(guess) if common is None else common
        start = guess_start_time(guess, data, (*shared, *separate))
        at = jnp.zeros(0)
        if separate:
            at = Parameters(gas, separate, halving_time(data)).flat(guess, start)
        own += [at, jnp.zeros(1)]
        sizes.append((separate, at.size + 1))
    if common is None:  # drop tests alone: the gas's own values
        common = Parameters(pairs[0][0], shared).flat(pairs[0][0])
    return jnp.concatenate([common, *own]), sizes


def _result(labels, pairs, shared, separate, flat, residuals, jacobians, converged) -> JointFit:
    """The fit in words and SI units."""
    gas = pairs[0][0]
    parameters = Parameters(gas, shared)
    p = parameters.flat(gas).size
    jacobians = [np.asarray(part) for part in jacobians]
    residuals = [np.asarray(part) for part in residuals]
    covariance = np.linalg.pinv(sum(part.T @ part for part in jacobians))
    scale = np.asarray(jax.jacfwd(parameters.estimates)(flat[:p]))
    errors = np.sqrt(np.diag(scale @ covariance[:p, :p] @ scale.T))
    estimates = np.asarray(parameters.estimates(flat[:p]))
    each = [_information(part, p) for part in jacobians]
    total = np.maximum(sum(np.diag(part) for part in each), 1e-300)
    decrease = [_decrease(part, r) for part, r in zip(jacobians, residuals, strict=True)]
    informative = sum(bool(np.any(np.diag(part) > 0)) for part in each)
    p_value = float(jax.scipy.stats.chi2.sf(sum(decrease), max(p * (informative - 1), 1)))
    ends = np.cumsum([size_of(gas, name) for name in shared])[:-1]

    def named(values):
        return dict(zip(shared, map(np.squeeze, np.split(values, ends)), strict=True))

    shares = [{n: float(np.mean(x)) for n, x in named(np.diag(i) / total).items()} for i in each]
    return JointFit(
        estimate=named(estimates),
        standard_error=named(errors),
        separate=_separate_estimates(
            labels, pairs, separate, flat, p, np.sqrt(np.diag(covariance))
        ),
        weight=dict(zip(labels, shares, strict=True)),
        chi2={k: float(np.sum(r**2)) for k, r in zip(labels, residuals, strict=True)},
        decrease=dict(zip(labels, decrease, strict=True)),
        p_value=p_value,
        agree=p_value > SIGNIFICANCE,
        converged=bool(converged),
    )


def _separate_estimates(labels, pairs, separate, flat, begin, deviations):
    """The separate parameters of each curve, SI, with their errors."""
    own = {}
    for label, (scene, data) in zip(labels, pairs, strict=True):
        if isinstance(data, DropTest):
            continue
        size = 0
        if separate:
            parameters = Parameters(scene, separate, halving_time(data))
            size = parameters.flat(scene).size
            at = flat[begin : begin + size]
            slope = np.diag(np.asarray(jax.jacfwd(parameters.estimates)(at)))
            errors = np.abs(slope) * deviations[begin : begin + size]
            values = np.asarray(parameters.estimates(at))
            pairs_of = zip(values.tolist(), errors.tolist(), strict=True)
            own[label] = dict(zip(separate, pairs_of, strict=True))
        begin += size + 1  # the clock
    return own


def _information(jacobian: Float[np.ndarray, "residuals q"], p: int) -> Float[np.ndarray, "p p"]:
    """What a measurement alone tells of the first p unknowns, its own ones being unknown."""
    common, own = jacobian[:, :p], jacobian[:, p:]
    own = own[:, np.any(own != 0, axis=0)]
    if own.shape[1]:
        common = common - own @ (np.linalg.pinv(own) @ common)
    return common.T @ common


def _decrease(
    jacobian: Float[np.ndarray, "residuals q"], residuals: Float[np.ndarray, "r"]
) -> float:
    """By how much chi^2 would fall, to first order, if all unknowns were the measurement's own."""
    used = jacobian[:, np.any(jacobian != 0, axis=0)]
    return float(residuals @ used @ np.linalg.pinv(used) @ residuals)


MAX_START_SPREAD = 1.0
"""Standard error of t0, over the time in which T halves, where T_0 is free too."""


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
    """Estimate floats of a gas from its measured cooling curve.

    Minimises ``chi^2 = sum [(ln T_measured - ln T_model) / (T_err/T)]^2``, plus the same sums for
    <dr^2> and for T_rot where they are measured with a known error, over the free floats in a scale
    without bounds (the logarithm of a positive one). Points with an error of 0 (a prepared state at
    t = 0) have no weight. <dr^2> is compared to within the model's accuracy (kinetic theory in 3D:
    1.7 %), which applies both to each point and to a common factor of the diffusive part.

    A deterministic model is fitted by least squares; this works under `jax.vmap` and `jax.jit`. A
    stochastic one is fitted to T and T_rot by Gauss-Newton steps on one simulation each, beginning
    at the result of kinetic theory's fit (or at `start`). The errors then include the noise of the
    simulations, estimated from their replicas. A derivative that is biased by some per cent slows
    the search and scales the standard error by as much, but does not move the answer, which is
    where the residuals vanish.

    Args:
        gas: the scene. Its values of free parameters are not used where the data give a guess (A,
            T_0, a constant restitution); elsewhere they are the guess.
        curve: the measurement; without errors of T their relative size is taken to be the same at
            all times, and estimated from the scatter.
        model: a `jaxgran.AbstractModel`, by default `jaxgran.KineticTheory()`; a stochastic one
            needs two or more replicas.
        free: names of floats of the gas or its law, such as "temperature" (which is T_0), or
            "t0", the time at which the gas had T_0 and began to cool, where the clock was not
            started with it; by default A (or a constant restitution) and, where T has no errors,
            T_0. A gas forgets how hot it began: a free T_0 makes up for any start of the clock, and
            T_0 and t0 are not found together; where both are free, t0 is held near 0, to within the
            time in which T halves. Where t0 is free, <dr^2> is not used.
        priors: what else is known: values and standard errors of floats of the gas, SI, by name, as
            ``{"packing_fraction": (0.05, 0.002)}``, or of "density", which lets the mass vary, or
            of "t0". Each
            is Gaussian in the float's unbounded scale, and is fitted along with the free ones; the
            errors of a stochastic model are propagated with kinetic theory's derivatives.
        start: a gas whose values are a further guess. A deterministic model begins at this or at
            that from the data, whichever fits better; a stochastic model begins at this.
        num_particles: N of the measured gas, if known. It gives the error by the chance of single
            collisions and by a flow that grows in the box, and corrects a deterministic model for
            the faster cooling of few particles (give a particle model as many as were measured).
            Where <dr^2> has no error, its relative one is ``sqrt(2 / (d N))`` over the root of
            `replicas`; without either it is not used, nor is it where T has no errors, as their
            weights could not be compared.
        replicas: number of measured runs over which the curve is a mean. From 2 on its errors are
            taken for those of their scatter, which is smoothed along the curve, and as uncertain as
            so few runs leave it (`jaxgran.fitting.residuals.smooth_errors`).
        method: Levenberg-Marquardt, or L-BFGS by reverse mode (deterministic models only).
        max_steps: >= 1; most steps of Levenberg-Marquardt or evaluations of L-BFGS, 100 by default;
            most simulations of a stochastic model, 8.
        key: of the random numbers of a stochastic model. Without one it is `jax.random.key(0)`: two
            such calls return the same numbers.
        progress: show progress bars on a terminal during simulations.

    Returns:
        `Fit`; `jaxgran.diagnose` says in words what it means. Under `jax.vmap` and `jax.jit` its
        errors hold the model's ``derivative_accuracy`` for the error of the clock instead of that
        in this scene, and not the chance of few particles.

    Raises:
        ValueError: for an unknown parameter or method, a curve that cannot be one (see
            `CoolingCurve.check`), no more points with a weight than parameters, or a scene that the
            model cannot take or fit.
        RuntimeError: if the model cannot compute the curve where the search ends. Under `jax.vmap`,
            where nothing can be raised, chi2 and the errors of that fit are nan, `converged` is
            False and `curve.status` tells why.

    This docstring is long because the arguments mean different things to the two kinds of models.

    >>> result = jaxgran.fit(gas.replace(dissipative_constant=0.0), curve)
    >>> f"{float(result.estimate[0]):.3g} s"
    '3e-06 s'
    """
    names = free_by_default(gas, curve) if free is None else free
    _check_request(gas, curve, names, max_steps, num_particles, replicas)
    names, key, known = tuple(names), checked_key(key), Priors.of(gas, priors)
    if {START_TIME, "temperature"} <= {*names} and not {START_TIME, "temperature"} & {*known.names}:
        known = known.with_one(START_TIME, 0.0, MAX_START_SPREAD * halving_time(curve))
    if unused := unused_rotation(gas, curve):
        warnings.warn(unused, stacklevel=2)
    curve, of_errors = smooth_errors(curve, replicas)
    model = KineticTheory() if model is None else model
    _check_model(model, method, names, known, gas)
    if model.stochastic:
        steps = 8 if max_steps is None else max_steps
        options = key, progress, steps, known, of_errors
        result = fit_stochastic(gas, curve, model, names, start, *options)
    else:
        guesses = [guess_from_data(gas, curve, names)] + ([] if start is None else [start])
        model.check_scene(guesses[-1])
        steps = 100 if max_steps is None else max_steps
        # As arrays: other numbers share the compiled program.
        N = None if num_particles is None else number(num_particles)
        clock = None
        if known.names and not any_traced(curve, gas):  # the clock is then fitted along
            clock = clock_accuracy(guesses[0], curve, model, num_particles)
        search = N, number(replicas), method, steps, known, of_errors, clock
        result = fit_deterministic(gas, curve, model, names, guesses, *search)
    if not any_traced(result.chi2, curve, gas):
        _check_computed(result)
        _warn(result)
        if np.isfinite(result.chi2):
            result = with_scene_errors(result, num_particles, replicas)
    return result


@no_type_check
def free_by_default(gas: Gas, curve: CoolingCurve) -> tuple[str, ...]:
    """A or a constant restitution and, where the first T has an error that nobody knows, T_0."""
    check_curve(gas, curve)
    known = [name for name in ("dissipative_constant", "coefficient") if name in gas.domains]
    if not known:
        raise ValueError(
            f"the law {type(gas.law).__name__} has neither A nor a constant coefficient: say what "
            f"is free, of {', '.join(gas.domains)}"
        )
    bare = curve.temperature_error is None
    return (known[0], "temperature") if bare else (known[0],)


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
    whole_number("replicas", replicas, 1)
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
        raise ValueError(
            f"model must be a model, got {model!r}; choose_model(fit(gas, curve).gas, curve.times, "
            "num_particles=N, replicas=3).model is the one this curve needs"
        )
    checked_model(model)
    if model.stochastic and method != "levenberg-marquardt":
        raise ValueError(f"a stochastic model is fitted by least squares, not by {method!r}")
    if model.stochastic and START_TIME in (*names, *priors.names):
        raise ValueError(
            f"{START_TIME} is fitted through kinetic theory only: find it so, subtract it from the "
            f"curve's times, and leave it out of free and priors for {type(model).__name__}"
        )
    if model.stochastic and priors.names and "friction" in gas.elements:
        raise ValueError(
            "the errors of priors are propagated by kinetic theory's derivatives, which does not "
            "know friction: leave priors out, or add the parameters that they are of to free"
        )
    both = [name for name in priors.names if name in names]
    if model.stochastic and both:
        raise ValueError(
            f"a stochastic model is fitted to the curve alone: leave {both[0]} out of free, so "
            "that its prior widens the error, or out of priors"
        )
    replicas = getattr(model, "replicas", None)
    if model.stochastic and isinstance(replicas, int) and replicas < 2:
        raise ValueError(
            f"a fit through {type(model).__name__} needs replicas >= 2, whose scatter is its "
            f"noise; got {replicas}"
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
            "fitting in float32: errors below 1e-4 are noise; "
            'jax.config.update("jax_enable_x64", True) first',
            stacklevel=3,
        )
    group = result.undetermined()
    if group:
        why = "it hardly depends on it"
        if len(group) > 1:
            why = "it depends on a combination of them only"
        if START_TIME in group:
            why += " (a gas forgets how hot it began)"
        elif {"dissipative_constant", "youngs_modulus"} <= {*group}:
            why += " (in a gas of hard spheres A and Y enter as A Y^(2/5) alone)"
        warnings.warn(
            f"the curve does not determine {' and '.join(group)}: {why}; free fewer",
            stacklevel=3,
        )
    if others := describe_minima(result.names, result.degenerate_solutions()):
        warnings.warn(f"{others}: the curve does not tell them apart", stacklevel=3)
