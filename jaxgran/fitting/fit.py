"""Fit floats of a gas to a measured cooling curve."""

import warnings
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PRNGKeyArray

from jaxgran.checks import status
from jaxgran.checks.tracing import any_traced
from jaxgran.checks.validation import no_type_check, number, whole_number
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.budget import clock_accuracy, in_scene
from jaxgran.fitting.checks import check_curve, unused_rotation
from jaxgran.fitting.deterministic import SEARCHES, fit_deterministic
from jaxgran.fitting.few_replicas import smooth_errors
from jaxgran.fitting.guess import guess_from_data, halving_time
from jaxgran.fitting.minima import minima_in_words
from jaxgran.fitting.parameters import START, domain_of, size_of
from jaxgran.fitting.priors import Priors
from jaxgran.fitting.result import Fit
from jaxgran.fitting.stochastic import fit_stochastic
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_key, checked_model
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas

WIDEST_START = 1.0
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
            so few runs leave it (`jaxgran.fitting.few_replicas.smooth_errors`).
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
    if {START, "temperature"} <= {*names} and not {START, "temperature"} & {*known.names}:
        known = known.with_one(START, 0.0, WIDEST_START * halving_time(curve))
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
            result = in_scene(result, num_particles, replicas)
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
    if model.stochastic and START in (*names, *priors.names):
        raise ValueError(
            f"{START} is fitted through kinetic theory only: find it so, subtract it from the "
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
        if START in group:
            why += " (a gas forgets how hot it began)"
        elif {"dissipative_constant", "youngs_modulus"} <= {*group}:
            why += " (in a gas of hard spheres A and Y enter as A Y^(2/5) alone)"
        warnings.warn(
            f"the curve does not determine {' and '.join(group)}: {why}; free fewer",
            stacklevel=3,
        )
    if others := minima_in_words(result.names, result.as_good()):
        warnings.warn(f"{others}: the curve does not tell them apart", stacklevel=3)
