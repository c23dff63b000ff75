"""Fits through a stochastic model, whose noise becomes part of the errors."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran.checks.tracing import any_traced
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run import Run
from jaxgran.fitting.deterministic import fit_deterministic
from jaxgran.fitting.gauss_newton import Simulated, by_simulation
from jaxgran.fitting.guess import guess_from_data
from jaxgran.fitting.parameters import Parameters
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
) -> Fit:
    """Fit through a stochastic model, from a guess, by default the result of kinetic theory.

    Args, returns, raises: as `jaxgran.fit`.
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
    model.check(parameters.gas(first))
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
    return _fit_of(model, parameters, names, first, found, errors_known)


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
    errors_known: bool,
) -> Fit:
    """The fit in SI units of what a search found."""
    flat = jnp.asarray(found.flat)
    degrees_of_freedom = jnp.asarray(int(np.sum(found.residuals != 0)) - flat.size)
    parts = [(jnp.asarray(found.residuals), degrees_of_freedom)]
    chance = misfit(parts, degrees_of_freedom, errors_known=errors_known)
    scale = jax.jacfwd(parameters.estimates)(flat)
    noise = scale @ found.noise_covariance @ scale.T
    covariance = chance.inflation * (scale @ found.error_covariance @ scale.T) + noise
    return Fit(
        names=names,
        model=model,
        estimate=parameters.estimates(flat),
        standard_error=jnp.sqrt(jnp.diag(covariance)),
        model_error=jnp.zeros(flat.shape),
        covariance=covariance,
        sensitivity=jnp.asarray(found.sensitivity),
        start=parameters.estimates(first),
        gas=parameters.gas(flat),
        curve=found.computed,
        residuals=jnp.asarray(found.residuals),
        displacement_residuals=None,
        chi2=chance.chi2,
        degrees_of_freedom=degrees_of_freedom,
        reduced_chi2=chance.reduced,
        p_value=chance.p_value,
        iterations=jnp.asarray(found.num_simulations),
        converged=jnp.asarray(found.converged),
        simulation_error=jnp.sqrt(jnp.diag(noise)),
    )
