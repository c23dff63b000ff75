"""Twins of an experiment: the values that it would measure if kinetic theory and a truth hold."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import WITH_ERRORS, CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import START_TIME, Measurement
from jaxgran.data.run_options import Run
from jaxgran.fitting.alternatives import Alternative
from jaxgran.fitting.kinds import (
    DRAG_ADDED,
    KINDS,
    ROUGHNESS_ADDED,
    WALLS_ADDED,
    FittedCurve,
    initial_rate,
)
from jaxgran.fitting.measured_rows import finite_size_cooling_factor
from jaxgran.fitting.parameters import as_floats, with_parameters
from jaxgran.fitting.result import Fit
from jaxgran.fitting.time_grid import time_grid
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import curve_of_program
from jaxgran.scene.elements import Rough, StokesDrag
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import symbol_of
from jaxgran.scene.walls import Walls

PARAMETER_SHIFT = float(np.log(1.5))
"""Shift of the first parameter of a truth, in the unconstrained scale: A is a guess."""

RATE_TIMES = np.geomspace(1e-2, 1e4, 100)
"""Times of the curve from which a cooling rate is taken, in mean free times."""

NUM_EFFECTS = 2
"""Number of truths that contain an effect of which the fit is not informed."""

ADDED_ELEMENTS: dict[str, Callable[[dict[str, float]], dict[str, Any]]] = {
    WALLS_ADDED: lambda values: {
        "container": Walls(values["wall_side"], restitution=values["wall_coefficient"])
    },
    DRAG_ADDED: lambda values: {"drag": StokesDrag(values["drag_rate"])},
    ROUGHNESS_ADDED: lambda values: {"surface": Rough(values["tangential_restitution"])},
}
"""Element of a gas, by field, from the values of the kind of alternatives that adds it."""


@dataclass(frozen=True)
class Truth:
    """A gas that may be the real one.

    Attributes:
        name: in words.
        shifts: of parameters, in their unconstrained scale, by name.
        effect: of `jaxgran.data.header_keys.ABSENT` that the scene lacks; "" without one.
        elements: of the gas, by field.
    """

    name: str
    shifts: dict[str, float] = field(default_factory=dict)
    effect: str = ""
    elements: dict[str, Any] = field(default_factory=dict)

    def gas(self, gas: Gas) -> Gas:
        """Return a gas with these shifts, and with the elements that it lacks."""
        values = {}
        for name, shift in self.shifts.items():
            domain = gas.domains[name]
            values[name] = domain.from_free(domain.to_free(np.asarray(gas.value(name))) + shift)
        if "diameter" in values:
            values["mass"] = gas.mass * (values["diameter"] / gas.diameter) ** 3
        added = {name: x for name, x in self.elements.items() if getattr(gas, name) is None}
        return replace(with_parameters(gas, as_jax_arrays(as_floats(values))), **added)


AS_GIVEN = Truth("as given")


class StrongestEffect(NamedTuple):
    """The effect that the data prefer, or that widens the range of a fit most.

    Attributes:
        truth: the gas with this effect.
        values: of the free parameters beside it, by name; {} for the values of the fit.
    """

    truth: Truth
    values: dict[str, np.ndarray]


def truths_of(measurement: Measurement, result: Fit) -> list[Truth]:
    """Return gases that may be the real one, the given one first.

    In two of them A, or another first parameter, is smaller and larger, and all that has a prior
    departs from it at random; in others the gas contains one of the effects that widen the range
    of the result, at half of the largest amplitude that the data allow.

    Args:
        measurement: of a curve, by kinetic theory.
        result: its fit.
    """
    gas = measurement.gas
    first = result.names[0]
    departures = _random_departures(measurement)
    truths = [AS_GIVEN]
    for sign, words in ((-1, "smaller"), (1, "larger")):
        shifts = {name: sign * shift for name, shift in departures.items()}
        if first in gas.domains:
            shifts[first] = sign * PARAMETER_SHIFT
        truths.append(Truth(f"{words} {symbol_of(first)}", shifts))
    curve = _computed_curve(gas)
    effects = [_with_effect(x, x.allowed[1] / 2, curve) for x in _widening(result)]
    return truths + [truth for truth in effects if truth is not None][:NUM_EFFECTS]


def _random_departures(measurement: Measurement) -> dict[str, float]:
    """Return one random error of each parameter with a prior, in its unconstrained scale."""
    domains = measurement.gas.domains
    rng = np.random.default_rng(0)
    departures = {}
    for name, (value, error) in measurement.priors.items():
        if name in domains:
            width = np.asarray(error) / domains[name].slope(np.asarray(value))
            departures[name] = float(np.max(width)) * rng.standard_normal()
    return departures


def strongest_effect(result: Fit) -> StrongestEffect | None:
    """Return the effect that the data prefer, or that widens the range most; None without one.

    Args:
        result: a fit of one curve.
    """
    curve = _computed_curve(result.gas)
    for alternative in result.alternatives:
        truth = _with_effect(alternative, alternative.amplitude, curve)
        if alternative.preferred and truth is not None:
            return StrongestEffect(truth, _values_by_name(result, alternative.estimate))
    for alternative in _widening(result):
        truth = _with_effect(alternative, alternative.allowed[1] / 2, curve)
        if truth is not None:
            return StrongestEffect(truth, {})
    return None


def _computed_curve(gas: Gas) -> FittedCurve:
    """Return what the amplitudes of alternatives to the curve of a gas are measured by."""
    times = np.append(0.0, RATE_TIMES * float(gas.mean_free_time))
    curve = curve_of_program(KineticTheory().simplified_for(gas), gas, times)
    T = np.asarray(curve.temperature)
    return FittedCurve(gas, initial_rate(times, np.log(T / T[0])), float(T[-1]))


def _values_by_name(result: Fit, estimate: np.ndarray) -> dict[str, np.ndarray]:
    """Return values of the free parameters of the gas, by name."""
    names = np.asarray(result.names_of_elements)
    return {
        name: estimate[names == name].reshape(np.shape(result.gas.value(name)))
        for name in result.names
        if name in result.gas.domains
    }


def _widening(result: Fit) -> list[Alternative]:
    """Return the effects that widen the range, the strongest first."""
    found = [x for x in result.alternatives if x.effect and not x.distinguishable]
    return sorted(found, key=lambda alternative: -alternative.error_reduction_needed)


def _with_effect(alternative: Alternative, amplitude: float, curve: FittedCurve) -> Truth | None:
    """Return a truth with an effect; None for one of amplitude 0, or not in `ADDED_ELEMENTS`."""
    if alternative.name not in ADDED_ELEMENTS or amplitude == 0:
        return None
    kind = next(kind for kind in KINDS if kind.name == alternative.name)
    elements = ADDED_ELEMENTS[kind.name](kind.values(amplitude, curve))
    return Truth(f"with {alternative.effect}", effect=alternative.effect, elements=elements)


def twin(measurement: Measurement, truth: Truth = AS_GIVEN) -> Measurement:
    """Return a measurement with the values of kinetic theory for a truth, without noise.

    The relative errors are taken from the given values; errors of values below 0 remain.

    Args:
        measurement: of a curve or a drop test.
        truth: what the gas really is.
    """
    gas = truth.gas(measurement.gas)
    data = measurement.data
    if isinstance(data, DropTest):
        return replace(measurement, data=_twin_of_impacts(data, gas))
    return replace(measurement, data=_twin_of_curve(measurement, gas), of_energy=False)


def _twin_of_impacts(drops: DropTest, gas: Gas) -> DropTest:
    values = {"restitution": drops.computed(gas)}
    if drops.is_oblique:
        values["tangential_restitution"] = drops.computed_tangential(gas)
    return replace(drops, **values)


def _twin_of_curve(measurement: Measurement, gas: Gas) -> CoolingCurve:
    """Return the measured quantities of a curve as a gas has them, with their relative errors."""
    measured = measurement.curve
    N = measurement.num_particles
    faster = 1.0 if N is None else float(finite_size_cooling_factor(measurement.gas, float(N)))
    t0 = float(measurement.priors.get(START_TIME, (0.0, 0.0))[0])
    elapsed = np.maximum(np.asarray(measured.times) - t0, 0.0) * faster
    times, place = time_grid(elapsed, float(gas.mean_free_time))
    model = KineticTheory()
    if measured.displacement is None:
        # As in the fit, whose alternatives have Gaussian spins where its spheres are smooth.
        computed = curve_of_program(model.simplified_for(measurement.gas), gas, times)
    else:
        computed = model.simulate(gas, as_jax_arrays(times), Run())
    fields: dict[str, Any] = {"times": np.asarray(measured.times)}
    for quantity in WITH_ERRORS:
        given = getattr(measured, quantity.field)
        if given is None:
            continue
        values = np.asarray(getattr(computed, quantity.field))[place]
        fields[quantity.field] = values
        error = getattr(measured, quantity.error.field)
        if error is not None:
            ratio = np.where(given > 0, values / np.where(given > 0, given, 1.0), 1.0)
            fields[quantity.error.field] = np.asarray(error) * ratio
    return replace(measured, **as_jax_arrays(fields))
