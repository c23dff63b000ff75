"""The rule of differentiation of a particle run, for forward and reverse mode.

`differentiable` gives a run projected derivatives: the tangents of its records along directions in
the material, and a change of clock for the density and the times. `first_order_only` refuses second
derivatives, and `nan_tangent` marks unknown derivatives.
"""

from collections.abc import Callable
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, DTypeLike, Float, Int

T = TypeVar("T")


class Records(NamedTuple):
    """What is recorded of a state; for a run every array has a first axis of times.

    Attributes:
        values: by name, each of shape (replicas,).
        rates: derivatives in time of the values whose derivatives are known, by name; empty if the
            state has no tangents.
        tangents: derivatives of the same values along the directions at a fixed time, by name, each
            of shape (directions, replicas).
        saved: tree of what the function of the user returns for each replica, arrays of shape
            (replicas, ...); None without such a function.
    """

    values: dict[str, Array]
    rates: dict[str, Array]
    tangents: dict[str, Array]
    saved: Any = None


class Result(NamedTuple):
    """Result of a run.

    Attributes:
        records: of all times.
        particles: positions, velocities and spins of all particles at the last time; None where
            they have no positions.
        status: of the run, see `jaxgran._utils.status`.
    """

    records: Records
    particles: Any
    status: Int[Array, ""]


BY_DENSITY = {"elastic_energy": 1.0}
"""Power of the collision frequency in a record at a fixed place in the sequence of collisions; 0
for all others."""


def differentiable(
    run: Callable[..., Result],
    material: Callable[[Any], Any],
    frequency: Callable[[Any], Any],
    refused: Callable[[Any], dict[str, Any]] = lambda scene: {},
) -> Callable[..., Result]:
    """Return a run with projected derivatives: one linear rule for forward and reverse mode.

    A gas depends on its material, its collision frequency and the times of the records. Tangents
    give the derivatives in the material; a change of the other two is a change of clock.

    Args:
        run: a function of the scene, the times, a given start and all else, such as the key of the
            random numbers, and of `directions` in the material: a pytree like the material, whose
            leaves hold the directions along a first axis. With directions its records have rates
            and tangents.
        material: the pytree of parameters of a scene, such as (alpha, A) or a reduced law.
        frequency: the collision frequency of a scene; None if it is not part of the scene.
        refused: the parameters of a scene in which the derivative is not known, by a message.

    Returns:
        The run as a function of the same arguments. Derivatives in positions and velocities of a
        start, in `refused` parameters, and second derivatives, raise ValueError. Derivatives of
        the last particles and of records without rates are nan.
    """

    @jax.custom_jvp
    def result(scene: Any, times: Array, start: Any, others: Any) -> Result:
        return run(scene, times, start, others)

    @partial(result.defjvp, symbolic_zeros=True)
    def result_jvp(primals: tuple, tangents: tuple) -> tuple[Result, Result]:
        scene, times, start, others = first_order_only(primals)
        scene_change, times_change, start_change, _ = tangents
        if _changes(start_change):
            raise ValueError(
                "the derivative in the positions or velocities of a start is not available: chaos "
                "destroys it after a few collisions. Hold the start fixed with "
                "jax.lax.stop_gradient, or for a short run use SoftSpheres(projection=None)"
            )
        for message, numbers in refused(scene_change).items():
            if _changes(numbers):
                raise ValueError(message)
        directions, amounts = _directions(material(scene), material(scene_change), times.dtype)
        found = run(scene, times, start, others, directions)
        # In a gas that is denser by some share everything happens earlier by this share.
        zero = jnp.zeros((), times.dtype)
        rate = frequency(scene_change)
        density_change = rate / frequency(scene) if _changes(rate) else zero
        delay = times_change if _changes(times_change) else zero
        time_change = delay + times * density_change
        records = found.records
        known = {}
        for name, rate in records.rates.items():
            power = BY_DENSITY.get(name, 0.0)
            by_delay = rate * time_change[:, None]
            by_density = power * density_change * records.values[name]
            by_material = jnp.einsum("tpr,p->tr", records.tangents[name], amounts)
            known[name] = by_delay + by_density + by_material
        plain = found._replace(records=records._replace(rates={}, tangents={}))
        changes = amounts, density_change, time_change
        unknown = jax.tree.map(lambda x: nan_tangent(x, *changes), plain)
        values = unknown.records.values | known
        return plain, unknown._replace(records=unknown.records._replace(values=values))

    return result


def _changes(tangents: Any) -> bool:
    leaves = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
    return not all(isinstance(leaf, SymbolicZero) for leaf in leaves)


def _directions(
    numbers: Any, changes: Any, dtype: DTypeLike
) -> tuple[Any, Float[Array, "directions"]]:
    """Unit directions in the changing numbers of a material, and the amounts of the changes.

    Args:
        numbers: the material.
        changes: its tangents, a pytree like it; symbolic zeros where a number does not change.
        dtype: of the amounts.
    """
    leaves, structure = jax.tree.flatten(numbers)
    tangents = structure.flatten_up_to(changes)
    changing = [_changes(tangent) for tangent in tangents]
    parts = [jnp.ravel(x) for x, followed in zip(tangents, changing, strict=True) if followed]
    amounts = jnp.concatenate([jnp.zeros(0, dtype), *parts])
    ends = list(accumulate(len(part) for part in parts))[:-1]
    rows = iter(jnp.split(jnp.eye(len(amounts), dtype=dtype), ends, axis=1))
    directions = [
        next(rows).reshape(-1, *x.shape) if followed else jnp.zeros((len(amounts), *x.shape), dtype)
        for x, followed in zip(leaves, changing, strict=True)
    ]
    return structure.unflatten(directions), amounts


def first_order_only(inputs: T) -> T:
    """Return the inputs of a rule such that the rule cannot be differentiated again.

    A rule consists of the tangents of one run. Plain differentiation of these would return their
    chaotic derivatives.

    Raises:
        ValueError: if a derivative in these inputs is taken.
    """

    def refuse(leaf: Any) -> Any:  # concrete values stay concrete, for runs that the host drives
        traced = isinstance(leaf, Tracer) and eqx.is_inexact_array(leaf)
        return _first_order_identity(leaf) if traced else leaf

    return jax.tree.map(refuse, inputs)


@jax.custom_jvp
def _first_order_identity(number: Array) -> Array:
    return number


@_first_order_identity.defjvp
def _first_order_identity_jvp(primals, tangents):
    raise ValueError(
        "no second derivative is available through a particle model. Take the difference of two "
        "first derivatives (jax.grad, jax.jvp or jax.jacfwd at two values of the parameter, with "
        "the same key), or use KineticTheory, which has second derivatives"
    )


def nan_tangent(result: Array, *changes: Float[Array, "..."]) -> Any:
    """Return the tangent of a result whose derivative is not known: nan, or 0 if nothing changes.

    In reverse mode the changes are nan where the result has a cotangent, and 0 where it has none,
    so that results that a function does not use leave its gradient finite.

    Args:
        result: of any type: integers have no tangent.
        changes: tangents of all that the result depends on.
    """
    if not jnp.issubdtype(result.dtype, jnp.inexact):
        return np.zeros(result.shape, jax.dtypes.float0)
    dtype = jnp.result_type(*changes)
    total = sum((jnp.sum(_nan_unless_zero(x)) for x in changes), start=jnp.zeros((), dtype))
    return _nan_unless_zero(jnp.broadcast_to(total, result.shape)).astype(result.dtype)


def _nan_unless_zero(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """The solution y of ``0 y = x``, in both modes: nan where x is not 0."""

    def solution(_: Any, x: Array) -> Array:
        return jnp.where(x == 0, jnp.zeros_like(x), jnp.nan)

    return jax.lax.custom_linear_solve(lambda y: 0 * y, x, solution, solution)
