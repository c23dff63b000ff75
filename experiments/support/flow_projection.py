"""Soft spheres whose tangents are also projected onto waves of the flow.

`projecting` is a context manager that replaces the projection of the package.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
from jaxtyping import Array

from experiments.support.flow_waves import Memory, columns, fit
from jaxgran.gradients.tangents import ThermalTangents
from jaxgran.particles.soft import dynamics
from jaxgran.particles.soft.dynamics import (
    initial_soft_tangents,
    peculiar_velocity,
    tangents_after_block,
)
from jaxgran.particles.soft.forces import SoftScene
from jaxgran.particles.state import State


class Carried(NamedTuple):
    """Value of the field `interval` of the tangents.

    Attributes:
        interval: interval between projections, in mean free times.
        displacement: displacement that is kept, in the form of the tangents of the positions.
    """

    interval: Array
    displacement: Array


@contextmanager
def projecting(memory: Memory) -> Iterator[None]:
    """Project the tangents of runs in the block onto a memory.

    Compiled programs do not depend on the memory: use one memory per process.
    """

    def at_start(*arguments: Any) -> ThermalTangents:
        along = initial_soft_tangents(*arguments)
        own = Carried(along.interval, jnp.zeros_like(along.position))
        return along._replace(interval=own)  # type: ignore[arg-type]

    def after_block(new: State, *more: Any) -> ThermalTangents:
        return _projected(new, more, memory)

    with (
        mock.patch.object(dynamics, "initial_soft_tangents", at_start),
        mock.patch.object(dynamics, "tangents_after_block", after_block),
    ):
        yield


def _projected(new: State, more: tuple[Any, ...], memory: Memory) -> ThermalTangents:
    """Return the tangents after a block, projected onto a memory if a projection is due."""
    along, scene = new.tangents, more[-1]
    own: Any = along.interval
    never = along._replace(interval=jnp.full((), jnp.inf))
    along = tangents_after_block(new._replace(tangents=never), *more)
    replicas = along.log_temperature.shape[1]
    velocity = peculiar_velocity(scene, new.velocity, replicas)
    warmth = jnp.mean(velocity**2)
    passed = along.elapsed * jnp.sqrt(warmth) * scene.collision_frequency
    found = jax.lax.cond(
        passed >= own.interval,
        partial(_project, scene, memory),
        lambda along, displacement, position, velocity: (along, displacement),
        *(along, own.displacement, new.position, velocity),
    )
    along, displacement = found
    return along._replace(interval=own._replace(displacement=displacement))


def _project(
    scene: SoftScene,
    memory: Memory,
    along: ThermalTangents,
    displacement: Array,
    position: Array,
    velocity: Array,
) -> tuple[ThermalTangents, Array]:
    """Return the tangents after a projection, and the displacements that they keep."""
    replicas = along.log_temperature.shape[1]

    def boxes(x: Array) -> Array:  # with the boxes first
        return jnp.moveaxis(x.reshape(*x.shape[:-2], replicas, -1, x.shape[-1]), -3, 0)

    def together(x: Array) -> Array:
        x = jnp.moveaxis(x, 0, -3)
        return x.reshape(*x.shape[:-3], -1, x.shape[-1])

    free = along.free | memory.touching
    settings = memory, scene.side, along.elapsed
    gain, flow, moved = jax.vmap(partial(_in_box, *settings))(
        boxes(position),
        boxes(velocity),
        boxes(along.velocity),
        boxes(along.position),
        boxes(displacement),
        free.reshape(replicas, -1).astype(velocity.dtype),
    )
    gain, flow, moved = gain.T, together(flow), together(moved)
    c, each = along.log_temperature, jnp.repeat(gain, len(velocity) // replicas, axis=1)
    held = along.velocity - 0.5 * each[:, :, None] * velocity
    forgotten = free[None, :, None]
    projected = along._replace(
        log_temperature=c + gain,
        clock=along.clock - 0.5 * (c + 0.5 * gain) * along.elapsed,
        position=jnp.where(forgotten, moved, along.position),
        velocity=jnp.where(forgotten, flow, held),
        elapsed=jnp.zeros_like(along.elapsed),
        thermal_elapsed=jnp.zeros_like(along.thermal_elapsed),
    )
    return projected, moved


def _in_box(
    memory: Memory,
    side: Array,
    elapsed: Array,
    position: Array,
    velocity: Array,
    rest: Array,
    moved: Array,
    displacement: Array,
    weight: Array,
) -> tuple[Array, Array, Array]:
    """Return, for one box, the gain of c, and the kept parts of velocities and positions."""
    temperature = jnp.mean(velocity**2)
    relaxation = kinetic_relaxation(len(velocity), side) / jnp.sqrt(temperature)
    kept, more = columns(memory, position, velocity, side, relaxation)
    amounts = fit(kept, rest, weight)
    flow = jnp.einsum("pa,and->pnd", amounts[:, 1:], kept[1:])
    if memory.displacement == "carried":
        moved = displacement + elapsed * flow
        more = kept[1:]
    if more is None:
        return 2 * amounts[:, 0], flow, jnp.zeros_like(rest)
    return 2 * amounts[:, 0], flow, jnp.einsum("pa,and->pnd", fit(more, moved, weight), more)


def kinetic_relaxation(num_particles: int, side: Array) -> Array:
    """Return ``eta_K / (rho T)`` of elastic hard spheres at T = 1, by Enskog's theory in 3D.

    ``eta_K = eta_0 (1 + 8 phi chi/5) / chi`` with ``eta_0 = 5 sqrt(m T/pi) / (16 sigma^2)``.
    """
    density = num_particles / side**3
    phi = jnp.pi / 6 * density
    chi = (1 - phi / 2) / (1 - phi) ** 3
    return 5 / (16 * jnp.pi**0.5) * (1 + 1.6 * phi * chi) / chi / density
