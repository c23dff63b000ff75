"""Time steps of soft spheres together with the tangents of all particles."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles.soft import elements, steps
from jaxgran.particles.soft.candidates import Encounters
from jaxgran.particles.soft.elements import ElementWork, Moving
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.soft.steps import ContactWork
from jaxgran.tangents.thermal import ElementMaterial, ThermalTangents


class Followed(NamedTuple):
    """The members after the steps of a block.

    Attributes:
        x, v: positions and velocities.
        spin: of spheres that have some; else None.
        work: of pairs.
        more: energies by walls and drag; None where the gas has no elements.
        along: tangents of all particles; None if they are not followed.
    """

    x: Float[Array, "members d"]
    v: Float[Array, "members d"]
    spin: Float[Array, "members spins"] | None
    work: ContactWork
    more: ElementWork | None
    along: ThermalTangents | None


def follow(
    now: Moving,
    everyone: Moving,
    scene: SoftScene,
    chosen: Encounters,
    duration: Array,
    num_steps: int,
    along: ThermalTangents | None,
) -> Followed:
    """The members after the steps of a block, and the exact tangents of all particles.

    Members are stepped and their tangents pushed forward through the steps; the tangents of all
    others fly freely.

    Args:
        now: the members.
        everyone: all particles before the block.
        scene: the gas.
        chosen: the pairs that may touch, and their particles.
        duration: of the block.
        num_steps: in the block.
        along: the tangents of all particles; None if they are not followed.
    """
    take = partial(
        _taken,
        scene=scene,
        spin=now.spin,
        settings={"chosen": chosen, "duration": duration, "num_steps": num_steps},
    )
    x, v, own = now.x, now.v, (scene.alpha, scene.dissipative_constant)
    if along is None or len(along.alpha) == 0:
        (x, v), (spin, work, more) = take(x, v, *own, scene.of_elements)
        return Followed(x, v, spin, work, more, along)
    one = jnp.ones(len(chosen.a), x.dtype)
    of_members = partial(_of_members, size=len(x))
    at = x, v, scene.alpha * one, scene.dissipative_constant * one, of_members(scene.of_elements)
    rows = jax.vmap(lambda rest: rest.at[chosen.members].get(mode="fill", fill_value=0.0))
    material = (tangent[:, chosen.replica] for tangent in along.material(*own))
    further, each = ElementMaterial(), ElementMaterial()
    if along.elements is not None:
        each = along.of_elements(scene.of_elements)
        size = len(along.free) // along.log_temperature.shape[1]
        replica = jnp.minimum(chosen.members // size, along.log_temperature.shape[1] - 1)
        further = jax.vmap(of_members)(jax.tree.map(lambda x: x[:, replica], each))

    def push(*tangent):
        return jax.jvp(take, at, tangent, has_aux=True)

    (x, v), (dx, dv), (spin, work, more) = jax.vmap(push, out_axes=(None, 0, None))(
        rows(along.position), rows(along.velocity), *material, further
    )
    put = jax.vmap(lambda rest, new: rest.at[chosen.members].set(new, mode="drop"))
    if each.drag is None:
        flown, kept = along.position + duration * along.velocity, along.velocity
    else:
        flown, kept = _flown(along, everyone, scene, duration, each.drag)
    along = along._replace(position=put(flown, dx), velocity=put(kept, dv))
    return Followed(x, v, spin, work, more, along)


def _flown(
    along: ThermalTangents,
    everyone: Moving,
    scene: SoftScene,
    duration: Array,
    drag: Float[Array, "p replicas"],
) -> tuple[Array, Array]:
    """The tangents of all particles after a flight with drag, whose tangents are given."""

    def fly(x, v, rate):
        return elements.flown(scene, Moving(x, v, None), duration, rate)[0][:2]

    def push(dx, dv, change):
        each = jnp.repeat(change, len(everyone.x) // len(change))
        rate = jnp.broadcast_to(scene.of_elements.drag, each.shape)
        return jax.jvp(fly, (everyone.x, everyone.v, rate), (dx, dv, each))[1]

    return jax.vmap(push)(along.position, along.velocity, drag)


def _of_members(material: ElementMaterial, size: int) -> ElementMaterial:
    """Numbers of walls as columns, one row for each member; those of drag one for each."""

    each = jax.tree.map(lambda value: jnp.broadcast_to(value, (size,)), material)
    columns = jax.tree.map(lambda value: value[:, None], each)
    return columns._replace(drag=each.drag)


def _taken(
    x: Array,
    v: Array,
    alpha: Any,
    dissipative_constant: Any,
    material: ElementMaterial,
    scene: SoftScene,
    spin: Array | None,
    settings: dict[str, Any],
) -> tuple[tuple[Array, Array], tuple[Array | None, ContactWork, ElementWork | None]]:
    """Positions and velocities after the steps of a block; spins, and energies."""
    if scene.plain:
        x, v, work = steps.follow(
            x, v, alpha, dissipative_constant, clipped=scene.clipped, **settings
        )
        return (x, v), (None, work, None)
    now, work, more = elements.follow(
        Moving(x, v, spin), alpha, dissipative_constant, material, scene, **settings
    )
    return (now.x, now.v), (now.spin, work, more)
