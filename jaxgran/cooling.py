"""The one verb: cool a gas."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike

from jaxgran.curve import CoolingCurve
from jaxgran.gas import Gas
from jaxgran.models.dsmc import DSMC
from jaxgran.models.hard_spheres import HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.soft_spheres import SoftSpheres

Model = KineticTheory | DSMC | HardSpheres | SoftSpheres


def cool(
    gas: Gas, times: ArrayLike | Sequence[float], *, model: Model | None = None
) -> CoolingCurve:
    """How the gas cools and spreads from its initial temperature at t = 0.

    Args:
        gas: the scene; its floats may be traced, differentiated and batched with `jax.vmap`.
        times: t, s, increasing and >= 0, shape (times,); need not start at 0.
        model: how closely to look; `jaxgran.KineticTheory()` by default.

    Returns:
        `CoolingCurve` at those times.

    Raises:
        ValueError: for times that are negative, unsorted, not finite or not a list, or a law that
            heats the gas.
        RuntimeError: if the solver needs more steps than the model allows.
    """
    if not isinstance(gas, Gas):
        raise ValueError(f"gas must be a jaxgran.Gas, got {type(gas).__name__}")
    times = _checked_times(times)
    model = KineticTheory() if model is None else model
    # Contacts resolved in time cannot heat a gas; a law of restitution, or averages of it, can.
    if not isinstance(model, SoftSpheres):
        theory = model if isinstance(model, KineticTheory) else KineticTheory()
        first_rate = _first_cooling_rate(gas, theory)
        if not isinstance(first_rate, Tracer) and np.any(np.asarray(first_rate) < 0):
            raise ValueError(
                "the law of restitution makes this gas heat up: averaged over its impacts, eps is "
                "above 1 (a truncated series beyond its range); lower T_0 or A, or use another law"
            )
    return model.cool(gas, times)


@eqx.filter_jit
def _first_cooling_rate(gas: Gas, model: KineticTheory) -> jax.Array:
    return model.cooling_rate(gas)


def _checked_times(times) -> jax.Array:
    if not isinstance(times, Tracer):
        numbers = np.asarray(times, dtype=float)
        if numbers.ndim != 1 or numbers.size == 0:
            raise ValueError(f"times must be a list of numbers, got shape {numbers.shape}")
        if not np.all(np.isfinite(numbers)) or numbers[0] < 0:
            raise ValueError(
                f"times must be finite and not negative, got {numbers.min():g} at the least; "
                "the gas starts at t = 0"
            )
        if np.any(np.diff(numbers) <= 0):
            i = int(np.argmax(np.diff(numbers) <= 0)) + 1
            raise ValueError(
                f"times must increase, got {numbers[i]:g} after {numbers[i - 1]:g}; sort them"
            )
    return jnp.asarray(times, dtype=jnp.result_type(float))
