"""Twins of an experiment: the values that it would measure if kinetic theory and a truth hold."""

import dataclasses
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import START_TIME, Measurement
from jaxgran.fitting.alternatives import Alternative
from jaxgran.fitting.kinds import (
    DRAG_ADDED,
    ROUGHNESS_ADDED,
    WALL_RESTITUTION,
    WALLS_ADDED,
    initial_rate,
    side_of_walls,
)
from jaxgran.fitting.measured_rows import finite_size_cooling_factor
from jaxgran.fitting.parameters import as_floats, with_parameters
from jaxgran.fitting.prediction import times_with_nodes
from jaxgran.fitting.result import Fit
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import curve_of_program
from jaxgran.scene.elements import Rough, StokesDrag, Walls
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import symbol_of

PARAMETER_SHIFT = float(np.log(1.5))
"""Shift of the first parameter of a truth, in the unconstrained scale: A is a guess."""

RATE_TIMES = np.geomspace(1e-2, 1e4, 100)
"""Times of the curve from which a cooling rate is taken, in mean free times."""

NUM_EFFECTS = 2
"""Number of truths that contain an effect of which the fit is not informed."""


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
    rng = np.random.default_rng(0)
    known = {}
    for name, (value, error) in measurement.priors.items():
        if name in gas.domains:
            width = np.asarray(error) / gas.domains[name].slope(np.asarray(value))
            known[name] = float(np.max(width)) * rng.standard_normal()
    first = result.names[0]
    truths = [AS_GIVEN]
    for sign, words in ((-1, "smaller"), (1, "larger")):
        shifts = {name: sign * shift for name, shift in known.items()}
        shifts |= {first: sign * PARAMETER_SHIFT} if first in gas.domains else {}
        truths.append(Truth(f"{words} {symbol_of(first)}", shifts))
    rate = _cooling_rate(gas)
    effects = [_with_effect(x, x.allowed[1] / 2, gas, rate) for x in _widening(result)]
    return truths + [truth for truth in effects if truth is not None][:NUM_EFFECTS]


def strongest_effect(result: Fit) -> tuple[Truth, dict[str, np.ndarray]] | None:
    """Return a gas with the effect that the data prefer, or that widens the range most.

    Args:
        result: a fit of one curve.

    Returns:
        The truth, and values of the free parameters with it; None without such an effect.
    """
    gas = result.gas
    rate = _cooling_rate(gas)
    for alternative in result.alternatives:
        truth = _with_effect(alternative, alternative.amplitude, gas, rate)
        if alternative.preferred and truth is not None:
            return truth, _values_by_name(result, alternative.estimate)
    for alternative in _widening(result):
        truth = _with_effect(alternative, alternative.allowed[1] / 2, gas, rate)
        if truth is not None:
            return truth, {}
    return None


def _cooling_rate(gas: Gas) -> float:
    """Return the cooling rate of a gas at the start, 1/s, as amplitudes of alternatives mean it."""
    times = np.append(0.0, RATE_TIMES * float(gas.mean_free_time))
    curve = curve_of_program(KineticTheory().simplified_for(gas), gas, times)
    T = np.asarray(curve.temperature)
    return initial_rate(times, np.log(T / T[0]))


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


def _with_effect(alternative: Alternative, amplitude: float, gas: Gas, rate: float) -> Truth | None:
    """Return a truth with an effect; None for effects of several parameters.

    Args:
        alternative: the effect.
        amplitude: its size.
        gas: the scene.
        rate: its cooling rate at the start, 1/s.
    """
    elements: dict[str, Any] = {}
    if alternative.name == WALLS_ADDED:
        side = side_of_walls(gas, amplitude * rate)
        elements["container"] = Walls(side, restitution=WALL_RESTITUTION)
    elif alternative.name == DRAG_ADDED:
        elements["drag"] = StokesDrag(amplitude * rate / 2)
    elif alternative.name == ROUGHNESS_ADDED:
        elements["surface"] = Rough(amplitude - 1)
    if not elements or amplitude == 0:
        return None
    return Truth(f"with {alternative.effect}", {}, alternative.effect, elements)


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
        values = {"restitution": data.computed(gas)}
        if data.is_oblique:
            values["tangential_restitution"] = data.computed_tangential(gas)
        return replace(measurement, data=replace(data, **values))
    N = measurement.num_particles
    faster = 1.0 if N is None else float(finite_size_cooling_factor(measurement.gas, float(N)))
    t0 = float(measurement.priors.get(START_TIME, (0.0, 0.0))[0])
    elapsed = np.maximum(np.asarray(data.times) - t0, 0.0) * faster
    times, place = times_with_nodes(elapsed, float(gas.mean_free_time))
    model = KineticTheory()
    # The program of the fit, whose alternatives have Gaussian spins where its spheres are smooth.
    of_fit = model.simplified_for(measurement.gas)
    curve = curve_of_program(of_fit, gas, times)
    if data.displacement is not None:
        curve = model.simulate(gas, as_jax_arrays(times))
    fields: dict[str, Any] = {}
    for name in ("temperature", "rotational_temperature", "displacement"):
        given = getattr(data, name)
        error = getattr(data, f"{name}_error")
        if given is None:
            continue
        fields[name] = np.asarray(getattr(curve, name))[place]
        if error is not None:
            scale = np.where(given > 0, fields[name] / np.where(given > 0, given, 1.0), 1.0)
            fields[f"{name}_error"] = np.asarray(error) * scale
    known = as_jax_arrays({"times": np.asarray(data.times)} | fields)
    data = dataclasses.replace(data, **known)
    return replace(measurement, data=data, of_energy=False)
