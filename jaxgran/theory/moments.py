"""The ordinary differential equations of the homogeneous gas: T, a_2, D, <dr^2>, collisions, T_rot.

Units as in `jaxgran.theory.averages`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.reduced_scene import ReducedScene
from jaxgran.theory import averages, elements


class Moments(NamedTuple):
    """The state of a homogeneous gas, in variables that stay of order one while T falls by decades.

    Attributes:
        log_temperature: ln(T/T_0).
        sonine: a_2.
        diffusion: D / sqrt(T/T_0), so that cooling does not shrink it.
        displacement: <dr^2>.
        collisions: per particle.
        rotation: T_rot/T of rough spheres; None of smooth ones.
    """

    log_temperature: Float[Array, "..."]
    sonine: Float[Array, "..."]
    diffusion: Float[Array, "..."]
    displacement: Float[Array, "..."]
    collisions: Float[Array, "..."]
    rotation: Float[Array, "..."] | None = None

    @classmethod
    def at_start(cls, scene: ReducedScene, like: Array) -> Float[Array, "moments"]:
        """The state at t = 0, as one array of the precision of another."""
        start = [jnp.zeros((), like.dtype)] * 5
        if scene.surface is not None:
            start.append(scene.surface.ratio.astype(like.dtype))
        return jnp.stack(start)


def velocity(
    state: Float[Array, "moments"],
    rates_of_a2: Float[Array, "3 3"],
    scene: ReducedScene,
    dimension: int,
    *,
    softness: bool,
    maxwellian: bool,
) -> Float[Array, "moments"]:
    """Time derivative of the moments.

    Args:
        state: the `Moments` as one array.
        rates_of_a2: of `jaxgran.theory.averages.averages` at this temperature.
        scene: in reduced units.
        dimension: d.
        softness: whether soft contacts slow the cooling by impacts.
        maxwellian: whether a_2 stays 0.
    """
    log_theta, a2, diffusion = state[:3]
    d = dimension
    speed = jnp.exp(log_theta / 2)
    rates = averages.Rates.of(rates_of_a2, a2)
    cooling = 2 / d * rates.cooling * speed
    relaxation = rates.relaxation * speed
    peaking = 2 * cooling * (1 + a2) - 4 / (d * (d + 2)) * rates.fourth_moment * speed
    if softness:
        cooling = cooling * averages.softness_factor(scene.law, speed, d)
    turning = []
    if any(element is not None for element in scene[1:]):
        ratio = 0.0 if scene.surface is None else state[5]
        changes = elements.changes(scene, speed, ratio, a2, d)
        cooling, relaxation = cooling + changes.cooling, relaxation + changes.relaxation
        peaking = peaking + changes.peaking
        if scene.surface is not None:
            turning = [changes.rotation + cooling * ratio]
    rate = [
        -cooling,
        jnp.zeros_like(speed) if maxwellian else peaking,
        speed / 2 - (relaxation - cooling / 2) * diffusion,
        2 * d * speed * diffusion,
        averages.collision_rate(a2, d) * speed,
    ]
    return jnp.stack(rate + turning)
