"""Kinds of alternative explanations of a measured curve: what is added, and by how much."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.comparison import FLOOR, WHITE
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import CurveRows
from jaxgran.models.error_model import ROUGHNESS_ERROR, SLIDING_ERROR
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import VISCOELASTIC_EXPONENT

SHARES = (0.05, 0.15, 0.35, 0.6, 0.85, 0.97)
"""Amplitudes of walls, as shares of the initial cooling rate, and of a noise floor, as shares of
the lowest computed temperature."""

DRAG_SHARES = (0.001, 0.005, 0.02, 0.06, 0.2, 0.5, 0.9)
"""Amplitudes of drag, as shares of the initial cooling rate; its share grows as the gas cools."""

ROUGHNESS = (0.02, 0.08, 0.25, 0.6, 1.0, 1.4, 1.75, 1.9)
"""Values of 1 + beta_t of rough spheres."""

SLIDING = (0.3, 1.0, 2.5, 6.0, 15.0)
"""Values of 1/mu of rough spheres that slide."""

FRICTION = (0.02, 0.04, 0.06, 0.15, 0.4, 1.0)
"""Values of mu of smooth spheres that become rough and slide."""

STICKING_RESTITUTION = 0.44
"""beta_t of these, where they stick: that of glass (.44) and acetate (.43) beads, Foerster et al.,
Phys. Fluids 6, 1108 (1994)."""

DELAYS = (0.003, 0.02, 0.1, 0.3)
"""Errors of the start of the clock, over the initial cooling time, of both signs."""

SPREADS = (0.02, 0.05, 0.1, 0.15)
"""Standard deviations of eps from impact to impact."""

WHITE_ERRORS = (0.002, 0.006, 0.02, 0.06)
"""Relative standard deviations of independent errors of T."""

WALL_RESTITUTION = 0.5
"""Restitution of the walls of an alternative; the side of the box is its amplitude."""

WALL_RATE_ERROR = 0.007
"""Relative error of theory's mean cooling rate until T has fallen to a fifth, if walls take all of
the energy (`jaxgran.models.error_model.WALL_ERROR`)."""

MIN_WALL_SIDE = 4.0
"""Smallest side of that box, in diameters."""

DECLARABLE = {
    "walls": ("wall_side", "container_side, wall_restitution"),
    "roughness": ("tangential_restitution", "beta_t, T_rot"),
    "drag": ("drag_rate", "gamma"),
    "friction": ("friction", "friction"),
}
"""Parameter of each of the effects `jaxgran.data.header.ABSENT`, and what describes it in a
file."""

SCENE_PARAMETERS = tuple(parameter for parameter, _ in DECLARABLE.values())
"""The parameters of elements of a scene, beside which second effects are tried."""

WALLS_ADDED = "walls that dissipate energy"
DRAG_ADDED = "linear drag, as in air"
ROUGHNESS_ADDED = "rough grains without initial rotation"
"""Names of alternatives that add one element to the scene."""


class Kind(NamedTuple):
    """Kind of alternative.

    Attributes:
        name: in words.
        parameters: the parameters that it adds; the first one identifies the effect.
        amplitudes: values that are tried, in one or two increasing sequences from 0.
        values: values of parameters at an amplitude, given the label of the measurement.
        rate_error: relative error of kinetic theory's cooling rate by it, at an amplitude.
        one_minimum: False if amplitudes beyond excluded ones may be allowed.
        changes_law: whether it is in the law of impacts, which drop tests obey, too.
        keeps_A: False if A has no meaning in it: it is not part of the range.
    """

    name: str
    parameters: tuple[str, ...]
    amplitudes: tuple[tuple[float, ...], ...]
    values: Callable[[float, str], dict[str, float]]
    rate_error: Callable[[float], float] = lambda amplitude: 0.0
    one_minimum: bool = True
    changes_law: bool = False
    keeps_A: bool = True


def kinds_of(problem: Problem, flat: np.ndarray, absent: tuple[str, ...]) -> list[Kind]:
    """Return the kinds of alternatives to a fit."""
    if not problem.curves:
        return []
    scenes = {m.label: m.scene for m in problem.curves}
    values = problem.values(flat)
    curves = problem.evaluate(flat).curves
    rates = {m.label: _initial_rate(m, values[m.label], curves[m.label]) for m in problem.curves}
    lowest = {
        m.label: float(np.min(curves[m.label]["temperature"][m.used[:, 0] > 0]))
        for m in problem.curves
    }

    def walls(share: float, label: str) -> dict[str, float]:
        side = side_of_walls(scenes[label], share * rates[label])
        return {"wall_side": side, "wall_coefficient": WALL_RESTITUTION}

    beta_t = "tangential_restitution"
    possible = [
        Kind(
            WALLS_ADDED,
            ("wall_side",),
            (SHARES,),
            walls,
            lambda share: WALL_RATE_ERROR * share,
        ),
        Kind(
            DRAG_ADDED,
            ("drag_rate",),
            (DRAG_SHARES,),
            lambda share, label: {"drag_rate": share * rates[label] / 2},
        ),
        Kind(
            "a noise floor in T", (FLOOR,), (SHARES,), lambda x, label: {FLOOR: x * lowest[label]}
        ),
        Kind("independent errors of T", (WHITE,), (WHITE_ERRORS,), lambda x, label: {WHITE: x}),
        Kind(
            ROUGHNESS_ADDED,
            (beta_t,),
            (ROUGHNESS,),
            lambda x, label: {beta_t: x - 1},
            lambda x: ROUGHNESS_ERROR * min(x, 1.0),
        ),
        Kind(
            "rough grains that slide",
            (beta_t, "friction"),
            (FRICTION,),
            lambda x, label: {beta_t: STICKING_RESTITUTION, "friction": x},
            lambda x: SLIDING_ERROR * x,
            one_minimum=False,
        ),
    ]
    if all(beta_t in gas.domains for gas in scenes.values()):
        sliding = Kind(
            "grains that slide",
            ("friction",),
            (SLIDING,),
            lambda x, label: {"friction": 1 / x},
            changes_law=True,
        )
        possible.append(sliding)
    known = {u.name for u in problem.unknowns}
    if all("exponent" in m.gas.domains for m in problem.curves):
        spread = Kind(
            "eps that scatters from impact to impact",
            ("spread",),
            (SPREADS,),
            lambda x, label: {"spread": x},
            changes_law=True,
        )
        constant = Kind(
            "a constant coefficient of restitution",
            ("exponent",),
            ((1.0,),),
            lambda x, label: {"exponent": VISCOELASTIC_EXPONENT * (1 - x)},
            changes_law=True,
            keeps_A=False,
        )
        possible.append(spread)
        if "dissipative_constant" in known:
            possible.append(constant)
    if not known & {START_TIME, "temperature"}:
        delay = Kind(
            "an error of the start time or of T_0",
            (START_TIME,),
            (DELAYS, tuple(-x for x in DELAYS)),
            lambda share, label: {START_TIME: -share / rates[label]},
        )
        possible.append(delay)
    if all(np.any(m.errors[:, 0] > 0) for m in problem.curves):
        known.add(WHITE)
    known |= {DECLARABLE[name][0] for name in absent}
    known |= {name for gas in scenes.values() for name in gas.domains}
    supported = {FLOOR, WHITE, START_TIME}.union(*(m.gas.domains for m in problem.curves))
    for m in problem.curves:  # spheres of unequal sizes have neither walls nor roughness
        supported &= {FLOOR, WHITE, START_TIME, *m.gas.domains}
    return [
        kind
        for kind in possible
        if known.isdisjoint(kind.parameters) and supported.issuperset(kind.parameters)
    ]


def side_of_walls(gas: Gas, rate: float) -> float:
    """Return the side of a box whose walls, of restitution `WALL_RESTITUTION`, cool a gas.

    Args:
        gas: the gas.
        rate: cooling rate by the walls at the start, 1/s.
    """
    flux = 2 * np.sqrt(float(gas.temperature) / (2 * np.pi))
    side = 2 * (1 - WALL_RESTITUTION**2) * flux / max(rate, 1e-300) + float(gas.diameter)
    return max(side, MIN_WALL_SIDE * float(gas.diameter))


def _initial_rate(m: CurveRows, values: dict[str, Any], curve: dict[str, Any]) -> float:
    """Return the cooling rate at the start of a fitted curve, from the time in which T halves."""
    T_0 = float(values.get("temperature", m.scene.temperature))
    times = np.asarray(m.curve.times) - float(values.get(START_TIME, 0.0))
    log_T = np.log(curve["temperature"] / T_0)
    fallen = np.flatnonzero((log_T < -np.log(2)) & (times > 0))
    at = fallen[0] if fallen.size else -1
    cooled = np.expm1(-0.6 * min(log_T[at], -1e-6))  # 1 + t/tau = T^(-3/5)
    return float(5 / 3 * cooled / max(times[at], 1e-300))
