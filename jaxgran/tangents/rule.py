"""The rule of differentiation of a particle run, the same for forward and reverse mode."""

from collections.abc import Callable
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, DTypeLike, Float, Int, PRNGKeyArray

from jaxgran.scene.elements import SPINS
from jaxgran.tangents.limits import first_order_only, unknown, unknown_tangent

_UNKNOWN = {"sonine", "flow_share"}
"""Records whose derivatives are not known."""

_DENSITY_POWER = {"displacement": -2.0, "elastic_energy": 1.0}
"""Power of the collision frequency in a record at a fixed place in the sequence of collisions."""


def with_tangents(
    records: dict[str, Array],
    kept: dict[str, Array],
    rates: dict[str, Array],
    clock: Float[Array, "p replicas"],
) -> dict[str, Array]:
    """The records, and for each record x its derivatives "x.rate" and "x.along".

    The first is the derivative in time, the second the derivatives along the directions at a fixed
    time.

    Args:
        records: each of shape (replicas,).
        kept: derivatives along the directions at a fixed place in the sequence of collisions;
            0 where not given.
        rates: derivatives in time; 0 where not given.
        clock: tangent of the clock.
    """
    extended = dict(records)
    for name, values in records.items():
        rate = rates.get(name, jnp.zeros(values.shape, clock.dtype))
        extended[f"{name}.rate"] = rate
        extended[f"{name}.along"] = kept.get(name, 0.0) - rate[None] * clock
    return extended


class Inputs(NamedTuple):
    """The arguments that determine a run, in reduced units.

    Attributes:
        scene: the gas; it has a collision_frequency.
        times: t at which to record.
        start: positions and velocities given by the user; None for random ones.
        key: of the random numbers; None for the default.
        units: of what is saved of the particles, whose derivatives are not known.
    """

    scene: Any
    times: Float[Array, "times"]
    start: tuple[Array, Array] | None
    key: PRNGKeyArray | None
    units: Any = None


class Outputs(NamedTuple):
    """The results of a run.

    Attributes:
        position, velocity: of all particles at the last time.
        records: by name, each of shape (times, replicas).
        status: of the run, see `jaxgran.checks.status`.
        spin: of all particles at the last time; None of smooth spheres.
    """

    position: Float[Array, "n d"]
    velocity: Float[Array, "n d"]
    records: dict[str, Array]
    status: Int[Array, ""]
    spin: Float[Array, "n spins"] | None = None


def differentiable(
    run: Callable[..., Outputs],
    material: Callable[[Any], Any],
    held: Callable[[Any], Any] = lambda scene: (),
) -> Callable[[Inputs], Outputs]:
    """A run with projected derivatives: one linear rule, for forward and reverse mode alike.

    A gas depends on its material, its collision frequency and the times of the records. The
    material is followed by tangents; a change of the other two is a change of clock.

    Args:
        run: a function of inputs, and of `directions` in the material: a pytree like the material,
            whose leaves hold the directions along a first axis. With directions the records of the
            run are those of `with_tangents`.
        material: the pytree of numbers of a scene, such as (alpha, A) or a reduced law.
        held: those numbers of a scene in which the derivative is not known.

    Returns:
        The run as a function of its inputs. Its derivative in positions and velocities of a start
        and in numbers that are held, and its second derivatives, raise ValueError; derivatives of
        a_2 and of the last particles are nan.
    """

    @jax.custom_jvp
    def outputs(inputs: Inputs) -> Outputs:
        out = run(inputs)
        return out._replace(records=_plain(out.records))

    @partial(outputs.defjvp, symbolic_zeros=True)
    def outputs_jvp(at: tuple[Inputs], along: tuple[Inputs]):
        (inputs,), (change,) = at, along
        _refuse_derivative_in_start(change)
        _refuse_derivative_in(held(change.scene))
        inputs = first_order_only(inputs)
        directions, amounts = _directions(
            material(inputs.scene), material(change.scene), inputs.times.dtype
        )
        out = run(inputs, directions=directions)
        denser, later = _changes_of_clock(inputs, change)
        moved = _moved(out.records, amounts, denser, later, out.velocity.shape[1])
        changes = amounts, denser, later
        for name in set(_plain(out.records)) - set(moved) | _UNKNOWN & set(out.records):
            moved[name] = unknown_tangent(out.records[name], *changes)
        return out._replace(records=_plain(out.records)), Outputs(
            position=unknown(out.position.shape, *changes),
            velocity=unknown(out.velocity.shape, *changes),
            records=moved,
            status=np.zeros(out.status.shape, jax.dtypes.float0),  # type: ignore[arg-type]
            spin=None if out.spin is None else unknown(out.spin.shape, *changes),
        )

    return outputs


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, SymbolicZero)


def _plain(records: dict[str, Array]) -> dict[str, Array]:
    """The records without the derivatives that `with_tangents` adds."""
    return {name: x for name, x in records.items() if "." not in name}


def _refuse_derivative_in_start(change: Inputs) -> None:
    leaves = jax.tree.leaves(change.start, is_leaf=_is_zero)
    if not all(_is_zero(leaf) for leaf in leaves):
        raise ValueError(
            "a derivative in the positions or velocities of a start was asked for, which chaos "
            "destroys after a few collisions; hold the start fixed with jax.lax.stop_gradient, or "
            "for a short run use SoftSpheres(projection=None)"
        )


def _refuse_derivative_in(changes: Any) -> None:
    if not all(_is_zero(leaf) for leaf in jax.tree.leaves(changes, is_leaf=_is_zero)):
        raise ValueError(
            "a derivative in the side of a container, or in the diameter or packing_fraction of "
            "the gas in it, was asked for, which is not known: hold them fixed with "
            "jax.lax.stop_gradient, take differences of runs, or use KineticTheory()"
        )


def _directions(
    numbers: Any, changes: Any, dtype: DTypeLike
) -> tuple[Any, Float[Array, "directions"]]:
    """Unit directions in those numbers of a material that change, and the amounts of the changes.

    Args:
        numbers: the material.
        changes: its tangents, a pytree like it; symbolic zeros where a number does not change.
        dtype: of the amounts.
    """
    leaves, structure = jax.tree.flatten(numbers)
    tangents = structure.flatten_up_to(changes)
    followed = [not _is_zero(tangent) for tangent in tangents]
    parts = [jnp.ravel(x) for x, yes in zip(tangents, followed, strict=True) if yes]
    amounts = jnp.concatenate([jnp.zeros(0, dtype), *parts])
    ends = list(accumulate(len(part) for part in parts))[:-1]
    rows = iter(jnp.split(jnp.eye(len(amounts), dtype=dtype), ends, axis=1))
    directions = [
        next(rows).reshape(-1, *x.shape) if yes else jnp.zeros((len(amounts), *x.shape), dtype)
        for x, yes in zip(leaves, followed, strict=True)
    ]
    return structure.unflatten(directions), amounts


def _changes_of_clock(
    inputs: Inputs, change: Inputs
) -> tuple[Float[Array, ""], Float[Array, "times"]]:
    """The relative change of the collision frequency, and the change of the times with it.

    In a gas that is denser by some share everything happens earlier by this share.
    """
    zero = jnp.zeros((), inputs.times.dtype)
    denser = change.scene.collision_frequency
    denser = zero if _is_zero(denser) else denser / inputs.scene.collision_frequency
    times = zero if _is_zero(change.times) else change.times
    return denser, times + inputs.times * denser


def _moved(
    records: dict[str, Array],
    amounts: Float[Array, "directions"],
    denser: Float[Array, ""],
    later: Float[Array, "times"],
    dimension: int,
) -> dict[str, Array]:
    """The tangents of the records.

    Args:
        records: of the run, with those that `with_tangents` adds; of the others the tangent is not
            known.
        amounts: changes of the material along the directions.
        denser: relative change of the collision frequency.
        later: change of the times.
        dimension: d.
    """
    moved = {}
    for name, x in _plain(records).items():
        if f"{name}.rate" not in records:
            continue
        moved[name] = records[f"{name}.rate"] * later[:, None]
        moved[name] += _DENSITY_POWER.get(name, 0.0) * denser * x
        moved[name] += jnp.einsum("tpr,p->tr", records[f"{name}.along"], amounts)
    if "dissipated_energy" not in moved:
        return moved
    # The energy balance holds in the tangents, too.
    inside = moved.get("elastic_energy", 0.0)
    if "rotational_temperature" in moved:
        inside = inside + 0.5 * SPINS[dimension] * moved["rotational_temperature"]
    moved["dissipated_energy"] = -0.5 * dimension * moved["temperature"] - inside
    return moved
