"""Fits of a curve by the fitted law and something besides, of a given amplitude."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.fitting.least_squares import least_squares
from jaxgran.fitting.parameters import Parameters, size_of
from jaxgran.fitting.priors import Priors
from jaxgran.scene.elements import Rough
from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced_scene import reduced_scene
from jaxgran.theory.table_of_times import (
    cooling_by_elements,
    cooling_by_roughness,
    log_temperature,
    relaxed_cooling_rate,
)

MOST_STEPS = 30
"""Steps of each search."""


class Trial(NamedTuple):
    """What is added to a fitted law, each field a number or an array of one for each trial.

    Attributes:
        constant: share of the first cooling rate that is a loss of a fixed share of the energy in
            each impact, ``T^(1/2)``: constant restitution, walls, friction.
        drag: share of it that is linear drag, independent of T.
        floor: noise in T, over the last measured temperature.
        rough: 1 + beta_t of rough spheres that do not rotate at t = 0.
        delay: time after t = 0 at which the clock was started, over the first cooling time.
    """

    constant: Float[Array, "*trials"]
    drag: Float[Array, "*trials"]
    floor: Float[Array, "*trials"]
    rough: Float[Array, "*trials"]
    delay: Float[Array, "*trials"]


class Profile(NamedTuple):
    """Fits of all trials."""

    chi2: Float[Array, "trials"]
    estimate: Float[Array, "trials p"]
    error: Float[Array, "trials p"]
    residuals: Float[Array, "trials times"]


@eqx.filter_jit
def fit_trials(
    gas: Gas,
    began: Float[Array, ""],
    names: tuple[str, ...],
    times: Float[Array, "times"],
    measured: Float[Array, "times"],
    weights: Float[Array, "times"],
    modelled: Float[Array, "times"],
    ratios: Float[Array, "times"],
    trials: Trial,
    accuracy: Float[Array, ""],
    priors: Priors,
) -> Profile:
    """Fits of all trials.

    Args:
        gas, began, names: as fitted, and the free parameters.
        times, measured, weights: t, ln T and inverse relative errors; 0 where a point is not used.
        modelled, ratios: ln T and T_rot/T of the fitted model; T_rot is 0 of smooth spheres.
        trials, priors: what is added, and what else is known of the gas.
        accuracy: relative error of the model's cooling rate, of its mean and of its trend in ln T.
    """
    varied, used = (*names, *priors.also_free(names)), weights > 0
    parameters = Parameters(gas, varied, times[-1])
    lowest = jnp.min(jnp.where(used, measured, jnp.inf))
    depth = jnp.max(jnp.where(used, measured, -jnp.inf)) - lowest + 2.0

    def computed(trial: Trial, flat: Array, mean: ArrayLike, trend: ArrayLike) -> Array:
        changed = parameters.gas(flat)
        log_theta, rate = relaxed_cooling_rate(changed, depth)
        if changed.elements:
            ratio = jnp.interp(-log_theta - jnp.log(changed.temperature), -modelled, ratios)
            rate = rate + cooling_by_elements(changed, log_theta, ratio)
        unsure = accuracy.astype(rate.dtype) * (mean + trend * (2 * log_theta / depth + 1))
        rate = rate * jnp.exp(unsure)
        since = times - parameters.start(flat) + trial.delay / rate[0]
        cooled = _continued(log_theta, rate + _added(changed, trial, log_theta, rate), since)
        floor = jnp.log(jnp.maximum(trial.floor, jnp.finfo(rate.dtype).tiny))
        return jnp.logaddexp(jnp.log(changed.temperature) + cooled, floor + lowest)

    nothing = Trial(*(jnp.zeros(()) for _ in Trial._fields))
    beside = modelled - computed(nothing, parameters.flat(gas, began), 0.0, 0.0)

    def fitted(trial: Trial) -> Profile:
        def residuals(unknowns: Array) -> Array:
            flat, errors = unknowns[:-2], unknowns[-2:]
            differences = measured - beside - computed(trial, flat, *errors)
            known = priors.residuals(parameters.gas(flat), parameters.start(flat))
            return jnp.concatenate([weights * jnp.where(used, differences, 0.0), known, errors])

        first = parameters.flat(_guess(gas, names, trial), began)
        unknowns = least_squares(residuals, jnp.pad(first, (0, 2)), MOST_STEPS)[0]
        value, estimates = residuals(unknowns), parameters.estimates(unknowns[:-2])
        error = _errors(parameters, unknowns[:-2], jax.jacfwd(residuals)(unknowns))
        free = slice(sum(size_of(gas, name) for name in names))
        return Profile(jnp.sum(value**2), estimates[free], error[free], value[: times.size])

    return jax.lax.map(fitted, trials)  # a batch of searches takes twice as long to compile


def _added(
    gas: Gas, trial: Trial, log_theta: Float[Array, "table"], rate: Float[Array, "table"]
) -> Float[Array, "table"]:
    """What a trial adds to the cooling rate of a gas."""
    added = trial.constant * jnp.exp(log_theta / 2) + trial.drag
    added = added / (1 - trial.constant - trial.drag) * rate[0]
    if gas.surface is None:
        added = added + cooling_by_roughness(_roughened(gas, trial), log_theta, rate + added)
    return added


def _roughened(gas: Gas, trial: Trial) -> Gas:
    return dataclasses.replace(gas, surface=Rough(trial.rough - 1))


def _continued(
    log_theta: Float[Array, "table"], rate: Float[Array, "table"], times: Float[Array, "times"]
) -> Float[Array, "times"]:
    """ln(T/T_0) of a table of cooling rates; before t = 0 at the first rate."""
    cooled = log_temperature(log_theta, rate, jnp.maximum(times, 0.0))
    return cooled - rate[0] * jnp.minimum(times, 0.0)


def _errors(
    parameters: Parameters, flat: Float[Array, "q"], jacobian: Float[Array, "residuals unknowns"]
) -> Float[Array, "q"]:
    """Standard errors, SI, of parameters that are the first of all unknowns."""
    slope = jnp.pad(jax.jacfwd(parameters.estimates)(flat), ((0, 0), (0, 2)))
    covariance = slope @ jnp.linalg.pinv(jacobian.T @ jacobian) @ slope.T
    return jnp.sqrt(jnp.maximum(jnp.diag(covariance), 0.0))


def _guess(gas: Gas, names: tuple[str, ...], trial: Trial) -> Gas:
    """The gas whose first cooling rate, with what is added, is about that of the fitted one."""
    if "dissipative_constant" not in names:
        return gas
    share = 1 - trial.constant - trial.drag
    if gas.surface is None:
        loss = 1 - gas.reduced_law.restitution(jnp.ones_like(gas.temperature)) ** 2
        surface = reduced_scene(_roughened(gas, trial)).surface
        assert surface is not None
        share = share / (1 + 4 * surface.eta * (1 - surface.eta) / loss)
    return gas.replace(dissipative_constant=gas.value("dissipative_constant") * share)
