"""The rule of differentiation of a particle run, the same for forward and reverse mode.

The limits of a rule of differentiation: what it refuses, and what it does not know.

Derivatives of a run by central differences of whole runs.

A gas that clusters remembers more than its temperature, and a projected derivative is wrong where a
flow and clusters decide how it cools. Differences of runs know all of this, at the cost of two more
runs for each number of the material, and of noise: chaotic runs with the same start are independent
after some collisions, and the standard error of ``d ln T/d ln A`` is ``s / (sqrt(2) h)`` with that
of ln T, s. So the step h is large, and what it bends is kept small by a change of variables.

A step changes the loss of energy in an impact by a factor of ``exp(+- h)``. With
``L = ln(loss)`` and a number a of the material, ``a_+- = a + (exp(+- h) - 1) / (dL/da)``, and the
derivative in a is ``dL/da (f_+ - f_-) / (L_+ - L_-)``. For T the difference is that of
``g = ln(T^(-3/5) - 1)``, which is linear in L for as long as viscoelastic spheres obey Haff's law,
``T = (1 + t/tau)^(-5/3)`` with ``1/tau`` as the loss: then the difference is exact for any h.
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
from jaxtyping import Array, DTypeLike, Float, Int, PRNGKeyArray

from jaxgran._utils.tracing import any_traced
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS

T = TypeVar("T")


def first_order_only(inputs: T) -> T:
    """The inputs of a rule, which can then not be differentiated itself.

    A rule is made of the tangents of one run; differentiated plainly it would return the chaotic
    derivatives of these.

    Raises:
        ValueError: if a derivative in these inputs is taken.
    """
    # Known numbers stay known, for runs that are driven from the host.
    numbers, others = eqx.partition(inputs, _may_change)
    return eqx.combine(_first_order_identity(numbers), others)


def _may_change(leaf: Any) -> bool:
    return isinstance(leaf, Tracer) and eqx.is_inexact_array(leaf)


@jax.custom_jvp
def _first_order_identity(numbers: Any) -> Any:
    return numbers


@partial(_first_order_identity.defjvp, symbolic_zeros=True)
def _first_order_identity_jvp(at, along):
    (numbers,), (tangents,) = at, along
    if not all(isinstance(tangent, SymbolicZero) for tangent in jax.tree.leaves(tangents)):
        raise ValueError(
            "a second derivative through a particle model was asked for, which has first "
            "derivatives only: take the difference of two first derivatives (jax.grad, jax.jvp or "
            "jax.jacfwd at two values of the parameter, with the same key), or use "
            "KineticTheory, which has second derivatives"
        )
    return numbers, jax.tree.map(jnp.zeros_like, numbers)


def nan_tangent(shape: tuple[int, ...], *changes: Float[Array, "..."]) -> Float[Array, "..."]:
    """The tangent of a result whose derivative is not known: nan, or 0 if nothing changes.

    In reverse mode the changes are nan where the result has a cotangent, and 0 where it has none,
    so that results that a function does not use do not spoil its gradient.

    Args:
        shape: of the result.
        changes: tangents of all that it depends on.
    """
    dtype = jnp.result_type(*changes)
    total = sum((jnp.sum(_indeterminate(x)) for x in changes), start=jnp.zeros((), dtype))
    return _indeterminate(jnp.broadcast_to(total, shape))


def nan_tangent_like(result: Array, *changes: Float[Array, "..."]) -> Any:
    """`unknown` for a result of any type: integers have no tangent."""
    if jnp.issubdtype(result.dtype, jnp.inexact):
        return nan_tangent(result.shape, *changes).astype(result.dtype)
    return np.zeros(result.shape, jax.dtypes.float0)


def _indeterminate(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """The solution y of ``0 y = x``, and in reverse mode likewise: nan where x is not 0."""

    def solution(_: Any, x: Array) -> Array:
        return jnp.where(x == 0, jnp.zeros_like(x), jnp.nan)

    return jax.lax.custom_linear_solve(lambda y: 0 * y, x, solution, solution)


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
        status: of the run, see `jaxgran._utils.status`.
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
    non_differentiable: Callable[[Any], Any] = lambda scene: (),
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
        _refuse_derivative_in(non_differentiable(change.scene))
        inputs = first_order_only(inputs)
        directions, amounts = _directions(
            material(inputs.scene), material(change.scene), inputs.times.dtype
        )
        out = run(inputs, directions=directions)
        denser, later = _changes_of_clock(inputs, change)
        moved = _moved(out.records, amounts, denser, later, out.velocity.shape[1])
        changes = amounts, denser, later
        for name in set(_plain(out.records)) - set(moved) | _UNKNOWN & set(out.records):
            moved[name] = nan_tangent_like(out.records[name], *changes)
        return out._replace(records=_plain(out.records)), Outputs(
            position=nan_tangent(out.position.shape, *changes),
            velocity=nan_tangent(out.velocity.shape, *changes),
            records=moved,
            status=np.zeros(out.status.shape, jax.dtypes.float0),  # type: ignore[arg-type]
            spin=None if out.spin is None else nan_tangent(out.spin.shape, *changes),
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
        inside = inside + 0.5 * NUM_SPIN_COMPONENTS[dimension] * moved["rotational_temperature"]
    moved["dissipated_energy"] = -0.5 * dimension * moved["temperature"] - inside
    return moved


HAFF = 0.6
"""1/power of time with which a gas of viscoelastic spheres cools."""


def by_differences(
    run: Callable[..., Outputs], shifted: Callable[[Inputs], Outputs], step: float
) -> Callable[..., Outputs]:
    """A run with directions, as `jaxgran.gradients.rule.differentiable` takes it, by differences.

    Args:
        run: a function of inputs and `directions`, which returns the derivatives in time even if it
            is given none. The scene of its inputs has a `material`, `with_material`, and `log_loss`
            of a material.
        shifted: a function of inputs, for the further runs.
        step: h.
    """

    def outputs(inputs: Inputs, directions: Any = None) -> Outputs:
        if directions is None:
            return run(inputs)
        none = jax.tree.map(lambda x: x[:0], directions)
        if not any(len(leaf) for leaf in jax.tree.leaves(directions)):
            return run(inputs, directions=none)  # only times or the density change
        scene = inputs.scene
        ends, steep, span = jax.vmap(partial(_ends, scene, step))(directions)
        _check_loss(steep)
        out = run(inputs, directions=none)
        ends = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), ends)

        def once(end: Any) -> tuple[dict[str, Array], Array]:
            other = shifted(inputs._replace(scene=scene.with_material(end)))
            return other.records, other.status

        others, status = _each(once, ends, traced=any_traced(inputs))
        # A number without which the loss is the same changes nothing.
        share = jnp.where(steep == 0, 0.0, steep / jnp.where(span == 0, jnp.nan, span))
        records = dict(out.records)
        for name, values in others.items():
            if f"{name}.along" in records:
                more, less = jnp.moveaxis(values.reshape(-1, 2, *values.shape[1:]), 1, 0)
                change = _change(name, records[name][None], more, less)
                change = jnp.where(share[:, None, None] == 0, 0.0, share[:, None, None] * change)
                records[f"{name}.along"] = jnp.moveaxis(change, 0, 1)
        fault = out.status
        for other in status:
            fault |= other
        return out._replace(records=records, status=fault)

    return outputs


def _ends(
    scene: Any, step: float, direction: Any
) -> tuple[Any, Float[Array, ""], Float[Array, ""]]:
    """The two materials of a difference along a direction, dL/da, and ``L_+ - L_-``."""
    material = scene.material
    steep = jax.jvp(scene.log_loss, (material,), (direction,))[1]
    found = jnp.isfinite(steep) & (steep != 0)
    by = jnp.expm1(jnp.array([step, -step], steep.dtype)) / jnp.where(found, steep, 1.0)

    def end(by: Array) -> Any:
        return jax.tree.map(lambda number, along: number + by * along, material, direction)

    ends = jax.vmap(end)(jnp.where(found, by, 0.0))
    losses = jax.vmap(scene.log_loss)(ends)
    return ends, steep, losses[0] - losses[1]


def _check_loss(steep: Float[Array, "p"]) -> None:
    if not any_traced(steep) and not bool(jnp.all(jnp.isfinite(steep))):
        raise ValueError(
            "a derivative by differences changes the loss of an impact by a factor, and this gas "
            "has no loss: give it one, or leave differences out for projected derivatives"
        )


def _each(function: Callable[[Any], Any], ends: Any, traced: bool) -> Any:
    """A function of each material: compiled once, or called from the host one after the other."""
    if traced:
        return jax.lax.map(function, ends)
    count = len(jax.tree.leaves(ends)[0])
    found = [function(jax.tree.map(lambda x, i=i: x[i], ends)) for i in range(count)]
    return jax.tree.map(lambda *x: jnp.stack(x), *found)


def _change(name: str, base: Array, more: Array, less: Array) -> Array:
    """The difference of a record between two ends, that of T in the variable g."""
    plain = more - less
    if name != "temperature":
        return plain
    below = (base < 1) & (more < 1) & (less < 1)

    def g(T: Array) -> Array:
        T = jnp.where(below, T, 0.5)
        return jnp.log(jnp.expm1(-HAFF * jnp.log(T)))

    in_g = base / HAFF * jnp.expm1(HAFF * jnp.log(jnp.where(below, base, 0.5)))
    bent = in_g * (g(more) - g(less))
    return jnp.where(below, bent, plain)
