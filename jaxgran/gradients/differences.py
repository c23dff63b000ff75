"""Derivatives of a particle run by differences of whole runs, instead of projected tangents.

A gas that clusters remembers more than its temperature, and a projected derivative is wrong where a
flow and clusters determine how it cools. Differences of runs include all of this, at the cost of
two more runs for each number of the material, and of noise: chaotic runs with the same start are
independent after some collisions, and the standard error of ``d ln T/d ln A`` is
``s / (sqrt(2) h)`` if the standard error of ln T is s. So the step h is large, and a change of
variables keeps its nonlinear error small.

A step changes the loss of energy in an impact by a factor of ``exp(+- h)``. With
``L = ln(loss)`` and a number a of the material, ``a_+- = a + (exp(+- h) - 1) / (dL/da)``, and the
derivative in a is ``dL/da (f_+ - f_-) / (L_+ - L_-)``. For T the difference is taken in
``g = ln(T^(-3/5) - 1)``, which is linear in L for as long as viscoelastic spheres obey Haff's law,
``T = (1 + t/tau)^(-5/3)`` with ``1/tau`` as the loss: then the difference is exact for any h.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxgran._utils.tracing import any_traced
from jaxgran.gradients.rule import Result

HAFF_EXPONENT = 0.6
"""3/5, the power of ``T^(-3/5)``, which is linear in time by Haff's law of viscoelastic spheres."""


def by_differences(
    run: Callable[..., Result], shifted: Callable[..., Result], step: float
) -> Callable[..., Result]:
    """Return a run with directions, as `jaxgran.gradients.rule.differentiable` takes it.

    Args:
        run: a function of the arguments of such a run, which returns the derivatives in time even
            for zero directions. Its scene is a named tuple with a `material`, and has `log_loss` of
            a material.
        shifted: a function of the same arguments without directions, for the further runs.
        step: h.
    """

    def with_differences(
        scene: Any, times: Array, start: Any, others: Any, directions: Any = None
    ) -> Result:
        if directions is None:
            return run(scene, times, start, others)
        none = jax.tree.map(lambda x: x[:0], directions)
        if not any(len(leaf) for leaf in jax.tree.leaves(directions)):
            return run(scene, times, start, others, none)  # only times or the density change
        material = scene.material
        slope = jax.vmap(lambda tangent: jax.jvp(scene.log_loss, (material,), (tangent,))[1])(
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

        def moved(size: Array, direction: Any) -> Any:
            return jax.tree.map(lambda x, tangent: x + size * tangent, material, direction)

        materials = jax.vmap(jax.vmap(moved, (0, None)))(sizes, directions)
        losses = jax.vmap(jax.vmap(scene.log_loss))(materials)
        span = losses[:, 0] - losses[:, 1]
        share = jnp.where(slope == 0, 0.0, slope / jnp.where(span == 0, jnp.nan, span))

        def run_at(material: Any) -> tuple[dict[str, Array], Array]:
            other = shifted(scene._replace(material=material), times, start, others)
            return other.records.values, other.status

        base = run(scene, times, start, others, none)
        materials = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), materials)
        if any_traced(scene, times, start, others):  # one program
            moved_values, faults = jax.lax.map(run_at, materials)
        else:  # from the host, one run after the other
            each = [run_at(jax.tree.map(lambda x, i=i: x[i], materials)) for i in range(sizes.size)]
            moved_values, faults = jax.tree.map(lambda *x: jnp.stack(x), *each)
        tangents = {}
        for name in base.records.tangents:
            ends = moved_values[name].reshape(-1, 2, *moved_values[name].shape[1:])
            values = base.records.values[name][None]
            change = _difference(name, values, ends[:, 0], ends[:, 1])
            change = jnp.where(share[:, None, None] == 0, 0.0, share[:, None, None] * change)
            tangents[name] = jnp.moveaxis(change, 0, 1)
        fault = base.status | jnp.bitwise_or.reduce(faults)
        return base._replace(records=base.records._replace(tangents=tangents), status=fault)

    return with_differences


def _difference(name: str, base: Array, upper: Array, lower: Array) -> Array:
    """Difference of a record between two ends; for T in the variable g."""
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
