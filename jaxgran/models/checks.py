"""Checks of the arguments and scenes that several models, `cool`, sweeps and fits share."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxgran._utils.tracing import any_traced
from jaxgran.models.base import AbstractModel
from jaxgran.models.scales import scales_at
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS, Rough, check_elements
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import MIN_BOX, PACKING_LIMIT
from jaxgran.scene.walls import VOLUME_TOLERANCE, container_volume_ratio
from jaxgran.theory.steady_states import max_thermal_speed

_max_thermal_speed = eqx.filter_jit(max_thermal_speed)


def checked_gas(gas: Any) -> Gas:
    """Return the gas.

    Raises:
        ValueError: if it is not a `Gas`, or a batch outside of `jax.vmap`, or a parameter is out of
            range.
    """
    if not isinstance(gas, Gas):
        raise ValueError(f"gas must be a jaxgran.Gas, got {type(gas).__name__}")
    gas.check_single()
    for name, value in gas.parameters.items():  # changed by equinox.tree_at, they were not checked
        gas.domains[name].check(name, value)
    gas.check_sizes()
    check_elements(gas)
    return gas


def checked_model(model: Any) -> AbstractModel:
    """Return the model. Raise ValueError if it is not an instance of `AbstractModel`."""
    if isinstance(model, AbstractModel):
        return model
    if isinstance(model, type) and issubclass(model, AbstractModel):
        fields = [field.name for field in dataclasses.fields(model)]
        arguments = "N" if "num_particles" in fields else ""
        raise ValueError(
            f"model must be an instance, got the class {model.__name__}; "
            f"did you mean {model.__name__}({arguments})?"
        )
    raise ValueError(
        f"model must be a jaxgran model, got {model!r:.60}. "
        "Use KineticTheory(), DSMC(N), HardSpheres(N) or SoftSpheres(N)."
    )


def checked_key(key: Any) -> PRNGKeyArray | None:
    """Return the typed key of random numbers, or None. Raise ValueError for anything else."""
    if key is None:
        return key
    if isinstance(key, jax.Array):
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0:
            return key
        if key.dtype == jnp.uint32 and key.ndim == 1:
            return jax.random.wrap_key_data(key)
    raise ValueError(f"key must be a key such as jax.random.key(5), got {key!r:.60}")


def check_cools(gas: Gas) -> None:
    """Raise ValueError for a law with eps < 0, or one that heats, in a gas of known numbers."""
    if any_traced(gas):
        return
    scales = scales_at(gas)
    if not scales.lowest_restitution >= 0:
        raise ValueError(
            f"the law of restitution gives eps = {scales.lowest_restitution:.3g} at a speed of "
            "impacts in this gas, but eps must be a number >= 0: limit it, as in "
            "jnp.clip(eps, 0.0, 1.0), or lower T_0"
        )
    if scales.cooling_rate < 0:
        raise ValueError(
            "the law of restitution makes this gas heat up: its mean eps over impacts is above 1 "
            "(a truncated series beyond its range). Lower T_0 or A, or use another law."
        )


def check_softness(gas: Gas) -> None:
    """Raise ValueError if soft contacts would stop the cooling, at T_0 or at the highest T."""
    check_softness_at(gas, _highest_temperature_ratio(gas))


def _highest_temperature_ratio(gas: Gas) -> float:
    """Return the largest T/T_0 to which a drive or spins may heat a gas."""
    ratio = 1.0
    if gas.drive is not None:
        with jax.ensure_compile_time_eval():
            ratio = float(_max_thermal_speed(gas)) ** 2
    if isinstance(gas.surface, Rough):  # spins heat at most by all of their energy
        share = NUM_SPIN_COMPONENTS[gas.dimension] / gas.dimension
        heated = 1 + share * float(gas.surface.rotational_temperature / gas.temperature)
        ratio = max(ratio, heated)
    return ratio


def check_softness_at(gas: Gas, ratio: float) -> None:
    """Raise ValueError if soft contacts would stop the cooling at the temperature ratio T/T_0."""
    scales = scales_at(gas, ratio * float(gas.temperature))
    if scales.softness >= 1:
        place = "T_0" if ratio == 1 else f"{ratio:.3g} T_0, to which the gas heats up"
        raise ValueError(
            f"spheres overlap by {scales.overlap:.2g} diameters at {place}, where the softness "
            "correction is invalid. Check that youngs_modulus is in Pa, use SoftSpheres, or leave "
            '"softness" out of the corrections of KineticTheory.'
        )


def check_packing(gas: Gas) -> None:
    """Raise ValueError if a gas is too dense for a random start, which is a fluid."""
    if any_traced(gas.packing_fraction):
        return
    limit = PACKING_LIMIT[gas.dimension]
    phi = float(jnp.max(gas.packing_fraction))
    if phi > limit:
        raise ValueError(
            f"packing_fraction {phi:.3g} is too dense for a fluid start, at most {limit:g} is "
            "allowed. Lower it, or give your own start."
        )


def check_box_side(gas: Gas, num_particles: int) -> None:
    """Raise ValueError if the box of N spheres is too small."""
    if any_traced(gas.packing_fraction, gas.diameter):
        return
    side = float(jnp.min(gas.box_side(num_particles) / gas.diameter))
    if side == 0:
        raise ValueError(
            f"diameter {float(jnp.min(gas.diameter)):g} m is so small that the volume of a sphere "
            f"is 0 in {gas.diameter.dtype}. Check its unit."
        )
    if side < MIN_BOX:
        raise ValueError(
            f"the box is {side:.3g} diameters long, at least {MIN_BOX} are needed to distinguish "
            "a sphere from its image. Use more particles or a lower packing_fraction."
        )


def check_volume(gas: Gas, num_particles: int) -> None:
    """Raise ValueError if N spheres do not fill the container to the packing fraction."""
    walls = gas.container
    if walls is None or any_traced(walls.side, gas.packing_fraction, gas.diameter):
        return
    phi = float(gas.packing_fraction)
    share = container_volume_ratio(gas, num_particles)
    if abs(share - 1) > VOLUME_TOLERANCE:
        ways = []
        if share > 1:
            ways.append(f"enlarge the volume of the container by the factor {share:.4g}")
        if gas.domains["packing_fraction"].contains(phi * share):
            ways.append(f"set packing_fraction={phi * share:.4g}")
        if num_particles / share >= 2:
            ways.append(f"use {num_particles / share:.0f} particles")
        raise ValueError(
            f"{num_particles} spheres of packing_fraction {phi:.4g} need {share:.4g} times the "
            f"volume of the container with side {np.asarray(walls.side)} m: {', or '.join(ways)}."
        )
