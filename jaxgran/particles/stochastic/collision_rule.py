"""The collision rule of DSMC: which candidate pairs collide, and what a collision does."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, UInt32

from jaxgran.particles.spins import rub
from jaxgran.scene.reduced_scene import ReducedRough, ReducedScene
from jaxgran.scene.restitution import ReducedLaw


class Outcome(NamedTuple):
    """What the collisions of candidate pairs do: kicks, and sums over the collisions.

    Attributes:
        kick: change of the velocity of the first particle of each pair; that of the second is
            opposite.
        num: number of collisions.
        missed: number of collisions missed because of the ceiling of the collision rate.
        loss: decrease of sum v^2.
        memory: ``sum (1 + eps)^2 (g.n)^2 / 4``, by which D/sqrt(T) decays.
        along: tangents of -loss and of memory in the parameters of the law.
        along_speed: their tangents in the logarithm of all speeds.
        turned: increase of q sum s^2 of rough spheres.
        twist: change of the spins of both particles of each pair; None of smooth ones.
    """

    kick: Float[Array, "pairs d"]
    num: Float[Array, ""]
    missed: Float[Array, ""]
    loss: Float[Array, ""]
    memory: Float[Array, ""]
    along: Float[Array, "2 P"]
    along_speed: Float[Array, "..."]  # (2,)
    turned: Float[Array, ""] | float = 0.0
    twist: Float[Array, "pairs spins"] | None = None


def collide(
    relative: Float[Array, "pairs d"],
    bits: UInt32[Array, "2 pairs"],
    ceiling: Float[Array, ""],
    share: Float[Array, ""],
    scene: ReducedScene,
    tangents: bool,
    spin: Float[Array, "pairs spins"] | None = None,
    slowed: Float[Array, ""] | None = None,
) -> Outcome:
    """Let candidate pairs collide at a rate proportional to |g|, with normals weighted by g.n.

    Args:
        relative: g = v_i - v_j of equal masses.
        bits: random ones.
        ceiling: |g| at which a candidate collides with probability 1 in a whole step.
        share: of the step to be done.
        scene: in reduced units.
        tangents: whether the tangents are wanted.
        spin: s_i + s_j of rough spheres.
        slowed: physical velocities over these; None if they are the same.
    """
    d, dtype = relative.shape[-1], relative.dtype
    g = [relative[:, k] for k in range(d)]
    square = sum(x * x for x in g)
    speed = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    axis = [x / speed for x in g]
    # The impact parameter is uniform in a disk (an interval for d = 2), drawn from its square.
    offset = [((b >> 11).astype(dtype) + 0.5) * 2.0**-20 - 1 for b in bits[: d - 1]]
    chance = ((bits[0] & 2047) << 11 | (bits[1] & 2047)).astype(dtype) + 0.5
    sine_square = sum(b * b for b in offset)
    met = (sine_square < 1) & (square > 0)
    hit = met & (chance * 2.0**-22 * ceiling < speed * share)
    cosine = jnp.sqrt(jnp.where(met, 1 - sine_square, 1.0))
    sideways = _perpendicular(axis)
    normal_speed = jnp.where(hit, speed * cosine, ceiling)
    at_impact = normal_speed if slowed is None else normal_speed * slowed
    eps, along, along_speed = _restitution(at_impact, hit, scene.law, tangents)
    square = jnp.where(hit, normal_speed**2, 0.0)
    push = jnp.where(hit, (1 + eps) / 2 * normal_speed, 0.0)
    normal = [
        cosine * axis[k] + sum(b * e[k] for b, e in zip(offset, sideways, strict=True))
        for k in range(d)
    ]
    outcome = Outcome(
        kick=jnp.stack([-push * n for n in normal], axis=-1),
        num=jnp.sum(hit, dtype=dtype),
        missed=share * jnp.sum(jnp.where(met, jnp.maximum(speed / ceiling - 1, 0.0), 0.0)),
        loss=jnp.sum((1 - eps**2) / 2 * square),
        memory=jnp.sum((1 + eps) ** 2 / 4 * square),
        along=along,
        along_speed=along_speed,
    )
    if scene.surface is None or spin is None:
        return outcome
    return _rubbed(outcome, scene.surface, relative, spin, jnp.stack(normal, axis=-1), hit)


def _rubbed(
    outcome: Outcome,
    surface: ReducedRough,
    relative: Float[Array, "pairs d"],
    spin: Float[Array, "pairs spins"],
    normal: Float[Array, "pairs d"],
    hit: Bool[Array, "pairs"],
) -> Outcome:
    """The outcome with the tangential part of the impacts; see `jaxgran.Rough`."""
    found = rub(relative, spin, normal, hit, surface.eta, surface.inertia)
    lost = -2 * jnp.sum(found.kick * (found.sideways + found.kick))  # of translation alone
    turned = 2 * surface.inertia * jnp.sum(found.twist * (spin + found.twist))
    return outcome._replace(
        kick=outcome.kick + found.kick,
        loss=outcome.loss + lost,
        turned=turned,
        twist=found.twist,
    )


def _perpendicular(axis: list[Float[Array, "pairs"]]) -> list[list[Float[Array, "pairs"]]]:
    """Unit vectors perpendicular to unit vectors: one in a plane, two in space, as components."""
    if len(axis) == 2:
        return [[-axis[1], axis[0]]]
    x, y, z = axis
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    return [
        [1 + sign * x * x * a, sign * x * y * a, -sign * x],
        [x * y * a, sign + y * y * a, -y],
    ]


def _restitution(
    normal_speed: Float[Array, "pairs"],
    hit: Bool[Array, "pairs"],
    law: ReducedLaw,
    tangents: bool,
) -> tuple[Float[Array, "pairs"], Float[Array, "2 P"], Float[Array, "..."]]:
    """eps of each pair, and `Outcome.along` and `Outcome.along_speed` of the pairs that collide."""
    zero, along = jnp.zeros((), normal_speed.dtype), jnp.zeros((2, 0), normal_speed.dtype)

    def restitution(law, log_scale):
        return law.restitution(normal_speed * jnp.exp(log_scale))

    if not tangents:
        return restitution(law, zero), along, zero
    eps, pull = jax.vjp(restitution, law, zero)
    weights = [jnp.where(hit, x * normal_speed**2, 0.0) for x in (eps, (1 + eps) / 2)]
    in_law, along_speed = jax.vmap(pull)(jnp.stack(weights))
    if jax.tree.leaves(in_law):  # a law may have no floats
        along = jax.vmap(lambda x: ravel_pytree(x)[0])(in_law)
    return eps, along, along_speed
