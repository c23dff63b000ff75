"""Fits through a stochastic model, whose noise becomes part of the errors."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxgran.checks.tracing import any_traced
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run import Run
from jaxgran.fitting.budget import effects
from jaxgran.fitting.comparison import uses_rotation
from jaxgran.fitting.deterministic import fit_deterministic
from jaxgran.fitting.gauss_newton import Simulated, by_simulation, log_temperatures
from jaxgran.fitting.guess import guess_from_data
from jaxgran.fitting.parameters import Parameters
from jaxgran.fitting.priors import NO_PRIORS, Priors
from jaxgran.fitting.residuals import correlation_factor, neighbour_correlation
from jaxgran.fitting.result import Fit, misfit
from jaxgran.models.base import AbstractModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas


def fit_stochastic(
    gas: Gas,
    curve: CoolingCurve,
    model: AbstractModel,
    names: tuple[str, ...],
    guess: Gas | None = None,
    key: PRNGKeyArray | None = None,
    progress: bool = True,
    max_simulations: int = 8,
    priors: Priors = NO_PRIORS,
    of_errors: dict[str, Float[Array, ""]] | None = None,
) -> Fit:
    """Fit through a stochastic model, from a guess, by default the result of kinetic theory.

    Args, returns, raises: as `jaxgran.fit`; of_errors as `fit_deterministic`.
    """
    if any_traced(gas, curve, guess, model, key):
        raise ValueError(
            "a fit through a stochastic model cannot run inside jax.jit or jax.vmap: fit one curve "
            "at a time, outside"
        )
    guess = _guess_of_kinetic_theory(gas, curve, names) if guess is None else guess
    parameters = Parameters(gas, names)
    first = parameters.flat(guess)
    if not np.all(np.isfinite(first)):
        at = ", ".join(f"{name} = {guess.value(name)}" for name in names)
        raise ValueError(
            f"a fit cannot start at {at}: positive parameters are fitted in their logarithm; give "
            "a start inside their ranges, or leave it out"
        )
    model.check_scene(parameters.gas(first))
    key = jax.random.key(0) if key is None else key

    def simulate(flat, number):
        run = Run(jax.random.fold_in(key, number), progress)
        computed = model.simulate(parameters.gas(flat), curve.times, run)
        _check_replicas(model, computed)
        return computed

    rotation = uses_rotation(gas, curve)
    errors_known = curve.temperature_error is not None
    error, used = _errors_of(curve, rotation)
    found = by_simulation(
        simulate,
        np.asarray(first),
        np.asarray(log_temperatures(curve, rotation)),
        error,
        used,
        rotation=rotation,
        resolution=model.derivative_accuracy,
        max_simulations=max_simulations,
        progress=progress,
    )
    of = model, parameters, names, first, found, priors
    return _fit_of(*of, error if errors_known else None, of_errors or {})


def _errors_of(
    curve: CoolingCurve, rotation: bool
) -> tuple[Float[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
    """Relative errors of T, and of T_rot if it is used, and the points that have a weight."""
    pairs: list[tuple[Any, Any]] = [(curve.temperature, curve.temperature_error)]
    if rotation:
        pairs.append((curve.rotational_temperature, curve.rotational_temperature_error))
    values = np.concatenate([np.asarray(value) for value, _ in pairs])
    used = (np.tile(np.asarray(curve.times), len(pairs)) > 0) & (values > 0)
    if curve.temperature_error is None:
        return np.zeros_like(values), used
    errors = np.concatenate([np.asarray(error) for _, error in pairs])
    return errors / np.where(values > 0, values, 1.0), used & (errors > 0)


def _check_replicas(model: AbstractModel, computed: CoolingCurve) -> None:
    replicas = computed.replicas
    if replicas is None or len(replicas.temperature) < 2:
        raise ValueError(
            f"a fit through {type(model).__name__} needs curves with two replicas at least, whose "
            "scatter gives the noise: CoolingCurve.of_replicas makes them"
        )


def _guess_of_kinetic_theory(gas: Gas, curve: CoolingCurve, names: tuple[str, ...]) -> Gas:
    """The result of kinetic theory's fit of those parameters that it can determine."""
    found_by_theory = {"dissipative_constant", "coefficient", "temperature"}
    if uses_rotation(gas, curve):
        found_by_theory |= {"tangential_restitution", "rotational_temperature"}
    known = tuple(name for name in names if name in found_by_theory)
    if not known:
        return gas
    plain = gas
    if "friction" in gas.elements:  # which theory does not know
        plain = dataclasses.replace(gas, surface=None)
        curve = dataclasses.replace(curve, rotational_temperature=None)
        curve = dataclasses.replace(curve, rotational_temperature_error=None)
    guesses = [guess_from_data(plain, curve, known)]
    found = fit_deterministic(plain, curve, KineticTheory(), known, guesses).gas
    return gas.replace(**{name: found.value(name) for name in known})


def _fit_of(
    model: AbstractModel,
    parameters: Parameters,
    names: tuple[str, ...],
    first: Float[Array, "p"],
    found: Simulated,
    priors: Priors,
    error: Float[np.ndarray, "points"] | None,
    of_errors: dict[str, Float[Array, ""]],
) -> Fit:
    """The fit in SI units of what a search found."""
    flat, num_times = jnp.asarray(found.flat), found.computed.times.size
    own = found.residuals, found.sensitivity, found.weights
    residuals, sensitivity, weights = map(jnp.asarray, own)
    degrees_of_freedom, scatter = jnp.sum(residuals != 0) - flat.size, None
    if error is None:
        scatter = jnp.sqrt(jnp.sum(residuals**2) / degrees_of_freedom)
        residuals, sensitivity, weights = (x / scatter for x in (residuals, sensitivity, weights))
    of_T, of_rotation = residuals[:num_times], residuals[num_times:]
    used = of_T != 0
    tested = [(of_T, jnp.sum(used) - flat.size, of_errors.get("measurement"))]
    if of_rotation.size:
        tested.append((of_rotation, jnp.sum(of_rotation != 0), of_errors.get("rotation")))
    chance = misfit(tested, degrees_of_freedom, errors_known=error is not None)
    scale = jax.jacfwd(parameters.estimates)(flat)
    gain = scale @ jnp.asarray(found.gain)
    gas, rotation = parameters.gas(flat), of_rotation.size > 0
    slope, changes = effects(gas, priors, found.computed, rotation)
    shares = gain * (scatter if error is None else jnp.asarray(error)[None])
    measured = chance.inflation * _of_errors(shares, of_T, used)
    covariances = {"measurement": measured, "simulation": scale @ found.noise_covariance @ scale.T}
    covariances |= {name: gain @ x @ x.T @ gain.T for name, x in changes.items()}
    delays = -gain * slope[None]
    return Fit(
        names=names,
        model=model,
        estimate=parameters.estimates(flat),
        covariances=covariances,
        clock_error=jnp.zeros(used.shape),
        gain=gain[:, :num_times],
        clock_gain=sum(jnp.split(delays, slope.size // num_times, axis=1), start=jnp.zeros(())),
        sensitivity=sensitivity,
        beyond=scale @ jnp.asarray(found.beyond),
        start=parameters.estimates(first),
        gas=gas,
        began=jnp.zeros(()),
        priors=priors,
        curve=found.computed,
        weights=weights[:num_times],
        residuals=of_T,
        displacement_residuals=None,
        rotation_residuals=of_rotation if of_rotation.size else None,
        scatter=scatter,
        chi2=chance.chi2,
        degrees_of_freedom=degrees_of_freedom,
        reduced_chi2=chance.reduced,
        p_value=chance.p_value,
        iterations=jnp.asarray(found.num_simulations),
        converged=jnp.asarray(found.converged),
    )


def _of_errors(
    shares: Float[Array, "p points"], residuals: Float[Array, "times"], used: Bool[Array, "times"]
) -> Float[Array, "p p"]:
    """Covariance by errors of T, with that of neighbouring ones, and of T_rot, if it was used."""
    factor = correlation_factor(neighbour_correlation(residuals, used)) ** 2
    by_T, by_rotation = shares[:, : residuals.size], shares[:, residuals.size :]
    return factor * by_T @ by_T.T + by_rotation @ by_rotation.T
