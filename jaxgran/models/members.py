"""Members of a batch by `jax.vmap` in one array: those that differ in their law alone.

A batched loop waits for its slowest member in each of its steps, so that a batch of spheres takes
as long as its members one after the other. Replicas of one gas share their arrays and blocks or
windows of time instead. Members that differ in the law of their impacts alone become such replicas,
each with its own law, which all begin from the start that one of them would have. They are as
accurate as alone, but for some collisions only the same.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxgran.gradients.rule import Records, Result


def together(
    run: Callable[[Any, Any], Result],
    of_members: Callable[[Any, Any, Any, int], Result | None],
) -> Callable[[Any, Any], Result]:
    """Return the same run with a rule for `jax.vmap`.

    Args:
        run: a function of a scene and of all else.
        of_members: the same for several members. Its further arguments are a pair like its inputs,
            with True at what has a first axis of members, and the number of members. It returns
            None if they cannot share an array.
    """

    @jax.custom_batching.custom_vmap
    def one(scene: Any, others: Any) -> Result:
        return run(scene, others)

    @one.def_vmap
    def several(members: int, differs: Any, scene: Any, others: Any) -> tuple[Result, Any]:
        found = of_members(scene, others, tuple(differs), members)
        if found is None:
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(differs))
            found = jax.vmap(run, in_axes=axes, axis_size=members)(scene, others)
        return found, jax.tree.map(lambda _: True, found)

    return one


def by_member(result: Result, members: int) -> Result:
    """Return the result of replicas with a first axis of members, to each of which some belong."""

    def of_records(x: Array) -> Array:
        return jnp.moveaxis(x.reshape(*x.shape[:-1], members, -1), -2, 0)

    def of_particles(x: Array) -> Array:
        return x.reshape(members, -1, *x.shape[1:])

    values = {name: of_records(x) for name, x in result.records.values.items()}
    return Result(
        Records(values, {}, {}),
        jax.tree.map(of_particles, result.particles),
        jnp.broadcast_to(result.status, (members,)),
    )
