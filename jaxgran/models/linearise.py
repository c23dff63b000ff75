"""A cooling curve with its derivatives in all floats of a gas, by one compiled program.

Fits, diagnoses and the choice of a model call this program for all curves of a kind of gas: times
are padded to a grid of lengths, and a gas that lacks an element gets one without effect, so that
alternative explanations of a curve differ only in the inputs of the program.
"""

import dataclasses
from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.tracing import as_jax_arrays, fast_jit, grid_size
from jaxgran.data.curve import CoolingCurve
from jaxgran.models.base import AbstractModel
from jaxgran.scene.elements import Rough, StokesDrag
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import Viscoelastic, ViscoelasticVariant
from jaxgran.scene.walls import Walls

LINEARISED = "temperature", "rotational_temperature", "displacement", "collisions", "size_ratio"
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

    An alternative explanation with one more element then differs only in the inputs of the program
    that computed the fitted curve: nothing is compiled again. Spheres of unequal
    sizes get drag alone, since no theory of them has roughness and walls.
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
    if gas.diameter_sd is not None:
        added = {name: element for name, element in added.items() if name == "drag"}
    return dataclasses.replace(with_variant_law(with_coulomb_limit(gas)), **added)


def with_coulomb_limit(gas: Gas) -> Gas:
    """Return a gas whose rough spheres have a coefficient of friction, without effect if added."""
    if not isinstance(gas.surface, Rough) or gas.surface.friction is not None:
        return gas
    surface = dataclasses.replace(gas.surface, friction=STICKING)
    return dataclasses.replace(gas, surface=surface)


def with_variant_law(gas: Gas) -> Gas:
    """Return a gas whose viscoelastic law has the floats of alternative laws, without effect."""
    if type(gas.law) is not Viscoelastic:
        return gas
    return dataclasses.replace(gas, law=ViscoelasticVariant.from_law(gas.law))


def linearise(
    model: AbstractModel,
    gas: Gas,
    times: Float[np.ndarray, "times"],
    names: Collection[str],
    tolerance: float = 1.0,
) -> LinearisedCurve:
    """Return the curve of a gas by a model without noise, and its derivatives.

    Args:
        model: without noise.
        gas: the scene.
        times: t, s, not decreasing, >= 0.
        names: floats of the gas in which derivatives are taken.
        tolerance: factor of the model's tolerance.
    """
    size = times.size
    padded = np.pad(times, (0, grid_size(size) - size), mode="edge")
    sizes = {name: np.size(gas.value(name)) for name in gas.domains if name in names}
    directions, delay = _directions(gas, sizes)
    program = fast_jit(_linearised, jax.default_backend())
    computed = program(model, gas, padded, np.asarray(tolerance), directions, delay)
    values, slopes = jax.tree.map(np.asarray, computed)
    values = {name: x[:size] if x.ndim else x for name, x in values.items()}
    slopes = {name: x[:, :size].T for name, x in slopes.items()}
    by_float = {}
    begin = 1
    for name, count in sizes.items():
        part = slice(begin, begin + count)
        by_float[name] = {quantity: slope[:, part] for quantity, slope in slopes.items()}
        begin += count
    by_time = {quantity: slope[:, 0] for quantity, slope in slopes.items()}
    return LinearisedCurve(values, by_float, by_time)


def _directions(gas: Gas, sizes: dict[str, int]) -> tuple[Gas, np.ndarray]:
    """Return tangents of a gas and of a shift of all times, with a first axis (directions,).

    The first direction shifts all times. One direction follows for each number of the floats in
    `sizes`; the others are 0. There are 4, 8, 16, ... directions, so that few programs are
    compiled.
    """
    count = max(4, 1 << sum(sizes.values()).bit_length())
    along = jax.tree.map(lambda x: np.zeros((count, *x.shape), x.dtype), gas)
    begin = 1
    for name, size in sizes.items():
        numbers = along.value(name).reshape(count, size)  # a view: this changes `along`
        numbers[np.arange(begin, begin + size), np.arange(size)] = 1.0
        begin += size
    return along, np.eye(1, count)[0].astype(jnp.result_type(float))


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
    values = dict(linearise(simple, complete, times, ()).values)
    for name in ("displacement", "diffusion"):
        values.pop(name, None)
    return CoolingCurve(**as_jax_arrays({"times": times, "status": np.zeros((), int)} | values))


def _linearised(
    model: AbstractModel, gas: Gas, times: Array, tolerance: Array, gas_along: Gas, delay: Array
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Values of a curve, and their derivatives along directions."""
    curve, along = model.solve_with_tangents(gas, times, tolerance, gas_along, delay)
    values = {name: getattr(curve, name) for name in COMPUTED}
    slopes = {name: getattr(along, name) for name in LINEARISED}
    return _known(values), _known(slopes)


def _known(fields: dict[str, Array | None]) -> dict[str, Array]:
    return {name: value for name, value in fields.items() if value is not None}
