"""Positions and velocities that a user gives for a run of spheres to begin with."""

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxgran.curve import Particles
from jaxgran.gas import Gas

SAME_BOX = 1e-6
"""Relative difference up to which the box of a start is that of the gas."""


class Model(Protocol):
    """What models that take a start have in common."""

    @property
    def num_particles(self) -> int: ...
    @property
    def replicas(self) -> int: ...
    @property
    def start(self) -> Particles | None: ...


def check(model: Model, gas: Gas) -> None:
    """Raises ValueError for a start of another shape, or, if that is known, of another box."""
    if model.start is None:
        return
    shape = (model.replicas, model.num_particles, gas.dimension)
    for name, values in zip(model.start._fields[:2], model.start[:2], strict=True):
        if np.shape(values) != shape:
            raise ValueError(f"start.{name} has shape {np.shape(values)}, not {shape}")
    other = of_other_box(model, gas)
    if not isinstance(other, Tracer) and bool(other):
        given, side = model.start.box_side, gas.box_side(model.num_particles)
        raise ValueError(
            f"start.box_side is {float(given / gas.diameter):.7g} diameters, the gas fills "
            f"{float(side / gas.diameter):.7g}: change packing_fraction or the start"
        )


def of_other_box(model: Model, gas: Gas) -> Bool[Array, ""]:
    """Whether there is a start whose box is not that of the gas."""
    if model.start is None:
        return jnp.array(False)
    ratio = jax.lax.stop_gradient(model.start.box_side / gas.box_side(model.num_particles))
    return ~(jnp.abs(ratio - 1) < SAME_BOX + 10 * jnp.finfo(ratio.dtype).eps)


def unit_temperature(model: Model, gas: Gas) -> Gas:
    """The gas as derivatives see it: beside a start, T_0 is a unit of speed and no more."""
    if model.start is None:
        return gas
    return gas.replace(temperature=jax.lax.stop_gradient(gas.temperature))


def reduced(
    model: Model, gas: Gas, *, differentiable: bool = False
) -> tuple[Float[Array, "n d"], Float[Array, "n d"]] | None:
    """Positions and velocities in units of the gas, replica after replica; None without a start.

    Args:
        model, gas: as given by the user.
        differentiable: whether a derivative is to see the unit of length; else the start is the
            same in diameters of any other gas.
    """
    if model.start is None:
        return None
    length = gas.diameter if differentiable else jax.lax.stop_gradient(gas.diameter)
    position = model.start.position / length
    velocity = model.start.velocity / jnp.sqrt(gas.temperature)
    return position.reshape(-1, gas.dimension), velocity.reshape(-1, gas.dimension)
