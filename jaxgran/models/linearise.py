"""A cooling curve with its derivatives in all floats of a gas, by one compiled program.

Fits, diagnoses and the choice of a model call this program for all curves of a kind of gas: times
are padded to a grid of lengths, and a gas that lacks an element gets one without effect, so that
alternative explanations of a curve are other numbers of the same program.
"""

import dataclasses
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxgran._utils.tracing import as_jax_arrays, fast_compilation, grid_size, pad_to
from jaxgran.data.curve import CoolingCurve
from jaxgran.models.base import AbstractModel
from jaxgran.scene.elements import Rough, StokesDrag, Walls
from jaxgran.scene.gas import Gas

LINEARISED = "temperature", "rotational_temperature", "displacement", "collisions"
"""Fields of a curve that are linearised, if the model computes them."""

COMPUTED = (*LINEARISED, "sonine", "third_sonine", "diffusion", "status")
"""Fields of a curve that are computed."""

REMOTE_WALLS = 1e9
"""Side of a box without effect, m."""

STICKING = 1e6
"""Coefficient of friction without effect."""


class LinearisedCurve(NamedTuple):
    """A curve and its derivatives, arrays of NumPy.

    Attributes:
        values: the fields of `COMPUTED` that the model computes, by name.
        by_float: derivatives of the fields of `LINEARISED`, by name of the float and of the field,
            shape (times, size of the float).
        by_time: their derivatives in time, by name, shape (times,).
    """

    values: dict[str, Any]
    by_float: dict[str, dict[str, Any]]
    by_time: dict[str, Any]


def with_neutral_elements(gas: Gas, model: AbstractModel) -> Gas:
    """Return a gas with each element that the model supports; those added have no effect.

    An element of an alternative explanation is then another number of the program that computed the
    fitted curve, and not another program, which would take seconds to compile.
    """
    neutral = {
        "surface": Rough(-1.0, friction=STICKING),
        "container": Walls(REMOTE_WALLS, restitution=1.0),
        "drag": StokesDrag(0.0),
    }
    added: dict[str, Any] = {
        name: element
        for name, element in neutral.items()
        if name in model.elements and getattr(gas, name) is None
    }
    if isinstance(gas.surface, Rough) and gas.surface.friction is None:
        added["surface"] = dataclasses.replace(gas.surface, friction=STICKING)
    return dataclasses.replace(gas, **added)


def linearise(
    model: AbstractModel, gas: Gas, times: Any, tolerance: float = 1.0
) -> LinearisedCurve:
    """Return the curve of a gas by a deterministic model, and its derivatives.

    Args:
        model: without noise.
        gas: the scene.
        times: t, s, not decreasing, >= 0.
        tolerance: factor of the model's tolerance.
    """
    size = times.shape[-1]
    padded = pad_to(np.asarray(times), grid_size(size))
    computed = _compiled(jax.default_backend())(model, gas, padded, np.asarray(tolerance))
    values, slopes, by_time = jax.tree.map(
        lambda x: np.asarray(x)[:size] if x.ndim else np.asarray(x), computed
    )
    by_float = {}
    begin = 0
    for name, value in gas.floats.items():
        end = begin + np.size(value)
        by_float[name] = {quantity: slope[:, begin:end] for quantity, slope in slopes.items()}
        begin = end
    return LinearisedCurve(values, by_float, by_time)


def curve_of_program(
    model: AbstractModel, gas: Gas, times: Float[np.ndarray, "times"], displacement: bool = False
) -> CoolingCurve:
    """Return the curve of a gas without <dr^2>, by the program that fits share.

    Args:
        model: without noise.
        gas: the scene.
        times: t, s.
        displacement: use the program of fits that need <dr^2>.
    """
    complete = with_neutral_elements(gas, model)
    simple = model.simplified_for(gas, displacement=displacement)
    values = dict(linearise(simple, complete, times).values)
    for name in ("displacement", "diffusion"):
        values.pop(name, None)
    return CoolingCurve(**as_jax_arrays({"times": times} | values))


def _linearised(
    model: AbstractModel, gas: Gas, times: Array, tolerance: Array
) -> tuple[dict[str, Array], dict[str, Array], dict[str, Array]]:
    """Values, their derivatives in all floats in the order of `Gas.domains`, and in time."""
    names, values = zip(*gas.floats.items(), strict=True)
    flat, unravel = ravel_pytree(values)

    def curve(flat: Array, delay: Array) -> tuple[dict, dict]:
        changed = gas.replace(**dict(zip(names, unravel(flat), strict=True)))
        computed = model.solve(changed, times + delay, tolerance)
        fields = {name: getattr(computed, name) for name in COMPUTED}
        known = {name: value for name, value in fields.items() if value is not None}
        return {name: known[name] for name in LINEARISED if name in known}, known

    delay = jnp.zeros((), times.dtype)
    slopes, values = jax.jacfwd(curve, argnums=(0, 1), has_aux=True)(flat, delay)
    by_float = {quantity: pair[0] for quantity, pair in slopes.items()}
    by_time = {quantity: pair[1] for quantity, pair in slopes.items()}
    return values, by_float, by_time


@cache
def _compiled(backend: str) -> Any:
    options: dict[str, Any] = {"compiler_options": fast_compilation(backend)}
    return eqx.filter_jit(_linearised, **options)
