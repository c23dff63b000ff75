"""Derivatives through a chaotic gas: exact for a while, then what the gas remembers.

Nearby trajectories of a gas part by a factor e^2 to e^5 a collision, and the exact derivative of a
run with them: after a few collisions it says nothing about the mean. But a homogeneous gas forgets
all of its microscopic state except its temperature, and a change of temperature is only a change
of clock: with velocities s times as large, forces of ``alpha s^2`` and ``A / s`` give the same
paths s times as fast. So the tangent of a state in a parameter p is kept as

- ``c = d ln T/dp``, for velocities ``(c/2) v``, with what it does to alpha and A;
- the tangent of the clock, ``-(c/2) t`` summed up, at a fixed place in the sequence of collisions;
- the exact rest, positions and velocities, which is turned into c every so often (thermal
  projection): its energy goes into c, what is not energy is forgotten. Spheres in contact wait
  for their release.

A derivative at a fixed time is then that at a fixed place plus the gas's own rate times the
tangent of the clock; rates are averaged over the last mean free times. No step is missed or counted
twice at a fixed end time, which makes this quieter than projecting at fixed times.

Instant impacts are projected one by one (`ImpactTangents`).
"""

from collections.abc import Callable
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Bool, DTypeLike, Float, Int, PRNGKeyArray

from jaxgran.restitution import ReducedLaw

MEMORY = 5.0
"""Mean free times over which the rates of cooling and of collisions are averaged."""

_DENSITY_POWER = {"displacement": -2.0, "elastic_energy": 1.0}
"""How records grow with the collision frequency at a fixed place in the sequence of collisions."""


class Rates(NamedTuple):
    """Sums that forget, by replica: what happened, over what would at rates of 1."""

    lost: Float[Array, "replicas"]
    could_lose: Float[Array, "replicas"]
    met: Float[Array, "replicas"]
    could_meet: Float[Array, "replicas"]

    @classmethod
    def none(cls, replicas: int, dtype: DTypeLike) -> "Rates":
        return cls(*[jnp.zeros(replicas, dtype)] * 4)

    def cooling(self, trend: Array) -> Array:
        """``-d ln T/dt``, given how it depends on T."""
        return _ratio(self.lost, self.could_lose) * trend

    def collision(self, temperature: Array) -> Array:
        """Collisions a particle and time, following ``T^(1/2)``."""
        return _ratio(self.met, self.could_meet) * temperature**0.5


class Tangents(NamedTuple):
    """Derivatives of the state of a gas along p directions in (alpha, A)."""

    alpha: Float[Array, "p"]
    dissipative_constant: Float[Array, "p"]
    log_temperature: Float[Array, "p replicas"]  # c
    clock: Float[Array, "p replicas"]
    position: Float[Array, "p n d"]
    velocity: Float[Array, "p n d"]  # beyond (c/2) v
    free: Bool[Array, "n"]  # not in contact
    since: Float[Array, ""]  # the last projection
    interval: Float[Array, ""]  # between projections, in mean free times
    damping: Float[Array, ""]  # q delta
    rates: Rates

    def trend(self, temperature: Array) -> Array:
        """How the cooling rate depends on T: ``T^(3/5)`` of weak dissipation, bent as that grows.

        ``T^(3/5) / (1 + q delta T^(1/10))`` has the two first terms in delta.
        """
        return temperature**0.6 / (1 + self.damping * temperature**0.1)

    def material(self, scene_alpha: ArrayLike, scene_constant: ArrayLike) -> tuple[Array, Array]:
        """Tangents of alpha and A in the gas's own clock, shapes (p, replicas)."""
        c = self.log_temperature
        alpha = self.alpha[:, None] - c * scene_alpha
        return alpha, self.dissipative_constant[:, None] + 0.5 * c * scene_constant


def at_start(
    alpha: Float[Array, "p"],
    dissipative_constant: Float[Array, "p"],
    velocity: Float[Array, "n d"],
    replicas: int,
    interval: ArrayLike,
    damping: ArrayLike,
) -> Tangents:
    """A state that does not depend on the parameters, along directions in (alpha, A).

    `interval` is that of projections, in mean free times; `damping` the ``q delta`` of the trend.
    """
    p, dtype = len(alpha), velocity.dtype
    zeros = jnp.zeros((p, replicas), dtype)
    nothing = jnp.zeros((p, *velocity.shape), dtype)
    return Tangents(
        alpha=alpha,
        dissipative_constant=dissipative_constant,
        log_temperature=zeros,
        clock=zeros,
        position=nothing,
        velocity=nothing,
        free=jnp.ones(len(velocity), bool),
        since=jnp.zeros((), dtype),
        interval=jnp.asarray(interval, dtype),
        damping=jnp.asarray(damping, dtype),
        rates=Rates.none(replicas, dtype),
    )


def projected(
    tangents: Tangents, velocity: Float[Array, "n d"], time: ArrayLike
) -> tuple[Float[Array, "p replicas"], Float[Array, "p replicas"]]:
    """c and the tangent of the clock, were the exact rest of the free spheres projected now."""
    c = tangents.log_temperature
    replicas = c.shape[1]
    v = jnp.where(tangents.free[:, None], velocity, 0.0).reshape(replicas, -1)
    rest = tangents.velocity.reshape(len(c), *v.shape)
    gain = _ratio(2 * jnp.sum(rest * v[None], -1), jnp.sum(v * v, -1)[None])
    return c + gain, tangents.clock - 0.5 * (c + 0.5 * gain) * (time - tangents.since)


def project(
    tangents: Tangents, velocity: Float[Array, "n d"], time: ArrayLike, due: ArrayLike
) -> Tangents:
    """The tangents after a thermal projection, if it is due."""
    c, clock = projected(tangents, velocity, time)
    replicas = c.shape[1]
    gain = jnp.repeat(c - tangents.log_temperature, len(velocity) // replicas, axis=1)
    forgotten = due & tangents.free[None, :, None]
    kept = tangents.velocity - 0.5 * gain[:, :, None] * velocity[None]
    held = jnp.where(due, kept, tangents.velocity)
    return tangents._replace(
        log_temperature=jnp.where(due, c, tangents.log_temperature),
        clock=jnp.where(due, clock, tangents.clock),
        position=jnp.where(forgotten, 0.0, tangents.position),
        velocity=jnp.where(forgotten, 0.0, held),
        since=jnp.where(due, time, tangents.since),
    )


def remembered(
    rates: Rates,
    lost: Float[Array, "replicas"],
    met: Float[Array, "replicas"],
    energy: Float[Array, "replicas"],
    temperature: Float[Array, "replicas"],
    trend: Float[Array, "replicas"],
    duration: ArrayLike,
    collision_frequency: ArrayLike,
) -> Rates:
    """The sums after a time in which energy was lost and collisions a particle begun."""
    passed = duration * jnp.sqrt(temperature)
    old = jnp.exp(-passed * collision_frequency / MEMORY)
    return Rates(
        lost=old * rates.lost + lost,
        could_lose=old * rates.could_lose + energy * trend * duration,
        met=old * rates.met + met,
        could_meet=old * rates.could_meet + passed,
    )


class ImpactTangents(NamedTuple):
    """Derivatives of a gas of instant impacts along p directions in its law.

    Velocities have the tangent (c/2) v and no rest: every impact is projected. At the normal speed
    g it loses ``(1 - eps^2) g^2 / 4``, so that a change of eps adds ``eps g^2 d eps / 2`` to the
    energy, with ``d eps = d eps/dp + (c/2) d eps/d ln g``.
    """

    law: ReducedLaw  # the directions, along a first axis of each leaf
    log_temperature: Float[Array, "p replicas"]  # c
    clock: Float[Array, "p replicas"]
    rates: Rates

    @classmethod
    def at_start(cls, law: ReducedLaw, replicas: int, dtype: DTypeLike) -> "ImpactTangents":
        """Of a state that does not depend on the law, along directions in it."""
        num_directions = max((len(leaf) for leaf in jax.tree.leaves(law)), default=0)
        zeros = jnp.zeros((num_directions, replicas), dtype)
        return cls(law, zeros, zeros, Rates.none(replicas, dtype))

    def gains(
        self, law: ReducedLaw, normal_speed: Float[Array, "rows"]
    ) -> Float[Array, "changes rows"]:
        """``eps g^2 d eps / 2`` of impacts along each direction, and last, in ln g."""

        def along(direction):
            return jax.jvp(lambda law: law.restitution(normal_speed), (law,), (direction,))[1]

        eps, in_speed = jax.jvp(law.restitution, (normal_speed,), (normal_speed,))
        slopes = in_speed[None]
        if len(self.log_temperature):
            slopes = jnp.concatenate([jax.vmap(along)(self.law), slopes])
        return 0.5 * (eps * normal_speed**2)[None] * slopes

    def after(
        self,
        gains: Float[Array, "changes replicas"],
        energy: Float[Array, "replicas"],
        duration: ArrayLike,
        rates: Rates,
    ) -> "ImpactTangents":
        """After impacts with a sum of gains and a mean thermal energy, by the midpoint rule."""
        c = self.log_temperature
        half = gains[-1:] / (4 * energy[None])
        new = ((1 + half) * c + gains[:-1] / energy[None]) / (1 - half)
        clock = self.clock - 0.25 * (c + new) * duration
        return self._replace(log_temperature=new, clock=clock, rates=rates)


def with_tangents(
    records: dict[str, Array],
    kept: dict[str, Array],
    rates: dict[str, Array],
    clock: Float[Array, "p replicas"],
) -> dict[str, Array]:
    """Records, and of each record x its derivatives x.rate in time and x.along the directions.

    Args:
        records: each of shape (replicas,).
        kept: derivatives along the directions at a fixed place in the sequence of collisions.
        rates: derivatives in time; both are 0 where not given.
        clock: its tangent.
    """
    extended = dict(records)
    for name, values in records.items():
        rate = rates.get(name, jnp.zeros(values.shape, clock.dtype))
        extended[f"{name}.rate"] = rate
        extended[f"{name}.along"] = kept.get(name, 0.0) - rate[None] * clock
    return extended


def _ratio(above: Array, below: Array) -> Array:
    """0 where there is nothing to divide by."""
    return jnp.where(below != 0, above / jnp.where(below != 0, below, 1.0), 0.0)


class Inputs(NamedTuple):
    """What fixes a run, in reduced units."""

    scene: Any  # with a collision_frequency
    times: Float[Array, "times"]
    start: tuple[Array, Array] | None
    key: PRNGKeyArray | None


class Outputs(NamedTuple):
    position: Float[Array, "n d"]
    velocity: Float[Array, "n d"]
    records: dict[str, Float[Array, "times ..."]]
    status: Int[Array, ""]


def differentiable(
    run: Callable[..., Outputs], material: Callable[[Any], Any]
) -> Callable[[Inputs], Outputs]:
    """A run whose derivative is thermally projected: one linear rule, for jvp and vjp alike.

    All that a gas can depend on is its material, its collision frequency and the times asked for.
    The first is followed by tangents, the others are changes of clock.

    Args:
        run: of inputs; and of `directions` in the material, a pytree like it whose leaves have the
            directions along a first axis. With these its records are those of `with_tangents`.
        material: the pytree of numbers of a scene, such as (alpha, A) or a reduced law.
    """

    @jax.custom_jvp
    def outputs(inputs: Inputs) -> Outputs:
        out = run(inputs)
        return out._replace(records={n: x for n, x in out.records.items() if "." not in n})

    @partial(outputs.defjvp, symbolic_zeros=True)
    def outputs_jvp(at: tuple[Inputs], along: tuple[Inputs]):
        (inputs,), (change,) = at, along

        def given(tangent) -> bool:
            return not isinstance(tangent, SymbolicZero)

        if any(given(leaf) for leaf in jax.tree.leaves(change.start, is_leaf=_is_zero)):
            raise ValueError(
                "the derivative in the positions and velocities of a start is lost to chaos; for "
                "a short run give SoftSpheres(projection=None), or hold the start fixed"
            )
        scene, dtype = inputs.scene, inputs.times.dtype
        numbers, structure = jax.tree.flatten(material(scene))
        changes = structure.flatten_up_to(material(change.scene))
        followed = [given(tangent) for tangent in changes]
        parts = [jnp.ravel(x) for x, yes in zip(changes, followed, strict=True) if yes]
        size = jnp.concatenate([jnp.zeros(0, dtype), *parts])
        ends = list(accumulate(len(part) for part in parts))[:-1]
        rows = iter(jnp.split(jnp.eye(len(size), dtype=dtype), ends, axis=1))
        directions = [
            next(rows).reshape(-1, *x.shape) if yes else jnp.zeros((len(size), *x.shape), dtype)
            for x, yes in zip(numbers, followed, strict=True)
        ]
        out = run(inputs, directions=structure.unflatten(directions))
        zero = jnp.zeros((), dtype)
        denser = change.scene.collision_frequency
        denser = denser / scene.collision_frequency if given(denser) else zero
        later = (change.times if given(change.times) else zero) + inputs.times * denser
        records, moved = {}, {}
        for name in [name for name in out.records if "." not in name]:
            x = records[name] = out.records[name]
            moved[name] = out.records[f"{name}.rate"] * later[:, None]
            moved[name] += _DENSITY_POWER.get(name, 0.0) * denser * x
            moved[name] += jnp.einsum("tpr,p->tr", out.records[f"{name}.along"], size)
        d = out.velocity.shape[1]
        moved["dissipated_energy"] = -0.5 * d * moved["temperature"] - moved.get(
            "elastic_energy", 0.0
        )
        return out._replace(records=records), Outputs(
            position=jnp.zeros_like(out.position),
            velocity=jnp.zeros_like(out.velocity),
            records=moved,
            status=np.zeros(out.status.shape, jax.dtypes.float0),  # type: ignore[arg-type]
        )

    return outputs


def _is_zero(leaf) -> bool:
    return isinstance(leaf, SymbolicZero)
