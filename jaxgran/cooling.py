"""The one verb: cool a gas."""

import warnings
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike

from jaxgran import kinetics
from jaxgran.choice import Model, check_softness, choose_model
from jaxgran.curve import CoolingCurve
from jaxgran.domain import checked_times
from jaxgran.gas import Gas
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.soft_spheres import SoftSpheres


def cool(
    gas: Gas,
    times: ArrayLike | Sequence[float],
    *,
    model: Model | Literal["auto"] | None = None,
    tolerance: float | None = None,
    num_particles: int | None = None,
) -> CoolingCurve:
    """How the gas cools and spreads from its initial temperature at t = 0.

    Args:
        gas: the scene; its floats may be traced, differentiated and batched with `jax.vmap`.
        times: t, s, increasing and >= 0, shape (times,); need not start at 0.
        model: how closely to look; `jaxgran.KineticTheory()` by default. "auto" takes the cheapest
            whose estimated error is small enough; `jaxgran.choose_model` tells which, and why.
        tolerance: for "auto" only, relative error of T allowed; 0.02 by default.
        num_particles: for "auto" only, N of the gas, if known.

    Returns:
        `CoolingCurve` at those times.

    Raises:
        ValueError: for times that are negative, unsorted, not finite or not a list, a law that
            heats the gas, contacts too soft for kinetic theory, or options of "auto" with another
            model.
        RuntimeError: if the solver needs more steps than the model allows.
    """
    if not isinstance(gas, Gas):
        raise ValueError(f"gas must be a jaxgran.Gas, got {type(gas).__name__}")
    times = checked_times(times)
    model = KineticTheory() if model is None else model
    if isinstance(model, str) and model != "auto":
        raise ValueError(f'model must be a model or "auto", got {model!r}; try KineticTheory()')
    if model != "auto" and not (tolerance is None and num_particles is None):
        raise ValueError(
            'tolerance and num_particles go with model="auto"; give them to the model instead, as '
            "in SoftSpheres(num_particles), or leave them out"
        )
    # Contacts resolved in time cannot heat a gas; a law of restitution, or averages of it, can.
    if not isinstance(model, SoftSpheres):
        theory = model if isinstance(model, KineticTheory) else KineticTheory()
        first_rate, softness = _at_start(gas, theory)
        known = not isinstance(first_rate, Tracer)
        if known and theory is model and theory.softness:
            check_softness(gas, softness)
        if known and np.any(np.asarray(first_rate) < 0):
            raise ValueError(
                "the law of restitution makes this gas heat up: averaged over its impacts, eps is "
                "above 1 (a truncated series beyond its range); lower T_0 or A, or use another law"
            )
    if isinstance(model, str):
        tolerance = 0.02 if tolerance is None else tolerance
        choice = choose_model(gas, times, tolerance, num_particles)
        if choice.error > tolerance:
            warnings.warn(choice.reasons[0], stacklevel=2)
        model = choice.model
    return model.cool(gas, times)


@eqx.filter_jit
def _at_start(gas: Gas, model: KineticTheory) -> tuple[jax.Array, jax.Array]:
    """The first cooling rate, 1/s, and the factor by which soft contacts change it."""
    at_start = jnp.ones_like(gas.temperature)
    factor = kinetics.softness_factor(gas.reduced_law, at_start, gas.dimension)
    return model.cooling_rate(gas), factor
