"""What a user asks of a fit, as a problem with a first guess of its unknowns."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import START_TIME, Measurement, Priors
from jaxgran.fitting.guesses import guess_from_data, guess_from_drops, guess_start_time
from jaxgran.fitting.measured_rows import curve_rows, with_rate_error
from jaxgran.fitting.parameters import known_start_time, with_values
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import CurveRows, DropRows
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

GUESSED_FROM_CURVES = ("dissipative_constant", "coefficient")
"""Parameters that curves guess better than drop tests."""


@dataclass(frozen=True)
class Request:
    """What a user asks of a fit, after all checks.

    Attributes:
        measurements: by label.
        model: the model.
        names: of the shared free parameters.
        separate: of those that each curve has separately.
        priors: of shared parameters and of each measurement.
        start: a further guess; None without one.
        quick: whether alternatives are left out.
    """

    measurements: dict[str, Measurement]
    model: AbstractModel
    names: tuple[str, ...]
    separate: tuple[str, ...]
    priors: dict[str, Priors]
    start: Gas | None
    quick: bool

    @property
    def free(self) -> tuple[str, ...]:
        """Names of all free parameters."""
        return (*self.names, *self.separate)

    @property
    def has_prior_of_t0(self) -> bool:
        """Whether t0 of some measurement has a prior."""
        return any(START_TIME in some for some in self.priors.values())


class Setup(NamedTuple):
    """A fit that is ready to be searched.

    Attributes:
        problem: with the errors of the model's cooling rate at the first guess.
        first: guess of the unknowns, in their unconstrained scale.
        notes: on the data.
    """

    problem: Problem
    first: Float[np.ndarray, "unknowns"]
    notes: list[str]


def build_problem(request: Request) -> Setup:
    """Return the problem of a fit, with a first guess from the data.

    Raises:
        ValueError: if the model cannot compute the scene, or the first guess.
    """
    rows, notes = _rows(request)
    problem = Problem.build(rows, request.model, request.names, request.separate, request.priors)
    guesses = _guesses(request, problem)
    first = problem.flatten(_values_of_guesses(problem, guesses))
    with ThreadPoolExecutor(1) as thread:  # two programs are compiled at the same time
        compiled = thread.submit(_compile_innovations, problem, first, _Configuration.current())
        problem = problem_with_rate_errors(problem, first)
        compiled.result()
    if request.start is not None:
        started = {
            label: with_values_of(guess, request.start, request.free)
            for label, guess in guesses.items()
        }
        first = _better(problem, first, problem.flatten(_values_of_guesses(problem, started)))
    problem.check_start(first)
    return Setup(problem, first, notes)


def _rows(request: Request) -> tuple[tuple[CurveRows | DropRows, ...], list[str]]:
    """Return the measurements as they are compared with the model, and notes on the data."""
    found: list[CurveRows | DropRows] = []
    notes: list[str] = []
    fits_T_0 = "temperature" in request.free
    fits_t0 = START_TIME in request.free or request.has_prior_of_t0
    for label, m in request.measurements.items():
        if isinstance(m.data, DropTest):
            found.append(DropRows(label, m))
            continue
        request.model.check_scene(m.gas if request.start is None else request.start)
        rows, of_rows = curve_rows(label, m, request.model, fits_T_0=fits_T_0, fits_t0=fits_t0)
        found.append(rows)
        notes += [f"{label}: {note}" if label else note for note in of_rows]
    return tuple(found), notes


def _guesses(request: Request, problem: Problem) -> dict[str, Gas]:
    """Return the gas of each measurement with guesses of its free parameters."""
    of_curves = {m.label: _guess_of_curve(request, m) for m in problem.curves}
    drops = [m for m in problem.measurements if isinstance(m, DropRows)]
    of_drops = {m.label: guess_from_drops(m.scene, m.data, request.free) for m in drops}
    guesses: dict[str, Gas] = {}
    for m in problem.measurements:
        if isinstance(m, CurveRows):
            guesses[m.label] = of_curves[m.label]
        elif of_curves:
            of_first_curve = of_curves[problem.curves[0].label]
            guesses[m.label] = with_values_of(m.gas, of_first_curve, request.names)
        else:
            guesses[m.label] = m.scene.replace(**of_drops[m.label])
    # A drop test overrides all guesses except for A and eps; the last one counts.
    better = {name: x for some in of_drops.values() for name, x in some.items()}
    for name in GUESSED_FROM_CURVES:
        better.pop(name, None)
    for label, gas in guesses.items():
        own = {name: x for name, x in better.items() if name in gas.domains}
        guesses[label] = gas.replace(**own)
    return guesses


def _guess_of_curve(request: Request, rows: CurveRows) -> Gas:
    """Return the gas of a measured curve with guesses of its free parameters."""
    curve = rows.curve
    if "temperature" in request.free:
        t0, _ = known_start_time(request.priors, rows.label)
        curve = replace(curve, times=np.asarray(curve.times) - np.asarray(t0))
    clock = (START_TIME,) if request.has_prior_of_t0 else ()
    return guess_from_data(rows.gas, curve, (*request.free, *clock))


def _better(problem: Problem, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the unknowns of lower -2 ln L, the first ones if both cannot be computed."""

    def misfit(flat: np.ndarray) -> tuple[bool, float]:
        value = problem.evaluate(flat).value
        return bool(np.isnan(value)), value

    return min((first, second), key=misfit)


class _Configuration(NamedTuple):
    """Configuration of JAX that a user may set for one thread alone."""

    x64: bool
    device: Any

    @classmethod
    def current(cls) -> "_Configuration":
        config: Any = jax.config
        return cls(config.jax_enable_x64, config.jax_default_device)


def _compile_innovations(problem: Problem, flat: np.ndarray, config: _Configuration) -> None:
    with jax.enable_x64(config.x64), jax.default_device(config.device):
        problem.compile_innovations(flat)


def problem_with_rate_errors(problem: Problem, flat: np.ndarray) -> Problem:
    """Return a problem with the errors of its model's cooling rate at some unknowns."""
    values = problem.unflatten(flat)

    def with_error(m: CurveRows | DropRows) -> CurveRows | DropRows:
        if isinstance(m, DropRows):
            return m
        own = {n: x for n, x in values[m.label].items() if n in m.scene.domains}
        return with_rate_error(m, problem.model, with_values(m.scene, own))

    return replace(problem, measurements=tuple(map(with_error, problem.measurements)))


def with_values_of(gas: Gas, other: Gas, names: tuple[str, ...]) -> Gas:
    """Return a gas with the values that another one has for some parameters."""
    known = {n: other.value(n) for n in names if n in other.domains and n in gas.domains}
    return gas.replace(**known)


def _values_of_guesses(problem: Problem, guesses: dict[str, Gas]) -> dict[str, dict[str, Any]]:
    """Return the values of gases and a guess of t0, by label and name."""
    values: dict[str, dict[str, Any]] = {label: gas.parameters for label, gas in guesses.items()}
    for m in problem.curves:
        names = tuple(u.name for u in problem.unknowns if u.applies_to(m.label))
        known = known_start_time(problem.priors, m.label)
        values[m.label][START_TIME] = guess_start_time(guesses[m.label], m.curve, names, known)
    return values
