"""The likelihood of a measured curve, for samplers."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.checks.validation import POSITIVE, no_type_check
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.checks import check_curve, check_deterministic
from jaxgran.fitting.comparison import Comparison
from jaxgran.fitting.few_replicas import smooth_errors
from jaxgran.models.base import AbstractModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas


@no_type_check
def log_likelihood(
    gas: Gas,
    curve: CoolingCurve,
    *,
    model: AbstractModel | None = None,
    clock: ArrayLike = 1.0,
    num_particles: int | None = None,
    replicas: int = 1,
) -> Float[Array, ""]:
    """Logarithm of the likelihood of a measured curve, but for a constant.

    ``-chi^2/2`` of the residuals that `jaxgran.fit` minimises, with a common factor of all <dr^2>
    integrated out. Where T has no errors, ``-(n/2) ln sum (ln T_measured - ln T_model)^2``: their
    common relative size is integrated out with the prior 1/size.

    A pure function, for `jax.jit`, `jax.vmap` and `jax.grad`; `experiments/fit/sample_posterior.py`
    samples it. Priors are the caller's to add.

    Args:
        gas: the scene, of one or of traced numbers.
        curve: the measurement.
        model: a deterministic model, by default `jaxgran.KineticTheory()`.
        clock: factor by which the times of the model are multiplied, > 0, or one for each time.
            With the prior 1 +- ``fit(...).clock_error`` it stands for the error of the model, which
            is no part of the likelihood.
        num_particles, replicas: of the measurement, as in `jaxgran.fit`.

    Returns:
        The logarithm; -inf where the model cannot compute the curve.

    Raises:
        ValueError: for a curve that cannot be one, a scene that the model cannot take, or a
            stochastic model, of which each call has other noise.

    >>> other = gas.replace(dissipative_constant=4e-6)
    >>> bool(jaxgran.log_likelihood(gas, curve) > jaxgran.log_likelihood(other, curve))
    True
    """
    model = KineticTheory() if model is None else model
    _check(gas, curve, model, clock)
    curve, _ = smooth_errors(curve, replicas)
    N = None if num_particles is None else jnp.asarray(float(num_particles))
    comparison = Comparison.of(gas, curve, model, (), N, float(replicas))
    flat = jnp.zeros(comparison.num_beside, gas.temperature.dtype)
    times_factor = jnp.broadcast_to(jnp.asarray(clock), curve.times.shape)
    residuals = comparison.evaluate(flat, times_factor)[0]
    known = jnp.sum(residuals**2)
    if flat.size:
        # Linear in the factors of T_rot and <dr^2>, whose best values are subtracted.
        slope = jax.jacfwd(lambda x: comparison.evaluate(x, times_factor)[0])(flat)
        against = slope.T @ residuals
        known = known - against @ jnp.linalg.solve(slope.T @ slope, against)
    if curve.temperature_error is None:
        value = -0.5 * curve.times.size * jnp.log(known)
    else:
        value = -0.5 * known
    return jnp.where(jnp.isnan(value), -jnp.inf, value)


@no_type_check
def _check(gas: Gas, curve: CoolingCurve, model: AbstractModel, clock: ArrayLike) -> None:
    check_curve(gas, curve)
    POSITIVE.check("clock", clock, "1 leaves the model's times as they are.")
    check_deterministic(model, "a likelihood")
    model.check_scene(gas)
