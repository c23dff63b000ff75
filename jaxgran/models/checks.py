"""Checks of a scene, and clauses about what it contains, that several models share."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, is_known
from jaxgran.data.curve import CoolingCurve, Run
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.particles.run import MIN_BOX
from jaxgran.particles.setup import PACKING_LIMIT
from jaxgran.scene.elements import SAME_VOLUME, share_of_container
from jaxgran.scene.gas import Gas
from jaxgran.theory.averages import impact_moments as exact_averages
from jaxgran.theory.equations import hottest_speed, softness_factor

CONTACT_LIMIT = 0.03
"""Contact duration over mean free time above which impacts are not instantaneous and binary."""

OVERLAP_LIMIT = 0.01
"""Mean overlap, in diameters, above which the first-order softness correction fails."""

CORRELATED_PACKING = {2: 0.4, 3: 0.25}
"""Packing fraction above which successive collisions are correlated."""

SOFT_SPHERES_NEEDED = "This scene needs soft spheres, which resolve every contact in time."
POSITIONS_NEEDED = "This scene needs particles with positions."


def checked_gas(gas: Any) -> Gas:
    """The gas, if it is one.

    Raises:
        ValueError: for anything else, and for a batch of gases outside of `jax.vmap`.
    """
    if not isinstance(gas, Gas):
        raise ValueError(f"gas must be a jaxgran.Gas, got {type(gas).__name__}")
    gas.check_single()
    return gas


MODEL_LIST = "there are KineticTheory(), DSMC(N), HardSpheres(N) and SoftSpheres(N)"
"""The models of this package, in an error."""


def checked_model(model: Any) -> AbstractModel:
    """The model, if it is one; else ValueError."""
    if isinstance(model, AbstractModel):
        return model
    if isinstance(model, type) and issubclass(model, AbstractModel):
        raise ValueError(
            f"model must be a model, got the class {model.__name__}: make one of it; {MODEL_LIST}"
        )
    raise ValueError(f"model must be a model, of which {MODEL_LIST}; got {model!r:.60}")


def checked_key(key: Any) -> PRNGKeyArray | None:
    """The key of random numbers, if it is one; else ValueError."""
    if key is None:
        return key
    if isinstance(key, jax.Array):
        typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
        if typed or (key.dtype == jnp.uint32 and key.ndim == 1):
            return key
    raise ValueError(f"key must be a key such as jax.random.key(5), got {key!r:.60}")


def check_cools(rate: ArrayLike) -> None:
    """Raise ValueError where a `first_cooling_rate` is negative: the law of restitution heats."""
    if not isinstance(rate, Tracer) and np.any(np.asarray(rate) < 0):
        raise ValueError(
            "the law of restitution makes this gas heat up: averaged over its impacts, eps is "
            "above 1 (a truncated series beyond its range); lower T_0 or A, or use another law"
        )


@eqx.filter_jit
def first_cooling_rate(gas: Gas, averages: Callable = exact_averages) -> Float[Array, ""]:
    """``-d ln T/dt`` at t = 0, 1/s, of the Maxwellian gas; negative if the law heats it."""
    mu_2 = averages(gas.reduced_law, jnp.ones_like(gas.temperature), gas.dimension)[0, 0]
    return 2 / gas.dimension * mu_2 * gas.impact_speed / gas.path_length


@eqx.filter_jit
def initial_cooling(gas: Gas, averages: Callable) -> tuple[Array, Array, Array]:
    """The first cooling rate, the softness factor where it is hottest, and sqrt(T/T_0) there."""
    one = jnp.ones_like(gas.temperature)
    hottest = one if gas.drive is None else hottest_speed(gas)
    factor = softness_factor(gas.reduced_law, hottest, gas.dimension)
    return first_cooling_rate(gas, averages), factor, hottest


def check_softness(gas: Gas, factor: ArrayLike, hottest: ArrayLike = 1.0) -> None:
    """Raise ValueError where the factor by which soft contacts slow the cooling is not positive.

    Args:
        gas: the scene.
        factor: at the highest temperature.
        hottest: the square root of that temperature over T_0.
    """
    if not isinstance(factor, Tracer) and np.any(np.asarray(factor) <= 0):
        speed = float(np.max(np.asarray(hottest)))
        overlap = float(np.max(gas.mean_overlap)) * speed**0.8
        place = "T_0" if speed == 1 else f"{speed**2:.3g} T_0, to which the gas heats up"
        raise ValueError(
            f"spheres overlap by {overlap:.2g} diameters at {place}, where "
            "the softness correction has no meaning; is youngs_modulus in Pa? If so use "
            "SoftSpheres, or KineticTheory(softness=False)"
        )


def max_drag_exponent(dtype: Any) -> float:
    """Largest gamma t up to which particle models follow drag: ``1 - gamma s`` is rounded."""
    return float(-0.5 * np.log(np.finfo(dtype).eps))


def unreachable_with_drag(gas: Gas, times: Float[Array, "times"]) -> Bool[Array, "times"]:
    """Which times are too late for particle models to follow drag.

    Raises:
        ValueError: if gas and times are known, and some are too late.
    """
    if gas.drag is None:
        return jnp.zeros(times.shape, bool)
    most = max_drag_exponent(times.dtype)
    beyond = gas.drag.rate * times > most
    if is_known(beyond) and np.any(np.asarray(beyond)):
        raise ValueError(
            f"drag has slowed the gas by exp(-{float(gas.drag.rate * times[-1]):.3g}) at the last "
            f"time, where particle models, which follow it in transformed time, are exact up to "
            f"exp(-{most:.3g}): end before t = {most / float(gas.drag.rate):.4g} s, or use "
            "KineticTheory()"
        )
    return beyond


def check_volume(gas: Gas, num_particles: int) -> None:
    """Raise ValueError for a container too large or small for N spheres of a packing fraction."""
    walls = gas.container
    if walls is None or any_traced(walls.side, gas.packing_fraction, gas.diameter):
        return
    phi, share = float(gas.packing_fraction), share_of_container(gas, num_particles)
    if abs(share - 1) > SAME_VOLUME:
        raise ValueError(
            f"{num_particles} spheres of packing_fraction {phi:.4g} need a container {share:.4g} "
            f"times as large as that of side {np.asarray(walls.side)} m: give packing_fraction="
            f"{phi * share:.4g} or {num_particles / share:.0f} particles"
        )


def refuse_files(model: AbstractModel, run: Run) -> None:
    """Raise ValueError for files, where a model's run is compiled and can write none."""
    for name in ("checkpoint", "trajectory"):
        if (path := getattr(run, name)) is not None:
            raise ValueError(
                f"inside jax.jit and jax.vmap {type(model).__name__} writes no {name}: leave "
                f"{name} out, got {str(path)!r}"
            )


def limitations_of_instant_impacts(
    gas: Gas, beyond: str = "which instantaneous impacts leave out"
) -> tuple[Limitation, ...]:
    """What a model of instantaneous, binary impacts leaves out of a scene.

    Args:
        gas: the scene.
        beyond: the clause about overlaps that are not small.
    """
    found = []
    duration, overlap = float(gas.contact_fraction), float(gas.mean_overlap)
    if duration > CONTACT_LIMIT:
        found.append(
            f"contacts last {duration:.2g} of the mean free time, so spheres meet three at a time"
        )
    if overlap > OVERLAP_LIMIT:
        found.append(f"spheres overlap by {100 * overlap:.2g} % of a diameter, {beyond}")
    return tuple(Limitation(words, True, SOFT_SPHERES_NEEDED) for words in found)


def limitations_of_homogeneity(gas: Gas, num_particles: int | None) -> tuple[Limitation, ...]:
    """What a model of a homogeneous, uncorrelated gas leaves out of a scene.

    Args:
        gas: the scene.
        num_particles: N of the gas, which tells its box; None if unknown.
    """
    found = []
    phi, limit = float(gas.packing_fraction), CORRELATED_PACKING[gas.dimension]
    if phi > limit:
        found.append(
            f"the packing fraction {phi:.2g} is above {limit:g}, where successive collisions are "
            "correlated"
        )
    if gas.container is not None:
        side = float(np.min(gas.container.side) / gas.mean_free_path)
        found.append(f"walls are {side:.2g} mean free paths apart, and the gas is taken for mixed")
    elif num_particles is not None:
        diameter = float(gas.diameter)
        box, critical = float(gas.box_side(num_particles)), float(gas.critical_box)
        if box > critical:
            found.append(
                f"the box, {box / diameter:.3g} diameters, is above "
                f"L_c = {critical / diameter:.3g}: a flow grows, and clusters after it"
            )
    return tuple(Limitation(words, False, POSITIONS_NEEDED) for words in found)


def describe_walls(gas: Gas, num_particles: int) -> str:
    """How long the box of N spheres is beside the mean free path, and what walls would be there.

    A sphere of mean speed <v> meets walls ``2 d/L <|v_x|>/2`` times a second, with
    ``<|v_x|>/<v> = 1/2`` (2/pi in a plane).
    """
    long = float(gas.box_side(num_particles) / gas.mean_free_path)
    if gas.container is not None:
        return f"has walls, {long:.2g} mean free paths apart"
    often = gas.dimension / long * {2: 2 / np.pi, 3: 0.5}[gas.dimension]
    return (
        f"is {long:.2g} mean free paths long: if it has walls, spheres meet them {often:.2g} times "
        "as often as others, and container=Walls(...) must be told"
    )


def valid_where_traced(
    gas: Gas, times: Float[Array, "times"]
) -> tuple[Gas, Float[Array, "times"], Bool[Array, ""] | None]:
    """A gas and times that every model can take, where traced ones lie outside their ranges.

    Returns:
        The gas, nan where a traced float is out of range; the times, replaced if traced ones do not
        increase from 0 or later; and whether all was allowed, None if nothing is traced.
    """
    if all(map(is_known, (times, *jax.tree.leaves(gas)))):
        return gas, times, None
    traced = {name: gas.value(name) for name in gas.domains}
    traced = {name: value for name, value in traced.items() if not is_known(value)}
    allowed = jnp.ones((), bool)
    for name, value in traced.items():
        allowed &= jnp.all(gas.domains[name].contains(value))
    held = {name: jnp.where(allowed, value, jnp.nan) for name, value in traced.items()}
    gas = gas.replace(**held)
    if not is_known(times):
        increase = jnp.all(jnp.diff(times) > 0) & (times[0] >= 0) & jnp.isfinite(times[-1])
        allowed &= increase
        times = jnp.where(increase, times, jnp.arange(1.0, 1.0 + times.size, dtype=times.dtype))
    return gas, times, allowed


def nan_unless(
    allowed: Bool[Array, ""] | None, curve: CoolingCurve, times: Float[Array, "times"]
) -> CoolingCurve:
    """The curve, nan and with a status unless all was allowed."""
    if allowed is None:
        return curve
    fault = status.flag(status.OUT_OF_RANGE, ~allowed)
    spoilt = jax.tree.map(
        lambda x: jnp.where(allowed, x, jnp.nan) if eqx.is_inexact_array(x) else x, curve
    )
    fault = fault if curve.status is None else jnp.where(allowed, curve.status, fault)
    return dataclasses.replace(spoilt, times=times, status=fault)


def check_packing(gas: Gas, num_particles: int, random: bool) -> None:
    """Raise ValueError for a gas too dense for a random start, or a box too small."""
    if isinstance(gas.packing_fraction, Tracer) or isinstance(gas.diameter, Tracer):
        return
    limit, phi = PACKING_LIMIT[gas.dimension], float(jnp.max(gas.packing_fraction))
    if phi > limit and random:
        raise ValueError(
            f"packing_fraction {phi:.3g} is too dense for a fluid start, at most {limit:g}; "
            "lower it, or give your own start"
        )
    side = float(jnp.min(gas.box_side(num_particles) / gas.diameter))
    if side < MIN_BOX:
        raise ValueError(
            f"the box is {side:.3g} diameters long, at least {MIN_BOX} are needed to tell "
            "a sphere from its image; use more particles or a lower packing_fraction"
        )
