"""Derivatives of a run by central differences of whole runs.

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
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.checks.tracing import any_traced
from jaxgran.tangents.rule import Inputs, Outputs

HAFF = 0.6
"""1/power of time with which a gas of viscoelastic spheres cools."""


def by_differences(
    run: Callable[..., Outputs], shifted: Callable[[Inputs], Outputs], step: float
) -> Callable[..., Outputs]:
    """A run with directions, as `jaxgran.tangents.rule.differentiable` takes it, by differences.

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
