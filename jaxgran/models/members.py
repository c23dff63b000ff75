"""Members that differ only in their law run as replicas of one array, each with its own law.

A loop that `jax.vmap` batches waits for its slowest member in each step, so a batch of spheres
takes as long as its members one after the other. Replicas share blocks or windows of time instead.

Members have one start, or one for each key. Each is as accurate as when it runs alone; its numbers
agree with that run only for the first collisions. A fault of one member fails all of them.

Here `differs` is a tree of the structure of the inputs that it describes, True at arrays with a
first axis of members.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxgran.gradients.rule import Records, Result
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.run import start_traced
from jaxgran.scene.reduced import SphereScene

Scene = TypeVar("Scene")
Inputs = TypeVar("Inputs")


def with_batch_rule(
    run: Callable[[Scene, Inputs], Result],
    run_members: Callable[[Scene, Inputs, tuple[Scene, Inputs], int], Result | None],
) -> Callable[[Scene, Inputs], Result]:
    """Return the same run with a rule for `jax.vmap`.

    Args:
        run: a function of a scene and of all other inputs.
        run_members: the same for several members, as a function of scene and inputs, of how both
            differ, and of the number of members. It returns None if they cannot share an array;
            then `jax.vmap` batches `run`.
    """

    @jax.custom_batching.custom_vmap
    def run_one(scene: Scene, inputs: Inputs) -> Result:
        return run(scene, inputs)

    @run_one.def_vmap
    def run_batch(
        num_members: int, differs: Any, scene: Scene, inputs: Inputs
    ) -> tuple[Result, Any]:
        differs = tuple(differs)  # a list from custom_vmap, but the inputs are a tuple
        result = run_members(scene, inputs, differs, num_members)
        if result is None:
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, differs)
            result = jax.vmap(run, in_axes=axes, axis_size=num_members)(scene, inputs)
        return result, jax.tree.map(lambda _: True, result)

    return run_one


def differ_in_law_alone(differs: SphereScene) -> bool:
    """Return whether members with these scenes can share an array.

    The contact duration may differ, as it follows from the law.
    """
    # No leaf is left of the law, and False of the contact duration.
    material = differs.material._replace(law=None)
    others = differs._replace(material=material, contact_duration=False)
    return not any(jax.tree.leaves(others))


def with_axis_of_replicas(values: Any, differs: Any, num_members: int, replicas: int) -> Any:
    """Return numbers of the members with a first axis of the replicas of all members.

    `replicas` is the number of replicas of each member.
    """

    def of_replicas(x: Array, has_axis: bool) -> Array:
        if has_axis:
            return jnp.repeat(x, replicas, axis=0)
        return jnp.broadcast_to(x, (num_members * replicas, *jnp.shape(x)))

    return jax.tree.map(of_replicas, values, differs)


def start_members(
    alone: AbstractDynamics, key: Array, key_differs: bool, num_members: int
) -> tuple[Any, Int[Array, ""]]:
    """Return the random start of all members in one array, and its faults.

    Args:
        alone: the motion of one member.
        key: of the random numbers, with a first axis of members if it differs between them.
        key_differs: if False, all members have the start that one of them has alone.
        num_members: number of members.
    """
    if not key_differs:
        start, fault = start_traced(alone, key)
        return jax.tree.map(lambda x: jnp.tile(x, (num_members, 1)), start), fault
    starts, faults = jax.vmap(partial(start_traced, alone))(key)
    start = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), starts)
    return start, jnp.bitwise_or.reduce(faults)


def split_members(result: Result, num_members: int) -> Result:
    """Return the result of one array with a first axis of members.

    The run had no tangents and saved nothing. Replicas are in the order of the members. Each
    member has the status of the array: a fault of one fails all of them.
    """

    def split_records(x: Array) -> Array:
        return jnp.moveaxis(x.reshape(*x.shape[:-1], num_members, -1), -2, 0)

    def split_particles(x: Array) -> Array:
        return x.reshape(num_members, -1, *x.shape[1:])

    values = {name: split_records(x) for name, x in result.records.values.items()}
    return Result(
        Records(values, rates={}, tangents={}),
        jax.tree.map(split_particles, result.particles),
        jnp.broadcast_to(result.status, (num_members,)),
    )
