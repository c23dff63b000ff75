"""Kinds of alternative explanations of a measured curve: what is added, and by how much."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import FLOOR, WHITE, CurveRows, DropRows, has_no_measured_errors
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
"""beta_t of these, where they stick: as for glass (.44) and acetate (.43) beads, Foerster et al.,
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


class Declarable(NamedTuple):
    """An effect of the scene that a user may declare absent.

    Attributes:
        parameter: the parameter that identifies it.
        keys: what describes it in a file.
    """

    parameter: str
    keys: str


DECLARABLE = {
    "walls": Declarable("wall_side", "container_side, wall_restitution"),
    "roughness": Declarable("tangential_restitution", "beta_t, T_rot"),
    "drag": Declarable("drag_rate", "gamma"),
    "friction": Declarable("friction", "friction"),
}
"""The effects `jaxgran.data.header_keys.ABSENT`."""

WALLS_ADDED = "walls that dissipate energy"
DRAG_ADDED = "linear drag, as in air"
ROUGHNESS_ADDED = "rough grains without initial rotation"
"""Names of alternatives that add one element to the scene."""


class FittedCurve(NamedTuple):
    """What the amplitudes of alternatives to a fitted curve are measured by.

    Attributes:
        scene: the gas of the measurement.
        rate: cooling rate of the fitted curve at the start, 1/s.
        lowest: lowest computed T, m^2/s^2.
    """

    scene: Gas
    rate: float
    lowest: float


@dataclass(frozen=True, eq=False)
class Kind:
    """Kind of alternative.

    Attributes:
        name: in words.
        parameters: the parameters that it adds; the first one identifies the effect.
        amplitudes: values that are tried, in one or two increasing sequences from 0.
        values: values of parameters at an amplitude, beside a fitted curve; parameters of a law of
            impacts do not depend on the curve.
        amplitude_sets: the parameter that the amplitude sets, if it is not the first one.
        applies: whether it is an alternative for a curve that may have its parameters, given the
            names of the curve's unknowns.
        rate_error: relative error of kinetic theory's cooling rate by it, at an amplitude.
        one_minimum: False if amplitudes beyond excluded ones may be allowed.
        changes_law: whether it is in the law of impacts, which drop tests obey, too.
        keeps_A: False if A has no meaning in it: it is not part of the range.
        curves: the fitted curves that it changes, by label; {} in `KINDS`.
    """

    name: str
    parameters: tuple[str, ...]
    amplitudes: tuple[tuple[float, ...], ...]
    values: Callable[[float, FittedCurve], dict[str, float]]
    amplitude_sets: str = ""
    applies: Callable[[CurveRows, set[str]], bool] = lambda rows, unknowns: True
    rate_error: Callable[[float], float] = lambda amplitude: 0.0
    one_minimum: bool = True
    changes_law: bool = False
    keeps_A: bool = True
    curves: dict[str, FittedCurve] = field(default_factory=dict)

    @property
    def varied(self) -> str:
        """The parameter that the amplitude sets."""
        return self.amplitude_sets or self.parameters[0]

    @property
    def effects(self) -> tuple[str, ...]:
        """Names in `DECLARABLE` of what it adds: none for an error or another law of impacts."""
        return tuple(x for x, known in DECLARABLE.items() if known.parameter in self.parameters)

    def values_by_label(self, problem: Problem, amplitude: float) -> dict[str, dict[str, float]]:
        """Return the values of parameters in each measurement that it changes."""
        if not self.changes_law:
            return {label: self.values(amplitude, x) for label, x in self.curves.items()}
        any_curve = next(iter(self.curves.values()))
        return {m.label: self.values(amplitude, any_curve) for m in problem.measurements}

    def with_wider_rate_errors(self, problem: Problem, amplitude: float) -> Problem:
        """Return a problem with its error of the cooling rate added, in the curves it changes."""
        error = self.rate_error(amplitude)

        def widened(m: CurveRows | DropRows) -> CurveRows | DropRows:
            if isinstance(m, CurveRows) and m.label in self.curves:
                return m.with_wider_rate_error(error)
            return m

        return replace(problem, measurements=tuple(map(widened, problem.measurements)))


def _walls(share: float, curve: FittedCurve) -> dict[str, float]:
    side = side_of_walls(curve.scene, share * curve.rate)
    return {"wall_side": side, "wall_coefficient": WALL_RESTITUTION}


def _is_rough(rows: CurveRows, unknowns: set[str]) -> bool:
    return "tangential_restitution" in rows.scene.domains


def _is_viscoelastic(rows: CurveRows, unknowns: set[str]) -> bool:
    return "exponent" in rows.gas.domains


def _is_viscoelastic_of_free_A(rows: CurveRows, unknowns: set[str]) -> bool:
    return _is_viscoelastic(rows, unknowns) and "dissipative_constant" in unknowns


def _start_is_known(rows: CurveRows, unknowns: set[str]) -> bool:
    return unknowns.isdisjoint({START_TIME, "temperature"})


def _has_no_errors(rows: CurveRows, unknowns: set[str]) -> bool:
    return has_no_measured_errors(rows)


KINDS = (
    Kind(
        name=WALLS_ADDED,
        parameters=("wall_side",),
        amplitudes=(SHARES,),
        values=_walls,
        rate_error=lambda share: WALL_RATE_ERROR * share,
    ),
    Kind(
        name=DRAG_ADDED,
        parameters=("drag_rate",),
        amplitudes=(DRAG_SHARES,),
        values=lambda share, curve: {"drag_rate": share * curve.rate / 2},
    ),
    Kind(
        name="a noise floor in T",
        parameters=(FLOOR,),
        amplitudes=(SHARES,),
        values=lambda share, curve: {FLOOR: share * curve.lowest},
    ),
    Kind(
        name="independent errors of T",
        parameters=(WHITE,),
        amplitudes=(WHITE_ERRORS,),
        values=lambda error, curve: {WHITE: error},
        applies=_has_no_errors,
    ),
    Kind(
        name=ROUGHNESS_ADDED,
        parameters=("tangential_restitution",),
        amplitudes=(ROUGHNESS,),
        values=lambda x, curve: {"tangential_restitution": x - 1},
        rate_error=lambda x: ROUGHNESS_ERROR * min(x, 1.0),
    ),
    Kind(
        name="rough grains that slide",
        parameters=("tangential_restitution", "friction"),
        amplitude_sets="friction",
        amplitudes=(FRICTION,),
        values=lambda x, curve: {
            "tangential_restitution": STICKING_RESTITUTION,
            "friction": x,
        },
        rate_error=lambda x: SLIDING_ERROR * x,
        one_minimum=False,
    ),
    Kind(
        name="grains that slide",
        parameters=("friction",),
        amplitudes=(SLIDING,),
        values=lambda x, curve: {"friction": 1 / x},
        applies=_is_rough,
        changes_law=True,
    ),
    Kind(
        name="eps that scatters from impact to impact",
        parameters=("spread",),
        amplitudes=(SPREADS,),
        values=lambda x, curve: {"spread": x},
        applies=_is_viscoelastic,
        changes_law=True,
    ),
    Kind(
        name="a constant coefficient of restitution",
        parameters=("exponent",),
        amplitudes=((1.0,),),
        values=lambda x, curve: {"exponent": VISCOELASTIC_EXPONENT * (1 - x)},
        applies=_is_viscoelastic_of_free_A,
        changes_law=True,
        keeps_A=False,
    ),
    Kind(
        name="an error of the start time or of T_0",
        parameters=(START_TIME,),
        amplitudes=(DELAYS, tuple(-x for x in DELAYS)),
        values=lambda share, curve: {START_TIME: -share / curve.rate},
        applies=_start_is_known,
    ),
)
"""All kinds of alternatives: a further explanation is a further row."""


def kinds_of(problem: Problem, flat: np.ndarray) -> list[Kind]:
    """Return the kinds of alternatives to a fit.

    Each one changes the curves whose files do not say whether they have its effect; one in the law
    of impacts changes all measurements, or none.

    Args:
        problem: of the fit.
        flat: the fitted unknowns, in their unconstrained scale.
    """
    curves = _fitted_curves(problem, flat)
    kinds = []
    for kind in KINDS:
        changed = {m.label: curves[m.label] for m in problem.curves if _is_open(kind, problem, m)}
        if changed and (len(changed) == len(curves) or not kind.changes_law):
            kinds.append(replace(kind, curves=changed))
    return kinds


def _is_open(kind: Kind, problem: Problem, rows: CurveRows) -> bool:
    """Tell whether a curve may have what an alternative adds, without its file saying so."""
    unknowns = {u.name for u in problem.unknowns if u.applies_to(rows.label)}
    absent = {DECLARABLE[name].parameter for name in rows.measurement.absent}
    described = unknowns | absent | {*rows.scene.domains}
    # Spheres of unequal sizes have neither walls nor roughness.
    supported = {FLOOR, WHITE, START_TIME, *rows.gas.domains}
    return (
        described.isdisjoint(kind.parameters)
        and supported.issuperset(kind.parameters)
        and kind.applies(rows, unknowns)
    )


def _fitted_curves(problem: Problem, flat: np.ndarray) -> dict[str, FittedCurve]:
    values = problem.unflatten(flat)
    computed = problem.evaluate(flat).curves
    curves = {}
    for m in problem.curves:
        T = computed[m.label]["temperature"]
        T_0 = float(values[m.label].get("temperature", m.scene.temperature))
        t0 = float(values[m.label].get(START_TIME, 0.0))
        curves[m.label] = FittedCurve(
            scene=m.scene,
            rate=initial_rate(np.asarray(m.curve.times) - t0, np.log(T / T_0)),
            lowest=float(np.min(T[m.used[:, 0] > 0])),
        )
    return curves


def initial_rate(times: Float[np.ndarray, "n"], log_T: Float[np.ndarray, "n"]) -> float:
    """Return the cooling rate -d ln T/dt at the start, 1/s, from the time in which T halves.

    Between the start and this time Haff's law of viscoelastic spheres is taken to hold,
    ``T/T_0 = (1 + t/tau)^(-5/3)``, whose rate at the start is ``5/(3 tau)``. Where T does not
    halve, the last time is taken.

    Args:
        times: since the start, s.
        log_T: ln T/T_0 at these times.

    Reference: Brilliantov & Poeschel, Phys. Rev. E 61, 5573 (2000).
    """
    halved = np.flatnonzero((log_T < -np.log(2)) & (times > 0))
    at = halved[0] if halved.size else -1
    time_over_tau = np.expm1(-0.6 * min(log_T[at], -1e-6))
    return float(5 / 3 * time_over_tau / max(times[at], 1e-300))


def side_of_walls(gas: Gas, rate: float) -> float:
    """Return the side of a box whose walls, of restitution `WALL_RESTITUTION`, cool a gas.

    Args:
        gas: the gas.
        rate: cooling rate by the walls at the start, 1/s.
    """
    flux = 2 * np.sqrt(float(gas.temperature) / (2 * np.pi))
    side = 2 * (1 - WALL_RESTITUTION**2) * flux / max(rate, 1e-300) + float(gas.diameter)
    return max(side, MIN_WALL_SIDE * float(gas.diameter))
