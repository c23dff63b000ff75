"""The rule of differentiation of a particle run, for forward and reverse mode.

`differentiable` gives a run projected derivatives: the tangents of its records along directions in
the material (`with_tangents`), and a change of clock for the density and the times.
`first_order_only` refuses second derivatives, and `nan_tangent` marks unknown derivatives.

`by_differences` replaces the projected derivatives by central differences of whole runs. A gas that
clusters remembers more than its temperature, and a projected derivative is wrong where a flow and
clusters determine how it cools. Differences of runs include all of this, at the cost of two more
runs for each number of the material, and of noise: chaotic runs with the same start are independent
after some collisions, and the standard error of ``d ln T/d ln A`` is ``s / (sqrt(2) h)`` if that of
ln T is s. So the step h is large, and a change of variables keeps its nonlinear error small.

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


class Inputs(NamedTuple):
    """Arguments that determine a run, in reduced units.

    Attributes:
        scene: the gas; it has a collision_frequency.
        times: t at which to record.
        start: positions and velocities given by the user; None for random ones.
        key: of the random numbers; None for the default.
        units: of the saved particle data, whose derivatives are not known.
    """

    scene: Any
    times: Float[Array, "times"]
    start: tuple[Array, Array] | None
    key: PRNGKeyArray | None
    units: Any = None


class Outputs(NamedTuple):
    """Results of a run.

    Attributes:
        position, velocity: of all particles at the last time; None if they are not returned.
        records: by name, each of shape (times, replicas); "saved" is a tree of arrays of shape
            (times, replicas, ...).
        status: of the run, see `jaxgran._utils.status`.
        spin: of all particles at the last time; None for smooth spheres.
    """

    position: Any
    velocity: Any
    records: dict[str, Any]
    status: Int[Array, ""]
    spin: Float[Array, "n spins"] | None = None


def differentiable(
    run: Callable[..., Outputs],
    material: Callable[[Any], Any] = lambda scene: scene.material,
    frequency: Callable[[Any], Any] = lambda scene: scene.collision_frequency,
    non_differentiable: Callable[[Any], Any] = lambda scene: (),
) -> Callable[[Inputs], Outputs]:
    """Return a run with projected derivatives: one linear rule for forward and reverse mode.

    A gas depends on its material, its collision frequency and the times of the records. Tangents
    give the derivatives in the material; a change of the other two is a change of clock.

    Args:
        run: a function of inputs, and of `directions` in the material: a pytree like the material,
            whose leaves hold the directions along a first axis. With directions the records of the
            run x are joined by their derivatives: "x.rate" in time and "x.along" in the directions,
            as `with_tangents` returns them. Without both the derivatives of x are not known.
        material: the pytree of parameters of a scene, such as (alpha, A) or a reduced law.
        frequency: the collision frequency of a scene; None if it is not part of the scene.
        non_differentiable: the parameters of a scene in which the derivative is not known.

    Returns:
        The run as a function of its inputs. Derivatives in positions and velocities of a start and
        in `non_differentiable` parameters, and second derivatives, raise ValueError; derivatives of
        a_2 and of the last particles are nan.
    """

    @jax.custom_jvp
    def outputs(inputs: Inputs) -> Outputs:
        out = run(inputs)
        return out._replace(records=_plain(out.records))

    @partial(outputs.defjvp, symbolic_zeros=True)
    def outputs_jvp(primals: tuple[Inputs], tangents: tuple[Inputs]):
        (inputs,), (change,) = primals, tangents
        if _changes(change.start):
            raise ValueError(
                "the derivative in the positions or velocities of a start is not available: chaos "
                "destroys it after a few collisions. Hold the start fixed with "
                "jax.lax.stop_gradient, or for a short run use SoftSpheres(projection=None)"
            )
        if _changes(non_differentiable(change.scene)):
            raise ValueError(
                "the derivative in the side of a container, or in the diameter or packing_fraction "
                "of the gas in it, is not known. Hold them fixed with jax.lax.stop_gradient, take "
                "differences of runs, or use KineticTheory()"
            )
        inputs = first_order_only(inputs)
        directions, amounts = _directions(
            material(inputs.scene), material(change.scene), inputs.times.dtype
        )
        out = run(inputs, directions=directions)
        # In a gas that is denser by some share everything happens earlier by this share.
        zero = jnp.zeros((), inputs.times.dtype)
        rate, times = frequency(change.scene), change.times
        density_change = rate / frequency(inputs.scene) if _changes(rate) else zero
        time_change = (times if _changes(times) else zero) + inputs.times * density_change
        changes = amounts, density_change, time_change
        along, plain = {}, _plain(out.records)
        for name in [name for name in plain if f"{name}.rate" in out.records]:
            along[name] = out.records[f"{name}.rate"] * time_change[:, None]
            along[name] += _DENSITY_POWER.get(name, 0.0) * density_change * plain[name]
            if (directional := out.records.get(f"{name}.along")) is None:
                along[name] += nan_tangent(along[name], *changes[:2])
            else:
                along[name] += jnp.einsum("tpr,p->tr", directional, amounts)
        if "dissipated_energy" in along:  # the energy balance holds in the tangents, too
            d = out.velocity.shape[1]
            inside = along.get("elastic_energy", 0.0)
            if "rotational_temperature" in along:
                inside = inside + 0.5 * NUM_SPIN_COMPONENTS[d] * along["rotational_temperature"]
            along["dissipated_energy"] = -0.5 * d * along["temperature"] - inside
        out = out._replace(records=plain)
        unknown = jax.tree.map(lambda x: nan_tangent(x, *changes), out)
        return out, unknown._replace(records=unknown.records | along)

    return outputs


def _changes(tangents: Any) -> bool:
    leaves = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
    return not all(isinstance(leaf, SymbolicZero) for leaf in leaves)


def _plain(records: dict[str, Array]) -> dict[str, Array]:
    """The records without the derivatives that `with_tangents` adds."""
    return {name: x for name, x in records.items() if "." not in name}


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


UNKNOWN = {"sonine", "flow_share"}
"""Records whose derivatives `with_tangents` does not know."""

_DENSITY_POWER = {"displacement": -2.0, "elastic_energy": 1.0}
"""Power of the collision frequency in a record at a fixed place in the sequence of collisions."""


def with_tangents(
    records: dict[str, Array],
    along: dict[str, Array],
    rates: dict[str, Array],
    clock: Float[Array, "p replicas"],
) -> dict[str, Array]:
    """Return the records, and for each record x but `UNKNOWN` ones "x.rate" and "x.along".

    The first is the derivative in time, the second the derivatives along the directions at a fixed
    time.

    Args:
        records: each of shape (replicas,).
        along: derivatives along the directions at a fixed place in the sequence of collisions;
            0 for records that it lacks.
        rates: derivatives in time; 0 for records that it lacks.
        clock: tangent of the clock.
    """
    extended = dict(records)
    for name, values in records.items():
        if name in UNKNOWN:
            continue
        rate = rates.get(name, jnp.zeros(values.shape, clock.dtype))
        extended[f"{name}.rate"] = rate
        extended[f"{name}.along"] = along.get(name, 0.0) - rate[None] * clock
    return extended


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


HAFF_EXPONENT = 0.6
"""3/5, the power of ``T^(-3/5)``, which is linear in time by Haff's law of viscoelastic spheres."""


def by_differences(
    run: Callable[..., Outputs], shifted: Callable[[Inputs], Outputs], step: float
) -> Callable[..., Outputs]:
    """Return a run with directions, as `differentiable` takes it, by differences of whole runs.

    Args:
        run: a function of inputs and `directions`, which returns the derivatives in time even for
            zero directions. The scene of its inputs is a named tuple with a `material`,
            and has `log_loss` of a material.
        shifted: a function of inputs, for the further runs.
        step: h.
    """

    def outputs(inputs: Inputs, directions: Any = None) -> Outputs:
        if directions is None:
            return run(inputs)
        none = jax.tree.map(lambda x: x[:0], directions)
        if not any(len(leaf) for leaf in jax.tree.leaves(directions)):
            return run(inputs, directions=none)  # only times or the density change
        scene, material, traced = inputs.scene, inputs.scene.material, any_traced(inputs)
        slope = jax.vmap(lambda along: jax.jvp(scene.log_loss, (material,), (along,))[1])(
            directions
        )
        if not any_traced(slope) and not bool(jnp.all(jnp.isfinite(slope))):
            raise ValueError(
                "a derivative by differences changes the loss of an impact by a factor, but this "
                "gas has no loss. Give it one, or leave differences out for projected derivatives"
            )
        # A number on which the loss does not depend changes nothing.
        known = jnp.isfinite(slope) & (slope != 0)
        signs = jnp.expm1(jnp.array([step, -step], slope.dtype))
        sizes = jnp.where(known[:, None], signs[None] / jnp.where(known, slope, 1.0)[:, None], 0.0)

        def end(size: Array, along: Any) -> Any:
            return jax.tree.map(lambda number, along: number + size * along, material, along)

        ends = jax.vmap(jax.vmap(end, (0, None)))(sizes, directions)
        losses = jax.vmap(jax.vmap(scene.log_loss))(ends)
        span = losses[:, 0] - losses[:, 1]
        share = jnp.where(slope == 0, 0.0, slope / jnp.where(span == 0, jnp.nan, span))

        def run_at(material: Any) -> tuple[dict[str, Array], Array]:
            other = shifted(inputs._replace(scene=scene._replace(material=material)))
            return other.records, other.status

        out = run(inputs, directions=none)
        ends = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), ends)
        if traced:  # compiled once, or called from the host one by one
            shifted_records, status = jax.lax.map(run_at, ends)
        else:
            each = [run_at(jax.tree.map(lambda x, i=i: x[i], ends)) for i in range(sizes.size)]
            shifted_records, status = jax.tree.map(lambda *x: jnp.stack(x), *each)
        records = dict(out.records)
        for name, values in shifted_records.items():
            if f"{name}.along" in records:
                upper, lower = jnp.moveaxis(values.reshape(-1, 2, *values.shape[1:]), 1, 0)
                change = _record_difference(name, records[name][None], upper, lower)
                change = jnp.where(share[:, None, None] == 0, 0.0, share[:, None, None] * change)
                records[f"{name}.along"] = jnp.moveaxis(change, 0, 1)
        return out._replace(records=records, status=out.status | jnp.bitwise_or.reduce(status))

    return outputs


def _record_difference(name: str, base: Array, upper: Array, lower: Array) -> Array:
    """Difference of a record between two ends; that of T in the variable g."""
    plain = upper - lower
    if name != "temperature":
        return plain
    below = (base < 1) & (upper < 1) & (lower < 1)

    def g(T: Array) -> Array:
        T = jnp.where(below, T, 0.5)
        return jnp.log(jnp.expm1(-HAFF_EXPONENT * jnp.log(T)))

    slope = base / HAFF_EXPONENT * jnp.expm1(HAFF_EXPONENT * jnp.log(jnp.where(below, base, 0.5)))
    by_g = slope * (g(upper) - g(lower))
    return jnp.where(below, by_g, plain)
