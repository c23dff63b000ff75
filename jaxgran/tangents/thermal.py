"""Tangents of a gas of lasting contacts: exact for a while, then projected onto its temperature.

The trajectories of a gas diverge by a factor of e^2 to e^5 per collision, and the exact derivative
of a run with them: after a few collisions it says nothing about the mean. But a homogeneous gas
forgets all of its microscopic state except its temperature, and a change of temperature is only a
change of clock: with velocities s times as large, and with ``alpha s^2`` and ``A / s`` in place of
alpha and A, the particles follow the same paths s times as fast. So the tangent of a state in a
parameter p is kept in three parts:

- ``c = d ln T/dp``, which stands for velocities ``(c/2) v`` and for the corresponding changes of
  alpha and A;
- the tangent of the clock, the integral of ``-(c/2) dt``, at a fixed place in the sequence of
  collisions;
- the exact rest of the tangents of positions and velocities.

At regular intervals the rest is projected onto v (thermal projection): the energy in it is added to
c, and what is orthogonal to v is dropped. Spheres in contact are left out until they part.

The derivative at a fixed time is the derivative at a fixed place in the sequence of collisions plus
the rate of change of the gas times the tangent of the clock. The rates are averaged over the last
mean free times. This is less noisy than projecting at fixed times, since no time step is left out
or counted twice where a fixed end time moves through the steps.

In a box longer than L_c a gas remembers its flow too, and these derivatives are too large. What
else a projection may keep there is measured by ``experiments/accuracy/flow_memory.py``: nothing
that was tried is right at 100 collisions a particle, so nothing is kept; use
`jaxgran.tangents.differences`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxgran.tangents.paths import PathTangents
from jaxgran.tangents.rates import Rates, ratio
from jaxgran.tangents.rotation import RotationTangents


class ElementMaterial(NamedTuple):
    """The numbers of walls and drag, or their tangents; None is what a scene does not have.

    Attributes:
        wall_alpha, wall_constant: alpha and A of contacts with walls.
        drag: gamma.
        spin_drag: rate at which spins slow down.
    """

    wall_alpha: Any = None
    wall_constant: Any = None
    drag: Any = None
    spin_drag: Any = None

    def of_walls(self) -> tuple[Any, Any]:
        """(alpha, A) of contacts with walls."""
        return self.wall_alpha, self.wall_constant


class ThermalTangents(NamedTuple):
    """Tangents of the state of a gas along p directions in (alpha, A), and in walls and drag.

    Attributes:
        alpha, dissipative_constant: the directions.
        log_temperature: c = d ln T.
        clock: tangent of the time at a fixed place in the sequence of collisions.
        position: tangent of the positions.
        velocity: tangent of the velocities, without the part (c/2) v.
        free: whether a sphere touches no other one.
        elapsed: time since the last projection.
        own_elapsed: the integral of T^(1/2) over this time.
        interval: between projections, in mean free times.
        damping: q delta of the trend.
        rates: of the gas.
        paths: tangents of the paths of the particles, up to the last projection.
        elements: directions in walls and drag; None where the gas has neither.
        drag: gamma; None without drag.
        rotation: tangents of spins; None of spheres that do not rub.
    """

    alpha: Float[Array, "p"]
    dissipative_constant: Float[Array, "p"]
    log_temperature: Float[Array, "p replicas"]
    clock: Float[Array, "p replicas"]
    position: Float[Array, "p n d"]
    velocity: Float[Array, "p n d"]
    free: Bool[Array, "n"]
    elapsed: Float[Array, ""]
    own_elapsed: Float[Array, "replicas"]
    interval: Float[Array, ""]
    damping: Float[Array, ""]
    rates: Rates
    paths: PathTangents
    elements: ElementMaterial | None = None
    drag: Float[Array, ""] | None = None
    rotation: RotationTangents | None = None

    def cooling(self, temperature: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """``-d ln T/dt`` at a temperature, by contacts and drag."""
        by_contacts = self.rates.cooling(self.trend(temperature))
        return by_contacts if self.drag is None else by_contacts + 2 * self.drag

    def trend(self, temperature: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """Dependence of the cooling rate on T, ``T^(3/5) / (1 + q delta T^(1/10))``.

        This has the first two terms of the rate in the dissipation delta.
        """
        return temperature**0.6 / (1 + self.damping * temperature**0.1)

    def material(self, scene_alpha: ArrayLike, scene_constant: ArrayLike) -> tuple[Array, Array]:
        """Tangents of alpha and A with the change of clock by c, each of shape (p, replicas)."""
        c = self.log_temperature
        alpha = self.alpha[:, None] - c * scene_alpha
        return alpha, self.dissipative_constant[:, None] + 0.5 * c * scene_constant

    def of_elements(self, scene: ElementMaterial) -> ElementMaterial:
        """The same of walls and drag, of which gamma is in units of a rate."""
        along, c = self.elements, self.log_temperature
        assert along is not None

        def moved(direction: Any, power: float, value: Any) -> Any:
            return None if value is None else direction[:, None] + power * c * value

        return ElementMaterial(
            wall_alpha=moved(along.wall_alpha, -1.0, scene.wall_alpha),
            wall_constant=moved(along.wall_constant, 0.5, scene.wall_constant),
            drag=moved(along.drag, -0.5, scene.drag),
            spin_drag=moved(along.spin_drag, -0.5, scene.spin_drag),
        )


def at_start(
    alpha: Float[Array, "p"],
    dissipative_constant: Float[Array, "p"],
    velocity: Float[Array, "n d"],
    replicas: int,
    interval: ArrayLike,
    damping: ArrayLike,
    elements: ElementMaterial | None = None,
    drag: Float[Array, ""] | None = None,
) -> ThermalTangents:
    """The tangents of an initial state, which does not depend on the parameters.

    Args:
        alpha, dissipative_constant: the p directions in (alpha, A).
        velocity: of the state, for its shape and dtype.
        replicas: number of boxes.
        interval: between projections, in mean free times.
        damping: q delta of `ThermalTangents.trend`.
        elements, drag: as in `ThermalTangents`.
    """
    p, dtype = len(alpha), velocity.dtype
    zeros = jnp.zeros((p, replicas), dtype)
    nothing = jnp.zeros((p, *velocity.shape), dtype)
    return ThermalTangents(
        alpha=alpha,
        dissipative_constant=dissipative_constant,
        log_temperature=zeros,
        clock=zeros,
        position=nothing,
        velocity=nothing,
        free=jnp.ones(len(velocity), bool),
        elapsed=jnp.zeros((), dtype),
        own_elapsed=jnp.zeros(replicas, dtype),
        interval=jnp.asarray(interval, dtype),
        damping=jnp.asarray(damping, dtype),
        rates=Rates.none(replicas, dtype),
        paths=PathTangents.at_start(p, replicas, dtype),
        elements=elements,
        drag=drag,
    )


class Projection(NamedTuple):
    """What a projection changes.

    Attributes:
        log_temperature: c = d ln T, with the energy that the rest held.
        clock: tangent of the clock.
        paths: tangents of the paths.
    """

    log_temperature: Float[Array, "p replicas"]
    clock: Float[Array, "p replicas"]
    paths: PathTangents


def projected(tangents: ThermalTangents, velocity: Float[Array, "n d"]) -> Projection:
    """A projection now, of the spheres that touch no other one.

    Args:
        tangents: of the state.
        velocity: of the particles, in the frame in which each replica is at rest.
    """
    c = tangents.log_temperature
    replicas, d = c.shape[1], velocity.shape[1]
    each = velocity.reshape(replicas, -1)
    v = jnp.where(tangents.free[:, None], velocity, 0.0).reshape(replicas, -1)
    rest = tangents.velocity.reshape(len(c), *v.shape)
    gain = ratio(2 * jnp.sum(rest * v[None], -1), jnp.sum(v * v, -1)[None])
    heat = jnp.mean(each * each, -1)
    one = jnp.ones_like(heat)
    return Projection(
        log_temperature=c + gain,
        clock=tangents.clock - 0.5 * (c + 0.5 * gain) * tangents.elapsed,
        paths=tangents.paths.after(
            tangents.own_elapsed,
            gain,
            meeting=tangents.rates.collision(one),
            cooling=ratio(tangents.cooling(heat), jnp.sqrt(heat)),
            dimension=d,
        ),
    )


def project(
    tangents: ThermalTangents,
    velocity: Float[Array, "n d"],
    due: ArrayLike,
    spin: Float[Array, "n spins"] | None = None,
) -> ThermalTangents:
    """The tangents after a thermal projection now, or unchanged unless it is due."""
    new = projected(tangents, velocity)
    replicas = new.clock.shape[1]
    gain = new.log_temperature - tangents.log_temperature
    each_gain = jnp.repeat(gain, len(velocity) // replicas, axis=1)
    dropped = due & tangents.free[None, :, None]
    kept = tangents.velocity - 0.5 * each_gain[:, :, None] * velocity[None]
    held = jnp.where(due, kept, tangents.velocity)
    old = Projection(tangents.log_temperature, tangents.clock, tangents.paths)
    now = jax.tree.map(lambda new, old: jnp.where(due, new, old), new, old)
    rotation = tangents.rotation
    if rotation is not None and spin is not None:
        rotation = rotation.projected(spin, gain, tangents.free, due)
    return tangents._replace(
        rotation=rotation,
        **now._asdict(),
        position=jnp.where(dropped, 0.0, tangents.position),
        velocity=jnp.where(dropped, 0.0, held),
        elapsed=jnp.where(due, 0.0, tangents.elapsed),
        own_elapsed=jnp.where(due, 0.0, tangents.own_elapsed),
    )
