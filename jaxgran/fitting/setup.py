"""What a user asks of a fit, as a problem with a first guess of its unknowns."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import START_TIME, Measurement, Priors
from jaxgran.fitting.parameters import (
    as_floats,
    guess_from_data,
    guess_from_drops,
    guess_start_time,
    known_start_time,
    with_parameters,
)
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import CurveRows, DropRows, curve_rows, with_rate_error
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

OF_CURVES = ("dissipative_constant", "coefficient")
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
        absent: effects that are known to be absent in all curves.
        quick: whether alternatives are left out.
    """

    measurements: dict[str, Measurement]
    model: AbstractModel
    names: tuple[str, ...]
    separate: tuple[str, ...]
    priors: dict[str, Priors]
    start: Gas | None
    absent: tuple[str, ...]
    quick: bool


def build_problem(request: Request) -> tuple[Problem, np.ndarray, list[str]]:
    """Return the problem of a fit, a first guess of its unknowns, and notes on the data."""
    model = request.model
    free = (*request.names, *request.separate)
    prior_names = {name for some in request.priors.values() for name in some}
    fits_t0 = START_TIME in (*free, *prior_names)
    measurements: list[CurveRows | DropRows] = []
    guesses: dict[str, Gas] = {}
    of_impacts: dict[str, Any] = {}
    notes: list[str] = []
    for label, m in request.measurements.items():
        if isinstance(m.data, DropTest):
            measurements.append(DropRows(label, m))
            values = guess_from_drops(m.gas, m.data, free)
            guesses[label] = m.gas.replace(**values)
            of_impacts |= {name: x for name, x in values.items() if name not in OF_CURVES}
            continue
        model.check_scene(m.gas if request.start is None else request.start)
        rows, more = curve_rows(label, m, model, fits_T_0="temperature" in free, fits_t0=fits_t0)
        notes += [f"{label}: {note}" if label else note for note in more]
        clocks = (START_TIME,) if START_TIME in prior_names else ()
        since = m.curve
        if "temperature" in free:
            known = known_start_time(request.priors, label)[0]
            since = replace(since, times=np.asarray(since.times) - np.asarray(known))
        guesses[label] = guess_from_data(rows.gas, since, (*free, *clocks))
        measurements.append(rows)
    problem = Problem.build(
        tuple(measurements), model, request.names, request.separate, request.priors
    )
    # Drop tests start from the values of the first curve.
    for m in measurements:
        if isinstance(m, DropRows) and problem.curves:
            shared = guesses[problem.curves[0].label]
            guesses[m.label] = with_values_of(m.gas, shared, request.names)
    # Parameters that impacts alone determine start from the drop tests.
    for label, gas in guesses.items():
        guesses[label] = gas.replace(**{n: x for n, x in of_impacts.items() if n in gas.domains})
    first = problem.flat(_values_of_guesses(problem, guesses))
    with ThreadPoolExecutor(1) as thread:  # two programs are compiled at the same time
        compiled = thread.submit(_compile_innovations, problem, first, *_configuration())
        problem = problem_with_rate_errors(problem, first)
        compiled.result()
    if request.start is not None:
        complete = {
            label: with_values_of(guess, request.start, free) for label, guess in guesses.items()
        }
        other = problem.flat(_values_of_guesses(problem, complete))
        starts = [(problem.evaluate(flat).value, flat) for flat in (first, other)]
        first = min(starts, key=lambda pair: (np.isnan(pair[0]), pair[0]))[1]
    return problem, first, notes


def _configuration() -> tuple[bool, Any]:
    """Return the configuration of JAX that a user may set for one thread alone."""
    config: Any = jax.config
    return config.jax_enable_x64, config.jax_default_device


def _compile_innovations(problem: Problem, flat: np.ndarray, x64: bool, device: Any) -> None:
    with jax.enable_x64(x64), jax.default_device(device):
        problem.compile_innovations(flat)


def problem_with_rate_errors(problem: Problem, flat: np.ndarray) -> Problem:
    """Return a problem with the errors of its model's cooling rate at some unknowns."""
    values = problem.values(flat)

    def with_error(m: CurveRows | DropRows) -> CurveRows | DropRows:
        if isinstance(m, DropRows):
            return m
        own = {n: x for n, x in values[m.label].items() if n in m.scene.domains}
        return with_rate_error(m, problem.model, with_parameters(m.scene, as_floats(own)))

    return replace(problem, measurements=tuple(map(with_error, problem.measurements)))


def with_values_of(gas: Gas, other: Gas, names: tuple[str, ...]) -> Gas:
    """Return a gas with the values that another one has for some parameters."""
    known = {n: other.value(n) for n in names if n in other.domains and n in gas.domains}
    return gas.replace(**known)


def _values_of_guesses(problem: Problem, guesses: dict[str, Gas]) -> dict[str, dict[str, Any]]:
    """Return the values of gases and a guess of t0, by label and name."""
    values: dict[str, dict[str, Any]] = {label: gas.parameters for label, gas in guesses.items()}
    for m in problem.curves:
        names = tuple(u.name for u in problem.unknowns if u.label in (None, m.label))
        known = known_start_time(problem.priors, m.label)
        values[m.label][START_TIME] = guess_start_time(guesses[m.label], m.curve, names, known)
    return values
