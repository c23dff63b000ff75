"""Fit floats of a gas to a measured cooling curve."""

import dataclasses
import warnings
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from jaxgran import status
from jaxgran.cooling import Model
from jaxgran.curve import CoolingCurve
from jaxgran.estimate import Fit, Parameters, misfit
from jaxgran.gas import Gas
from jaxgran.models.dsmc import DSMC
from jaxgran.models.hard_spheres import HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.soft_spheres import SoftSpheres
from jaxgran.search import by_simulation, least_squares, quasi_newton
from jaxgran.start import start_from_data


def fit(
    gas: Gas,
    curve: CoolingCurve,
    *,
    model: Model | None = None,
    free: tuple[str, ...] = ("dissipative_constant",),
    start: Gas | None = None,
    num_particles: int | None = None,
    method: Literal["levenberg-marquardt", "lbfgs"] = "levenberg-marquardt",
    max_steps: int | None = None,
) -> Fit:
    """Find the floats of a gas that make its cooling curve the measured one.

    Minimises ``chi^2 = sum [(ln T_measured - ln T_model) / (T_err/T)]^2``, and with <dr^2> where
    the curve has it and its error is known, over the free floats in a scale without bounds
    (logarithms of positive ones). Points whose error is 0 (a prepared state at t = 0) carry no
    weight. <dr^2> is compared to within the accuracy of kinetic theory (1.7 % in 3D), both point by
    point and as a common factor of its diffusive part. Works under `jax.vmap` and `jax.jit`.

    Through a particle model the same is done by Gauss-Newton steps on its projected tangents, one
    run a step, with T alone, from where kinetic theory's fit ends (or from `start`). Errors then
    hold the simulation's own noise too, told by its replicas. Projection may bias a derivative by
    some per cent: that slows the search and tilts the error bar, but the answer is where the
    residuals vanish, which it does not move.

    Args:
        gas: the scene; its values of free parameters are not looked at where the data can start
            the search (A, T_0, a constant restitution), and start it where they cannot.
        curve: what was measured; relative errors of T are taken equal and their size from the
            scatter if it carries none.
        model: `jaxgran.KineticTheory()` by default; or a particle model with two or more replicas.
        free: names of floats of the gas or its law, such as "temperature" (which is T_0).
        start: begin at the values of this gas, unless those from the data fit better.
        num_particles: over how many particles <dr^2> is a mean; gives its error,
            ``sqrt(2 / (d N))``, where the curve has none; without either <dr^2> is not used, nor
            where T has no errors beside which to weigh it, nor by particle models.
        method: Levenberg-Marquardt of optimistix, or the quasi-Newton of optax by reverse mode
            (kinetic theory only).
        max_steps: the most iterations, >= 1, 100 by default; the most runs of a particle model, 8.

    Returns:
        `Fit`; `jaxgran.diagnose` says in words what it means.

    Raises:
        ValueError: for an unknown parameter or method, a curve that cannot be one (see
            `CoolingCurve.check`), no more points with a weight than parameters, or a particle model
            that keeps a checkpoint.
        RuntimeError: if the model cannot compute the curve where the search ends. Under `jax.vmap`,
            where nothing can be raised, chi2 and the errors of that fit are nan, `converged` is
            False and `curve.status` tells why.
    """
    curve.check()
    if isinstance(free, str) or not free or len(set(free)) < len(free):
        raise ValueError(f"free must be a tuple of different names, got {free!r}")
    for name in free:
        gas.value(name)
    if method not in ("levenberg-marquardt", "lbfgs"):
        raise ValueError(f'method must be "levenberg-marquardt" or "lbfgs", got {method!r}')
    for name, number in (("max_steps", max_steps), ("num_particles", num_particles)):
        if number is not None and not (isinstance(number, int | np.integer) and number >= 1):
            raise ValueError(f"{name} must be a whole number >= 1, or None, got {number!r}")
    size, points = sum(gas.value(name).size for name in free), curve.times.shape[-1]
    if curve.temperature_error is not None and not isinstance(curve.temperature_error, Tracer):
        points = int(np.sum(np.asarray(curve.temperature_error) > 0))
    if points <= size:
        raise ValueError(
            f"{points} points (those with an error of 0 not counted) cannot fix {size} parameters; "
            "free fewer of them"
        )
    model = KineticTheory() if model is None else model
    if isinstance(model, str):
        raise ValueError(
            f"model must be a model, got {model!r}; choose_model(fit(gas, curve).gas, curve.times, "
            "num_particles=N, replicas=3).model is the one this curve needs"
        )
    if isinstance(model, KineticTheory):
        starts = [start_from_data(gas, curve, free)] + ([] if start is None else [start])
        steps = 100 if max_steps is None else max_steps
        result = _fit(gas, curve, model, tuple(free), starts, num_particles, method, steps)
    else:
        steps = 8 if max_steps is None else max_steps
        result = _fit_by_simulation(gas, curve, model, tuple(free), start, method, steps)
    if not isinstance(result.chi2, Tracer):
        _check_computed(result)
        if result.chi2.dtype == jnp.float32:
            warnings.warn(
                "fitting in float32: errors below 1e-4 are noise; "
                'jax.config.update("jax_enable_x64", True) first',
                stacklevel=2,
            )
        group = result.undetermined()
        if group:
            warnings.warn(
                f"the curve does not determine {' and '.join(group)}: only some combination of "
                "them shows in it (in a hard gas A and Y enter as A Y^(2/5) alone); free fewer",
                stacklevel=2,
            )
    return result


def _check_computed(result: Fit) -> None:
    fault = status.OK if result.curve.status is None else int(result.curve.status)
    if fault != status.OK:
        values = zip(result.names, np.asarray(result.estimate), strict=False)
        at = ", ".join(f"{name} = {value:.3g}" for name, value in values)
        raise RuntimeError(
            f"{result.model} could not compute the curve at {at}, where the search ended: "
            f"{status.explain(fault)}"
        )


def _weights(values: Array, error: Array) -> Array:
    """One over the relative error; 0 where the error is 0, a value that was set, not measured."""
    known = (values > 0) & (error > 0)
    return jnp.where(known, values / jnp.where(known, error, 1.0), 0.0)


def _log_ratio(measured: Array, computed: Array) -> Array:
    # Not `computed > 0`: a curve that could not be computed, nan, must not pass for a perfect fit.
    positive = (measured > 0) & ~(computed <= 0)
    safe = jnp.where(positive, measured, 1.0), jnp.where(positive, computed, 1.0)
    return jnp.log(safe[0]) - jnp.log(safe[1])


@eqx.filter_jit
def _fit(gas, curve, model, names, starts, num_particles, method, max_steps) -> Fit:
    parameters = Parameters(gas, names)
    candidates = jnp.stack([parameters.flat(start) for start in starts])
    use_displacement = (
        curve.displacement is not None
        and curve.temperature_error is not None
        and (curve.displacement_error is not None or num_particles is not None)
    )
    equal_errors = curve.temperature
    weights = [
        _weights(
            curve.temperature,
            equal_errors if curve.temperature_error is None else curve.temperature_error,
        )
    ]
    if use_displacement:
        assert curve.displacement is not None
        accuracy = model.displacement_accuracy(gas)
        sampling = (2 / (gas.dimension * (num_particles or 1))) ** 0.5 * curve.displacement
        error = sampling if curve.displacement_error is None else curve.displacement_error
        error = jnp.where(error > 0, jnp.hypot(error, accuracy * curve.displacement), 0.0)
        weights.append(_weights(curve.displacement, error))
        candidates = jnp.pad(candidates, ((0, 0), (0, 1)))  # ln of the common factor of D
    num_free = candidates.shape[1] - use_displacement

    def estimates(flat):
        return parameters.estimates(flat[:num_free])

    def compare(flat, clock=1.0):
        computed = model.cool(parameters.gas(flat[:num_free]), curve.times * clock)
        parts = [weights[0] * _log_ratio(curve.temperature, computed.temperature)]
        if use_displacement:
            # D may be off by a common factor; ballistic flight, before collisions, is not.
            diffusive = computed.collisions / (1 + computed.collisions)
            ratio = _log_ratio(curve.displacement, computed.displacement) - flat[-1] * diffusive
            parts += [weights[1] * ratio, flat[-1:] / accuracy]
        residuals = jnp.concatenate(parts)
        return residuals, (residuals, computed)

    def residuals(flat):
        return compare(flat)[0]

    flat_first = candidates[0]
    if len(starts) > 1:
        costs = jnp.stack([jnp.sum(residuals(candidate) ** 2) for candidate in candidates])
        flat_first = candidates[jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))]
    search = least_squares if method == "levenberg-marquardt" else quasi_newton
    flat, iterations, converged = search(residuals, flat_first, max_steps)

    derivatives = jax.jacfwd(compare, argnums=(0, 1), has_aux=True)
    (jacobian, clock_slope), (all_residuals, computed) = derivatives(flat, jnp.ones(()))
    num_used = jnp.sum(jnp.concatenate(weights) > 0) + int(use_displacement)
    degrees_of_freedom = num_used - flat.size
    errors_known = curve.temperature_error is not None
    chance = misfit(all_residuals, degrees_of_freedom, errors_known=errors_known)
    converged = converged & jnp.isfinite(chance.chi2)
    _, singular, rotation = jnp.linalg.svd(jacobian, full_matrices=False)
    spread = rotation.T / jnp.maximum(singular, jnp.finfo(flat.dtype).tiny ** 0.5)[None]
    root = jax.jacfwd(estimates)(flat) @ spread
    covariance = chance.inflation * root @ root.T
    model_error = model.accuracy * jnp.abs(root @ (spread.T @ (jacobian.T @ clock_slope)))
    num_times = curve.times.size
    return Fit(
        names=names,
        model=type(model).__name__,
        accuracy=model.accuracy,
        estimate=estimates(flat),
        standard_error=jnp.sqrt(jnp.diag(covariance)),
        model_error=model_error,
        covariance=covariance,
        sensitivity=jacobian[:, :num_free],
        start=estimates(flat_first),
        gas=parameters.gas(flat[:num_free]),
        curve=computed,
        residuals=all_residuals[:num_times],
        displacement_residuals=all_residuals[num_times:-1] if use_displacement else None,
        chi2=chance.chi2,
        degrees_of_freedom=degrees_of_freedom,
        reduced_chi2=chance.reduced,
        p_value=chance.p_value,
        iterations=iterations,
        converged=converged,
    )


def _fit_by_simulation(
    gas: Gas,
    curve: CoolingCurve,
    model: DSMC | HardSpheres | SoftSpheres,
    names: tuple[str, ...],
    start: Gas | None,
    method: str,
    max_runs: int,
) -> Fit:
    if method != "levenberg-marquardt":
        raise ValueError(f"a particle model is fitted by least squares, not by {method!r}")
    if model.replicas < 2:
        raise ValueError(
            f"a fit through {type(model).__name__} needs replicas >= 2, whose scatter is its "
            f"noise; got {model.replicas}"
        )
    if isinstance(model, SoftSpheres) and model.projection is None:
        raise ValueError("a fit needs projected derivatives: give SoftSpheres a projection")
    fixed = [name for name in ("temperature", "diameter", "packing_fraction") if name in names]
    if not isinstance(model, DSMC) and model.start is not None and fixed:
        raise ValueError(
            f"{' and '.join(fixed)} cannot be fitted from a given start, which has its own: leave "
            f"start out of {type(model).__name__}, or free other parameters"
        )
    if model.checkpoint is not None:
        raise ValueError(
            f"a fit makes many runs and a checkpoint is of one: {type(model).__name__} must have "
            f"checkpoint=None here, got {str(model.checkpoint)!r}"
        )
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((gas, curve, start))):
        raise ValueError(
            "a fit through particles cannot run inside jax.jit or jax.vmap: fit one curve at a time"
        )
    start = _kinetic_start(gas, curve, names) if start is None else start
    parameters = Parameters(gas, names)
    first, estimates = parameters.flat(start), parameters.estimates
    if not np.all(np.isfinite(first)):
        at = ", ".join(f"{name} = {start.value(name)}" for name in names)
        raise ValueError(
            f"a fit cannot start at {at}: positive parameters are fitted in their logarithm; give "
            "a start inside their ranges, or leave it out"
        )
    key = jax.random.key(0) if model.key is None else model.key

    def simulate(flat, run):
        fresh = dataclasses.replace(model, key=jax.random.fold_in(key, run))
        return fresh.cool(parameters.gas(flat), curve.times)

    T = np.asarray(curve.temperature)
    error = np.zeros_like(T) if curve.temperature_error is None else curve.temperature_error / T
    used = np.ones(T.shape, bool) if curve.temperature_error is None else np.asarray(error) > 0
    found = by_simulation(
        simulate,
        np.asarray(first),
        np.log(T),
        np.asarray(error),
        used & (np.asarray(curve.times) > 0),
        resolution=model.accuracy,
        max_runs=max_runs,
        progress=model.progress,
    )
    flat = jnp.asarray(found.flat)
    degrees_of_freedom = int(np.sum(found.residuals != 0)) - flat.size
    errors_known = curve.temperature_error is not None
    chance = misfit(found.residuals, degrees_of_freedom, errors_known=errors_known)
    scale = jax.jacfwd(estimates)(flat)
    noise = scale @ found.noise_covariance @ scale.T
    covariance = chance.inflation * (scale @ found.error_covariance @ scale.T) + noise
    return Fit(
        names=names,
        model=type(model).__name__,
        accuracy=model.accuracy,
        estimate=estimates(flat),
        standard_error=jnp.sqrt(jnp.diag(covariance)),
        model_error=jnp.zeros(flat.shape),
        covariance=covariance,
        sensitivity=jnp.asarray(found.sensitivity),
        start=estimates(first),
        gas=parameters.gas(flat),
        curve=found.computed,
        residuals=jnp.asarray(found.residuals),
        displacement_residuals=None,
        chi2=chance.chi2,
        degrees_of_freedom=jnp.asarray(degrees_of_freedom),
        reduced_chi2=chance.reduced,
        p_value=chance.p_value,
        iterations=jnp.asarray(found.num_runs),
        converged=jnp.asarray(found.converged),
        simulation_error=jnp.sqrt(jnp.diag(noise)),
    )


def _kinetic_start(gas: Gas, curve: CoolingCurve, names: tuple[str, ...]) -> Gas:
    """Where kinetic theory's fit ends, of those parameters it can tell apart."""
    known = tuple(n for n in names if n in ("dissipative_constant", "coefficient", "temperature"))
    if not known:
        return gas
    starts = [start_from_data(gas, curve, known)]
    return _fit(gas, curve, KineticTheory(), known, starts, None, "levenberg-marquardt", 100).gas
