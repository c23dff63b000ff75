"""Checks of arguments and scenes, and descriptions of scenes, that several models share."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, is_known, known_part, nan_where
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run_options import Run
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.models.scales import scales_at
from jaxgran.scene.elements import (
    NUM_SPIN_COMPONENTS,
    VOLUME_TOLERANCE,
    Rough,
    check_elements,
    container_volume_ratio,
)
from jaxgran.scene.gas import Gas, is_allowed_spread
from jaxgran.scene.geometry import MIN_BOX, PACKING_LIMIT
from jaxgran.theory.steady_states import max_thermal_speed

CONTACT_LIMIT = 0.03
"""Contact duration over mean free time above which impacts are not instantaneous and binary."""

OVERLAP_LIMIT = 0.01
"""Mean overlap, in diameters, above which the first-order softness correction fails."""

CORRELATED_PACKING = {2: 0.4, 3: 0.25}
"""Packing fraction above which successive collisions are correlated, by dimension."""

CRYSTAL_PACKING = {2: 0.72, 3: 0.545}
"""Packing fraction above which hard disks and spheres are a crystal, by dimension."""

MAX_WALL_DISTANCE = 50.0
"""Distance of walls, in mean free paths, up to which theory was compared with hard spheres: the
error of the clock includes what was found (`jaxgran.models.error_model.WALL_ERROR`)."""

SOFT_SPHERES_NEEDED = "This scene needs soft spheres, which resolve every contact in time."
POSITIONS_NEEDED = "This scene needs particles with positions."


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
        typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
        if typed:
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
    with jax.ensure_compile_time_eval():
        hottest = 1.0 if gas.drive is None else float(_max_thermal_speed(gas))
    if isinstance(gas.surface, Rough):  # spins heat at most by all of their energy
        share = NUM_SPIN_COMPONENTS[gas.dimension] / gas.dimension
        ratio = float(gas.surface.rotational_temperature / gas.temperature)
        hottest = max(hottest, (1 + share * ratio) ** 0.5)
    highest = float(gas.temperature) * hottest**2
    check_softness_at(gas, hottest, float(scales_at(gas, highest).softness))


_max_thermal_speed = eqx.filter_jit(max_thermal_speed)


def check_softness_at(gas: Gas, speed: float, softness: float) -> None:
    """Raise ValueError if soft contacts would stop the cooling.

    Args:
        gas: the scene.
        speed: sqrt(T/T_0) at the highest temperature.
        softness: c X_T/sigma there.
    """
    if softness >= 1:
        overlap = float(scales_at(gas).overlap) * speed**0.8
        place = "T_0" if speed == 1 else f"{speed**2:.3g} T_0, to which the gas heats up"
        raise ValueError(
            f"spheres overlap by {overlap:.2g} diameters at {place}, where the softness "
            "correction is invalid. Check that youngs_modulus is in Pa, use SoftSpheres, or leave "
            '"softness" out of the corrections of KineticTheory.'
        )


def unreachable_with_drag(gas: Gas, times: Float[Array, "times"]) -> Bool[Array, "times"]:
    """Return a mask of the times that particle models with drag cannot reach.

    Raises:
        ValueError: if gas and times are known, and some times are too late.
    """
    if gas.drag is None:
        return jnp.zeros(times.shape, bool)
    limit = float(-0.5 * np.log(np.finfo(times.dtype).eps))  # beyond it 1 - gamma s is 0
    too_late = gas.drag.rate * times > limit
    if is_known(too_late) and np.any(np.asarray(too_late)):
        raise ValueError(
            f"drag has slowed the gas by exp(-{float(gas.drag.rate * times[-1]):.3g}) at the last "
            f"time; particle models are exact up to exp(-{limit:.3g}). "
            f"End before t = {limit / float(gas.drag.rate):.4g} s, or use KineticTheory()."
        )
    return too_late


def check_volume(gas: Gas, num_particles: int) -> None:
    """Raise ValueError if N spheres do not fill the container to the packing fraction."""
    walls = gas.container
    if walls is None or any_traced(walls.side, gas.packing_fraction, gas.diameter):
        return
    phi = float(gas.packing_fraction)
    share = container_volume_ratio(gas, num_particles)
    if abs(share - 1) > VOLUME_TOLERANCE:
        ways = (
            [f"enlarge the volume of the container by the factor {share:.4g}"] if share > 1 else []
        )
        if gas.domains["packing_fraction"].contains(phi * share):
            ways.append(f"set packing_fraction={phi * share:.4g}")
        if num_particles / share >= 2:
            ways.append(f"use {num_particles / share:.0f} particles")
        raise ValueError(
            f"{num_particles} spheres of packing_fraction {phi:.4g} need {share:.4g} times the "
            f"volume of the container with side {np.asarray(walls.side)} m: {', or '.join(ways)}."
        )


def refuse_files(model: AbstractModel, run: Run) -> None:
    """Raise ValueError if a compiled run should write files."""
    for name in ("checkpoint", "trajectory"):
        if (path := getattr(run, name)) is not None:
            raise ValueError(
                f"inside jax.jit and jax.vmap {type(model).__name__} cannot write a {name}, got "
                f"{str(path)!r}. Set {name}=None."
            )


def limitations_of_instant_impacts(
    gas: Gas, consequence: str = "which instantaneous impacts leave out"
) -> tuple[Limitation, ...]:
    """Return the limitations of a model of instantaneous, binary impacts.

    Args:
        gas: the scene.
        consequence: the relative clause about overlaps that are not small.
    """
    effects = []
    scales = scales_at(gas)
    if scales.contact_fraction > CONTACT_LIMIT:
        effects.append(
            f"contacts last {scales.contact_fraction:.2g} of the mean free time, so three spheres "
            "are often in contact at once"
        )
    if scales.overlap > OVERLAP_LIMIT:
        effects.append(
            f"spheres overlap by {100 * scales.overlap:.2g} % of a diameter, {consequence}"
        )
    return tuple(Limitation(words, True, SOFT_SPHERES_NEEDED) for words in effects)


def limitations_of_homogeneity(gas: Gas, num_particles: int | None) -> tuple[Limitation, ...]:
    """Return the limitations of a model of a homogeneous, uncorrelated gas.

    Args:
        gas: the scene.
        num_particles: N of the gas, which determines its box; None if unknown.
    """
    effects = []
    phi = float(gas.packing_fraction)
    limit = CORRELATED_PACKING[gas.dimension]
    if phi > limit:
        effects.append(
            f"the packing fraction {phi:.2g} is above {limit:g}, where successive collisions are "
            "correlated"
        )
    scales = scales_at(gas)
    if gas.container is not None:
        side = float(np.min(gas.container.side) / scales.mean_free_path)
        if side > MAX_WALL_DISTANCE:
            effects.append(
                f"walls are {side:.2g} mean free paths apart, and the gas is taken as mixed, which "
                f"was compared with hard spheres up to {MAX_WALL_DISTANCE:g}"
            )
    elif num_particles is not None:
        diameter = float(gas.diameter)
        box = scales.box_side(num_particles, gas.dimension)
        critical = float(scales.critical_box)
        if box > critical:
            effects.append(
                f"the box, {box / diameter:.3g} diameters, is above "
                f"L_c = {critical / diameter:.3g}: a flow grows, and clusters after it"
            )
    limitations = [Limitation(words, False, POSITIONS_NEEDED) for words in effects]
    limit = CRYSTAL_PACKING[gas.dimension]
    if phi > limit:
        words = (
            f"packing_fraction {phi:.3g} is above {limit:g}, where spheres form a crystal or a "
            "glass, and the contact value holds for a fluid"
        )
        limitations.append(Limitation(words, True, POSITIONS_NEEDED))
    return tuple(limitations)


def describe_walls(gas: Gas, num_particles: int) -> str:
    """Compare the box of N spheres with the mean free path, and estimate the effect of walls.

    A sphere of mean speed <v> meets walls ``2 d/L <|v_x|>/2`` times a second, with
    ``<|v_x|>/<v> = 1/2`` (2/pi in a plane).
    """
    scales = scales_at(gas)
    path = float(scales.mean_free_path)
    if gas.container is not None:
        apart = float(np.min(gas.container.side)) / path
        return f"has walls, {apart:.2g} mean free paths apart"
    length = scales.box_side(num_particles, gas.dimension) / path
    often = gas.dimension / length * {2: 2 / np.pi, 3: 0.5}[gas.dimension]
    return (
        f"is {length:.2g} mean free paths long: if it has walls, spheres meet them {often:.2g} "
        "times as often as each other, and the gas needs container=Walls(...)"
    )


def valid_where_traced(
    gas: Gas, times: Float[Array, "times"]
) -> tuple[Gas, Float[Array, "times"], Bool[Array, ""] | None]:
    """Replace a gas and times whose traced values are out of range by ones that models accept.

    Returns:
        The gas, nan where a traced parameter is out of range; the times, replaced if traced ones do
        not increase from 0 or later; and True if all values were allowed, None if nothing is
        traced.
    """
    if not any_traced(gas, times):
        return gas, times, None
    # Also values that are known and only carry a tangent, which `Gas` does not check.
    traced = {name: gas.value(name) for name in gas.domains}
    traced = {name: value for name, value in traced.items() if any_traced(value)}
    allowed = jnp.ones((), bool)
    for name, value in traced.items():
        allowed &= jnp.all(gas.domains[name].contains(value))
    if gas.container is not None:
        allowed &= jnp.all(gas.container.side / gas.diameter > MIN_BOX)
    if gas.diameter_sd is not None:
        allowed &= is_allowed_spread(gas.size_spread)
    one_or_nan = jnp.where(allowed, 1.0, jnp.nan)
    # A product, so that derivatives are nan, too: an optimiser would take 0 for a minimum.
    gas = gas.replace(**{name: x * one_or_nan.astype(x.dtype) for name, x in traced.items()})
    if any_traced(times):
        increase = jnp.all(jnp.diff(times) > 0) & (times[0] >= 0) & jnp.isfinite(times[-1])
        allowed &= increase
        times = jnp.where(increase, times, jnp.arange(1.0, 1.0 + times.size, dtype=times.dtype))
    return gas, times, allowed


def _allowed_gas(gas: Gas) -> Gas:
    """Return a gas of known numbers, with those out of range replaced by ones in the range."""
    gas = jax.tree.map(known_part, gas)
    wrong = {}
    for name, domain in gas.domains.items():
        value = gas.value(name)
        if not np.all(domain.contains(value)):
            inside = domain.low if domain.low_allowed else domain.from_free(0.0)
            wrong[name] = jnp.full_like(value, inside)
    return gas.replace(**wrong)


def unknown_curve(
    model: AbstractModel, gas: Gas, times: Float[Array, "times"], run: Run
) -> CoolingCurve:
    """Return a curve of the shapes of a run, which is nan, in the values and derivatives of a gas.

    It stands for a run with numbers that are known, and not allowed.
    """
    options = Run(run.key, save=run.save)
    model = model.sized_for(_allowed_gas(gas))
    shapes = eqx.filter_eval_shape(
        lambda gas, times: model.simulate(gas, times, options), gas, times
    )
    traced = (gas.value(name) for name in gas.domains)
    total = sum((jnp.sum(x) for x in traced if any_traced(x)), start=jnp.zeros(())) * jnp.nan

    def filled(shape: jax.ShapeDtypeStruct) -> Array:
        zeros = jnp.zeros(shape.shape, shape.dtype)
        return zeros + total.astype(shape.dtype) if eqx.is_inexact_array(zeros) else zeros

    return jax.tree.map(filled, shapes)


def nan_unless(
    allowed: Bool[Array, ""] | None, curve: CoolingCurve, times: Float[Array, "times"]
) -> CoolingCurve:
    """Return the curve, with all floats nan and a status if a value was not allowed."""
    if allowed is None:
        return curve
    fault = status.flag(status.OUT_OF_RANGE, ~allowed)
    masked = jax.tree.map(lambda x: nan_where(~allowed, x), curve)
    fault = fault if curve.status is None else jnp.where(allowed, curve.status, fault)
    return dataclasses.replace(masked, times=times, status=fault)


def check_packing(gas: Gas, num_particles: int, random: bool) -> None:
    """Raise ValueError if the gas is too dense for a random start, or the box too small."""
    if any_traced(gas.packing_fraction, gas.diameter):
        return
    limit = PACKING_LIMIT[gas.dimension]
    phi = float(jnp.max(gas.packing_fraction))
    if phi > limit and random:
        raise ValueError(
            f"packing_fraction {phi:.3g} is too dense for a fluid start, at most {limit:g} is "
            "allowed. Lower it, or give your own start."
        )
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
