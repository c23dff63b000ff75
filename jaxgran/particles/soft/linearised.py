"""Time steps of soft spheres together with the tangents of all particles."""

from collections.abc import Callable
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
from jaxgran.tangents.rotation import RubbingMaterial
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
        settings={"chosen": chosen, "duration": duration, "num_steps": num_steps},
    )
    if along is None or len(along.alpha) == 0:
        own = scene.alpha, scene.dissipative_constant
        moved, energies = take(now, *own, scene.of_elements, scene.rubbing)
        return Followed(*moved, *energies, along)
    run = take, now, everyone, scene, chosen, duration, along
    moved, energies, tangents = _pushed(*run)
    rotation = along.rotation
    if rotation is not None:
        rotation = rotation._replace(spin=tangents.spin)
    along = along._replace(position=tangents.x, velocity=tangents.v, rotation=rotation)
    return Followed(*moved, *energies, along)


def _pushed(
    take: Callable[..., tuple[Moving, tuple[ContactWork, ElementWork | None]]],
    now: Moving,
    everyone: Moving,
    scene: SoftScene,
    chosen: Encounters,
    duration: Array,
    along: ThermalTangents,
) -> tuple[Moving, tuple[ContactWork, ElementWork | None], Moving]:
    """The members after a block, the energies, and the tangents of all particles."""
    one, of_members = jnp.ones(len(chosen.a), now.x.dtype), partial(_of_members, size=len(now.x))
    own = scene.alpha, scene.dissipative_constant
    at = now, *(number * one for number in own), of_members(scene.of_elements), scene.rubbing
    rows = jax.vmap(lambda rest: rest.at[chosen.members].get(mode="fill", fill_value=0.0))
    material = (tangent[:, chosen.replica] for tangent in along.material(*own))
    further, each = ElementMaterial(), ElementMaterial()
    if along.elements is not None:
        each = along.of_elements(scene.of_elements)
        size = len(along.free) // along.log_temperature.shape[1]
        replica = jnp.minimum(chosen.members // size, along.log_temperature.shape[1] - 1)
        further = jax.vmap(of_members, axis_size=len(along.alpha))(
            jax.tree.map(lambda x: x[:, replica], each)
        )

    def push(*tangent):
        return jax.jvp(take, at, tangent, has_aux=True)

    rotation = along.rotation
    tangents = Moving(along.position, along.velocity, None if rotation is None else rotation.spin)
    rubbing = None if rotation is None else rotation.directions
    moved, along_moved, energies = jax.vmap(push, out_axes=(None, 0, None))(
        jax.tree.map(rows, tangents), *material, further, rubbing
    )
    put = jax.vmap(lambda rest, new: rest.at[chosen.members].set(new, mode="drop"))
    if each.drag is None:
        flown = tangents._replace(x=along.position + duration * along.velocity)
    else:
        flown = _flown(tangents, everyone, scene, duration, each)
    return moved, energies, jax.tree.map(put, flown, along_moved)


def _flown(
    tangents: Moving, everyone: Moving, scene: SoftScene, duration: Array, each: ElementMaterial
) -> Moving:
    """The tangents of all particles after a flight with drag, whose tangents are given by replica.

    Those of the inertia do not matter: it is not in the equation of a free spin.
    """
    here = scene.of_elements

    def fly(now: Moving, drag: Array, spin_drag: Array | None) -> Moving:
        rates = ElementMaterial(drag=drag, spin_drag=spin_drag)
        return elements.flown(scene, now, duration, rates)[0]

    def push(tangent: Moving, drag: Array, spin_drag: Array | None) -> Moving:
        own = (here.drag, here.spin_drag), (drag, spin_drag)
        change = jax.tree.map(lambda x: jnp.repeat(x, len(everyone.x) // len(x)), own[1])
        rates = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(everyone.x),)), own[0])
        return jax.jvp(fly, (everyone, *rates), (tangent, *change))[1]

    return jax.vmap(push)(tangents, each.drag, each.spin_drag)


def _of_members(material: ElementMaterial, size: int) -> ElementMaterial:
    """Numbers of walls as columns, one row for each member; those of drag one for each."""

    each = jax.tree.map(lambda value: jnp.broadcast_to(value, (size,)), material)
    columns = jax.tree.map(lambda value: value[:, None], each)
    return columns._replace(drag=each.drag, spin_drag=each.spin_drag)


def _taken(
    now: Moving,
    alpha: Any,
    dissipative_constant: Any,
    material: ElementMaterial,
    rubbing: RubbingMaterial | None,
    scene: SoftScene,
    settings: dict[str, Any],
) -> tuple[Moving, tuple[ContactWork, ElementWork | None]]:
    """The members after the steps of a block; and energies."""
    own = alpha, dissipative_constant
    if scene.plain:
        x, v, work = steps.follow(now.x, now.v, *own, clipped=scene.clipped, **settings)
        return Moving(x, v, None), (work, None)
    scene = scene.with_rubbing(rubbing)
    now, work, more = elements.follow(now, *own, material, scene, **settings)
    return now, (work, more)
