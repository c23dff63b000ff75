"""Time steps of soft spheres together with the tangents of all particles."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles.soft import steps
from jaxgran.particles.soft.candidates import Encounters
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.soft.steps import ContactWork
from jaxgran.tangents.thermal import ThermalTangents


def follow(
    x: Float[Array, "members d"],
    v: Float[Array, "members d"],
    scene: SoftScene,
    chosen: Encounters,
    duration: Array,
    num_steps: int,
    along: ThermalTangents | None,
) -> tuple[Array, Array, ContactWork, ThermalTangents | None]:
    """The members after the steps of a block, and the exact tangents of all particles.

    Members are stepped and their tangents pushed forward through the steps; the tangents of all
    others fly freely.

    Args:
        x, v: positions and velocities of the members.
        scene: the gas.
        chosen: the pairs that may touch, and their particles.
        duration: of the block.
        num_steps: in the block.
        along: the tangents of all particles; None if they are not followed.
    """
    take = partial(
        steps.follow, chosen=chosen, duration=duration, num_steps=num_steps, clipped=scene.clipped
    )
    if along is None or len(along.alpha) == 0:
        return *take(x, v, *scene.material), along
    one = jnp.ones(len(chosen.a), x.dtype)
    at = x, v, scene.alpha * one, scene.dissipative_constant * one
    rows = jax.vmap(lambda rest: rest.at[chosen.members].get(mode="fill", fill_value=0.0))
    material = (tangent[:, chosen.replica] for tangent in along.material(*scene.material))

    def push(*tangent):
        def taken(*at):
            x, v, work = take(*at)
            return (x, v), work

        return jax.jvp(taken, at, tangent, has_aux=True)

    (x, v), (dx, dv), work = jax.vmap(push, out_axes=(None, 0, None))(
        rows(along.position), rows(along.velocity), *material
    )
    put = jax.vmap(lambda rest, new: rest.at[chosen.members].set(new, mode="drop"))
    along = along._replace(
        position=put(along.position + duration * along.velocity, dx),
        velocity=put(along.velocity, dv),
    )
    return x, v, work, along
