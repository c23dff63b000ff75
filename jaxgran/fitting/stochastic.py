"""Fits through a stochastic model, whose noise becomes part of the errors."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran.checks.tracing import any_traced
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run import Run
from jaxgran.fitting.budget import effects_on_temperature
from jaxgran.fitting.deterministic import fit_deterministic
from jaxgran.fitting.gauss_newton import Simulated, by_simulation
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

    T = np.asarray(curve.temperature)
    errors_known = curve.temperature_error is not None
    error = np.asarray(curve.temperature_error / T) if errors_known else np.zeros_like(T)
    used = error > 0 if errors_known else np.ones(T.shape, bool)
    found = by_simulation(
        simulate,
        np.asarray(first),
        np.log(T),
        error,
        used & (np.asarray(curve.times) > 0),
        resolution=model.derivative_accuracy,
        max_simulations=max_simulations,
        progress=progress,
    )
    degrees = (of_errors or {}).get("measurement")
    return _fit_of(model, parameters, names, first, found, priors, errors_known, degrees)


def _check_replicas(model: AbstractModel, computed: CoolingCurve) -> None:
    replicas = computed.replicas
    if replicas is None or len(replicas.temperature) < 2:
        raise ValueError(
            f"a fit through {type(model).__name__} needs curves with two replicas at least, whose "
            "scatter gives the noise: CoolingCurve.of_replicas makes them"
        )


def _guess_of_kinetic_theory(gas: Gas, curve: CoolingCurve, names: tuple[str, ...]) -> Gas:
    """The result of kinetic theory's fit of those parameters that it can determine."""
    known = tuple(n for n in names if n in ("dissipative_constant", "coefficient", "temperature"))
    if not known:
        return gas
    guesses = [guess_from_data(gas, curve, known)]
    return fit_deterministic(gas, curve, KineticTheory(), known, guesses).gas


def _fit_of(
    model: AbstractModel,
    parameters: Parameters,
    names: tuple[str, ...],
    first: Float[Array, "p"],
    found: Simulated,
    priors: Priors,
    errors_known: bool,
    of_errors: Float[Array, ""] | None,
) -> Fit:
    """The fit in SI units of what a search found."""
    flat = jnp.asarray(found.flat)
    own = found.residuals, found.sensitivity, found.weights
    residuals, sensitivity, weights = map(jnp.asarray, own)
    used, scatter = residuals != 0, None
    degrees_of_freedom = jnp.sum(used) - flat.size
    if not errors_known:
        scatter = jnp.sqrt(jnp.sum(residuals**2) / degrees_of_freedom)
        residuals, sensitivity, weights = (x / scatter for x in (residuals, sensitivity, weights))
    tested = residuals, degrees_of_freedom, of_errors
    chance = misfit([tested], degrees_of_freedom, errors_known=errors_known)
    scale = jax.jacfwd(parameters.estimates)(flat)
    gain = scale @ jnp.asarray(found.gain)
    gas = parameters.gas(flat)
    slope, changes = effects_on_temperature(gas, priors, found.computed.times)
    measured = scale @ found.error_covariance @ scale.T * (1.0 if scatter is None else scatter**2)
    factor = correlation_factor(neighbour_correlation(residuals, used)) ** 2
    moved = {name: gain @ change for name, change in changes.items()}
    covariances = {
        "measurement": chance.inflation * factor * measured,
        **{name: change @ change.T for name, change in moved.items()},
        "simulation": scale @ found.noise_covariance @ scale.T,
    }
    return Fit(
        names=names,
        model=model,
        estimate=parameters.estimates(flat),
        covariances=covariances,
        clock_error=jnp.zeros(used.shape),
        gain=gain,
        clock_gain=-gain * slope[None],
        sensitivity=sensitivity,
        beyond=scale @ jnp.asarray(found.beyond),
        start=parameters.estimates(first),
        gas=gas,
        began=jnp.zeros(()),
        priors=priors,
        curve=found.computed,
        weights=weights,
        residuals=residuals,
        displacement_residuals=None,
        rotation_residuals=None,
        scatter=scatter,
        chi2=chance.chi2,
        degrees_of_freedom=degrees_of_freedom,
        reduced_chi2=chance.reduced,
        p_value=chance.p_value,
        iterations=jnp.asarray(found.num_simulations),
        converged=jnp.asarray(found.converged),
    )
