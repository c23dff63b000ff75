"""One array for the members of a batch by `jax.vmap`, if they differ only in their law.

A batched loop waits for its slowest member in each step, so a batch of spheres takes as long as its
members one after the other. Replicas of one gas share arrays and blocks or windows of time instead.
Members that differ only in the law of their impacts run as such replicas, each with its own law.
They have one start, or one for each key. Each is as accurate as when it runs alone; its numbers
agree with that run only for the first collisions.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxgran.gradients.rule import Records, Result
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.run import start_traced
from jaxgran.scene.reduced import SphereScene


def with_batch_rule(
    run: Callable[[Any, Any], Result],
    run_members: Callable[[Any, Any, Any, int], Result | None],
) -> Callable[[Any, Any], Result]:
    """Return the same run with a rule for `jax.vmap`.

    Args:
        run: a function of a scene and of all other inputs.
        run_members: the same for several members, as a function of scene and inputs, of a pair of
            the same structure, True at arrays with a first axis of members, and of the number of
            members. It returns None if they cannot share an array; then `jax.vmap` batches `run`.
    """

    @jax.custom_batching.custom_vmap
    def run_one(scene: Any, inputs: Any) -> Result:
        return run(scene, inputs)

    @run_one.def_vmap
    def run_batch(members: int, differs: Any, scene: Any, inputs: Any) -> tuple[Result, Any]:
        result = run_members(scene, inputs, tuple(differs), members)
        if result is None:
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(differs))
            result = jax.vmap(run, in_axes=axes, axis_size=members)(scene, inputs)
        return result, jax.tree.map(lambda _: True, result)

    return run_one


def differ_in_law_alone(differs: SphereScene) -> bool:
    """Return whether members of a batch, whose scene has True at what differs, can share arrays.

    The contact duration follows from the law.
    """
    material = differs.material._replace(law=None)
    others = differs._replace(material=material, contact_duration=False)
    return not any(jax.tree.leaves(others))


def with_axis_of_replicas(values: Any, differs: Any, members: int, replicas: int) -> Any:
    """Return numbers with a first axis of the replicas of all members.

    Args:
        values: numbers of the members.
        differs: the same with True at numbers that have a first axis of members.
        members: number of members.
        replicas: number of replicas of each.
    """

    def of_replicas(x: Array, has_axis: bool) -> Array:
        if has_axis:
            return jnp.repeat(x, replicas, axis=0)
        return jnp.broadcast_to(x, (members * replicas, *jnp.shape(x)))

    return jax.tree.map(of_replicas, values, differs)


def start_members(
    alone: AbstractDynamics, key: Array, key_differs: bool, members: int
) -> tuple[Any, Int[Array, ""]]:
    """Return the random start of all members in one array, and its faults.

    Args:
        alone: the motion of one member.
        key: of the random numbers, with a first axis of members if it differs between them.
        key_differs: if False, all members have the start that one of them has alone.
        members: number of members.
    """
    if not key_differs:
        start, fault = start_traced(alone, key)
        return jax.tree.map(lambda x: jnp.tile(x, (members, 1)), start), fault
    starts, faults = jax.vmap(partial(start_traced, alone))(key)
    start = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), starts)
    return start, jnp.bitwise_or.reduce(faults)


def split_members(result: Result, members: int) -> Result:
    """Return the result of one array with a first axis of members, which all have its status.

    The run had no tangents and saved nothing. Replicas are in the order of the members.
    """

    def split_records(x: Array) -> Array:
        return jnp.moveaxis(x.reshape(*x.shape[:-1], members, -1), -2, 0)

    def split_particles(x: Array) -> Array:
        return x.reshape(members, -1, *x.shape[1:])

    values = {name: split_records(x) for name, x in result.records.values.items()}
    return Result(
        Records(values, rates={}, tangents={}),
        jax.tree.map(split_particles, result.particles),
        jnp.broadcast_to(result.status, (members,)),
    )
