"""Additions to a planned experiment: each is a function of a measurement.

It returns the measurement with the addition, or None where the addition does not apply. A further
measurement is put `beside` the planned curve. The measured values do not matter: `jaxgran.plan`
computes them.
"""

import dataclasses
from collections.abc import Callable, Collection
from functools import partial
from itertools import chain, count
from typing import Any, NamedTuple

import numpy as np

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import START_TIME, Measurement, Priors
from jaxgran.scene.elements import Rough

Planned = Measurement | dict[str, Measurement]
"""An experiment: one measurement, or several by label."""

Change = Callable[[Measurement], Planned | None]
"""An addition to a planned measurement; it returns None where it does not apply."""

CURVE = "curve"
"""Label of the planned curve where further measurements are beside it."""

DURATIONS = (2.0, 4.0, 10.0)
"""Factors of the last time."""

MORE_GRAINS = 4
"""Factor of N."""

DENSITY_RATIO = 3.0
"""Ratio of the packing fractions of two experiments, the larger over the smaller."""

MAX_PACKING = 0.2
"""Largest packing fraction of a second experiment."""

ROTATION_ERROR = 0.05
"""Relative error of T_rot where T has none."""

WALL_ERROR = 0.02
"""Standard error of the restitution of the walls."""

BETA_ERROR = 0.05
"""Standard error of beta_t."""

NUM_IMPACTS = 20
"""Number of normal impacts."""

ANY_EPS = 0.9
"""Restitution of planned impacts, in place of which `jaxgran.plan` computes values."""

IMPACT_ERROR = 0.01
"""Standard error of eps of one impact."""

TANGENTIAL_ERROR = 0.02
"""Standard error of eps_t of one impact."""

IMPACT_ANGLES = (10.0, 75.0)
"""Smallest and largest angle of oblique impacts from the normal, degrees."""

IMPACT_SPEEDS = (0.3, 3.0)
"""Slowest and fastest impact, over the thermal speed sqrt(2 T) of the start."""

HOW_TO_SHOW_ABSENCE = {
    "walls": "a box so large, or a time so short, that no grain meets a wall twice",
    "roughness": "marked grains that do not begin to rotate",
    "drag": "a vacuum: below some 1 Pa for grains of 1 mm",
    "friction": "grains that do not slide at oblique impacts",
}
"""What shows that an effect is absent, which is the price of its declaration."""

ELEMENT_OF_EFFECT = {"walls": "container", "roughness": "surface", "drag": "drag"}
"""Element of a scene that an effect adds; friction is a property of the surface."""


class Candidate(NamedTuple):
    """An addition to an experiment.

    Attributes:
        name: in words.
        price: what it takes, in words.
        change: the addition as a function.
        kind: of the addition: two of one kind are not combined.
        is_fixed: whether it is an experiment of its own, which cannot be combined with others.
    """

    name: str
    price: str
    change: Change
    kind: str
    is_fixed: bool = False


def standard_candidates(measurement: Measurement) -> list[Candidate]:
    """Return the additions that apply to a planned curve."""
    t0 = _start_time(measurement)
    duration = float(measurement.curve.times[-1]) - t0
    box_factor = 2**measurement.gas.dimension
    found = [
        Candidate("T_rot measured", "the rotation of marked grains", with_rotation, "rotation"),
        *(
            Candidate(
                f"duration x {factor:g}",
                f"the last time at {t0 + factor * duration:.3g} s",
                partial(with_duration, factor=factor),
                "duration",
            )
            for factor in DURATIONS
        ),
        Candidate("twice the points", "twice as many frames", with_more_points, "errors"),
        Candidate(
            "half the errors",
            "four times as many frames or pixels",
            with_smaller_errors,
            "errors",
        ),
        Candidate(
            f"N x {MORE_GRAINS}",
            f"{MORE_GRAINS} times as many grains at this density",
            with_more_grains,
            "grains",
        ),
        Candidate(
            "container x 2",
            f"{box_factor} times as many grains at this density",
            in_larger_box,
            "box",
        ),
        Candidate(
            "a second density",
            "a second run",
            partial(beside, label="second density", further=second_density),
            "density",
        ),
        Candidate(
            f"eps_w known to +-{WALL_ERROR:g}",
            "drops of grains onto the wall",
            partial(with_prior, name="wall_coefficient", error=WALL_ERROR),
            "walls",
        ),
        Candidate(
            f"beta_t known to +-{BETA_ERROR:g}",
            "oblique impacts of single grains",
            partial(with_prior, name="tangential_restitution", error=BETA_ERROR),
            "roughness",
        ),
        Candidate(
            f"{NUM_IMPACTS} normal impacts",
            f"eps of each impact to +-{IMPACT_ERROR:g}, at {_impact_speeds(measurement)}",
            partial(beside, label="impacts", further=normal_impacts),
            "impacts",
        ),
        Candidate(
            f"{NUM_IMPACTS} oblique impacts",
            f"eps to +-{IMPACT_ERROR:g}, eps_t to +-{TANGENTIAL_ERROR:g}, at "
            f"{IMPACT_ANGLES[0]:g} to {IMPACT_ANGLES[1]:g} degrees from the normal",
            partial(beside, label="oblique impacts", further=oblique_impacts),
            "impacts",
        ),
        *(
            Candidate(f"no {name}: declared", price, partial(with_absence, effect=name), name)
            for name, price in HOW_TO_SHOW_ABSENCE.items()
        ),
    ]
    return [candidate for candidate in found if candidate.change(measurement) is not None]


def beside(
    measurement: Measurement, label: str, further: Callable[[Measurement], Measurement | None]
) -> dict[str, Measurement] | None:
    """Return a planned curve, and a further measurement of the same grains; None without it."""
    added = further(measurement)
    return None if added is None else {CURVE: measurement, label: added}


def with_rotation(measurement: Measurement) -> Measurement | None:
    """Return a measurement with T_rot, to the relative error of T."""
    curve = measurement.curve
    if measurement.gas.surface is None or curve.rotational_temperature is not None:
        return None
    error = curve.temperature_error
    error = ROTATION_ERROR * np.asarray(curve.temperature) if error is None else error
    return with_curve(
        measurement, rotational_temperature=curve.temperature, rotational_temperature_error=error
    )


def with_duration(measurement: Measurement, factor: float) -> Measurement:
    """Return a measurement whose last time is later; as many times lie between the ends.

    The logarithms of the times since the start keep their relative distances.
    """
    t0 = _start_time(measurement)
    times = np.array(measurement.curve.times) - t0
    after = times > 0
    logs = np.log(times[after])
    span = logs[-1] - logs[0]
    share = (logs - logs[0]) / span if span > 0 else np.ones_like(logs)
    times[after] *= factor**share
    return with_curve(measurement, times=times + t0)


def with_more_points(measurement: Measurement) -> Measurement | None:
    """Return a measurement of twice as many points: one of the same times, with the errors of the
    mean of two points."""
    if measurement.curve.temperature_error is None:
        return None
    return with_smaller_errors(measurement, 0.5**0.5)


def with_smaller_errors(measurement: Measurement, factor: float = 0.5) -> Measurement | None:
    """Return a measurement whose errors are multiplied by a factor."""
    curve = measurement.curve
    if curve.temperature_error is None:
        return None
    names = ("temperature_error", "rotational_temperature_error", "displacement_error")
    errors = {name: getattr(curve, name) for name in names}
    return with_curve(
        measurement, **{name: factor * x for name, x in errors.items() if x is not None}
    )


def with_more_grains(measurement: Measurement, factor: int = MORE_GRAINS) -> Measurement | None:
    """Return a measurement of more grains, in a larger container if there is one."""
    if measurement.num_particles is None:
        return None
    gas = measurement.gas
    priors = measurement.priors
    if gas.container is not None:
        longer = factor ** (1 / gas.dimension)
        gas = gas.replace(wall_side=longer * np.asarray(gas.value("wall_side")))
        priors = _with_scaled_prior(priors, "wall_side", longer)
    number = factor * measurement.num_particles
    return dataclasses.replace(measurement, gas=gas, num_particles=number, priors=priors)


def in_larger_box(measurement: Measurement) -> Measurement | None:
    """Return a measurement in a container twice as large, filled to the same density."""
    if measurement.gas.container is None:
        return None
    return with_more_grains(measurement, 2**measurement.gas.dimension)


def second_density(measurement: Measurement) -> Measurement:
    """Return a measurement of a denser gas or, near `MAX_PACKING`, of a more dilute one.

    A container stays, with more or fewer grains in it. As many collisions happen in the new times.
    """
    gas = measurement.gas
    ratio = DENSITY_RATIO
    if ratio * float(gas.packing_fraction) > MAX_PACKING:
        ratio = 1 / DENSITY_RATIO
    N = measurement.num_particles
    if gas.container is not None and N is not None:
        more = max(round(ratio * N), 1)
        ratio = more / N
        N = more
    second = dataclasses.replace(
        measurement,
        gas=gas.replace(packing_fraction=ratio * np.asarray(gas.packing_fraction)),
        num_particles=N,
        priors=_with_scaled_prior(measurement.priors, "packing_fraction", ratio),
    )
    t0 = _start_time(measurement)
    times = t0 + (np.asarray(measurement.curve.times) - t0) / ratio
    return with_curve(second, times=times)


def _with_scaled_prior(priors: Priors, name: str, factor: float) -> Priors:
    """Return priors in which a parameter, if it has one, and its error are multiplied."""
    if name not in priors:
        return priors
    value, error = priors[name]
    return priors | {name: (factor * value, factor * error)}


def with_prior(measurement: Measurement, name: str, error: float) -> Measurement | None:
    """Return a measurement with a parameter that is known better; None if it is so already."""
    gas = measurement.gas
    if name not in gas.domains:
        return None
    known = measurement.priors.get(name)
    is_better = known is not None and float(np.max(known[1])) > error
    if not (is_better or name in measurement.guesses):
        return None
    priors = measurement.priors | {name: (gas.value(name), error)}
    return dataclasses.replace(measurement, priors=priors)


def normal_impacts(measurement: Measurement) -> Measurement | None:
    """Return a drop test of normal impacts of two grains."""
    gas = measurement.gas
    if "friction" in gas.elements:
        return None
    speed = np.geomspace(*IMPACT_SPEEDS, NUM_IMPACTS) * _thermal_speed(measurement)
    eps = np.full(NUM_IMPACTS, ANY_EPS)
    return Measurement(gas, DropTest(speed, eps, np.full(NUM_IMPACTS, IMPACT_ERROR)))


def oblique_impacts(measurement: Measurement) -> Measurement | None:
    """Return a drop test of oblique impacts of two rough grains."""
    gas = measurement.gas
    if not isinstance(gas.surface, Rough):
        return None
    speed = np.full(NUM_IMPACTS, _thermal_speed(measurement))
    angle = np.radians(np.linspace(*IMPACT_ANGLES, NUM_IMPACTS))
    drops = DropTest(
        speed * np.cos(angle),
        np.full(NUM_IMPACTS, ANY_EPS),
        np.full(NUM_IMPACTS, IMPACT_ERROR),
        tangential_speed=speed * np.sin(angle),
        tangential_restitution=np.zeros(NUM_IMPACTS),
        tangential_error=np.full(NUM_IMPACTS, TANGENTIAL_ERROR),
    )
    return Measurement(gas, drops)


def with_absence(measurement: Measurement, effect: str) -> Measurement | None:
    """Return a measurement of which an effect is known to be absent; None if that is known."""
    gas = measurement.gas
    if effect == "friction":
        is_possible = gas.surface is not None and "friction" not in gas.domains
    else:
        is_possible = ELEMENT_OF_EFFECT[effect] not in gas.elements
    if effect in measurement.absent or not is_possible:
        return None
    return dataclasses.replace(measurement, absent=(*measurement.absent, effect))


def with_curve(measurement: Measurement, **fields: Any) -> Measurement:
    """Return a measurement with other fields of its curve."""
    curve = dataclasses.replace(measurement.curve, **as_jax_arrays(fields))
    return dataclasses.replace(measurement, data=curve)


def _start_time(measurement: Measurement) -> float:
    """Return the time at which a gas begins to cool, s, as it is known."""
    return float(measurement.priors.get(START_TIME, (0.0, 0.0))[0])


def _thermal_speed(measurement: Measurement) -> float:
    return float(np.sqrt(2 * measurement.gas.temperature))


def _impact_speeds(measurement: Measurement) -> str:
    low, high = (x * _thermal_speed(measurement) for x in IMPACT_SPEEDS)
    return f"{low:.2g} to {high:.2g} m/s"


def combined(first: Change, second: Change, measurement: Measurement) -> Planned | None:
    """Return a measurement with two additions.

    Where the first addition gives several measurements, the second one changes each curve of them.
    If the second one gives several, too, only those that it makes of the first curve are taken.

    Returns:
        None if the first addition does not apply, or the second one to none of its curves.
    """
    changed = first(measurement)
    if changed is None:
        return None
    if isinstance(changed, Measurement):
        return second(changed)
    labels = _labels_of_curves(changed)
    if not labels:
        return None
    both = {label: second(changed[label]) for label in labels}
    of_first_curve = both[labels[0]]
    if isinstance(of_first_curve, dict):
        return _with_added(changed, labels[0], of_first_curve)
    changed_twice = {label: m for label, m in both.items() if isinstance(m, Measurement)}
    return changed | changed_twice if changed_twice else None


def _with_added(
    measurements: dict[str, Measurement], label: str, added: dict[str, Measurement]
) -> dict[str, Measurement]:
    """Return measurements with those that an addition makes of the curve with a label.

    The first curve among the latter is this curve itself, and keeps its label.
    """
    of_curve = _labels_of_curves(added)[:1]
    result = dict(measurements)
    for name, m in added.items():
        if name in of_curve:
            result[label] = m
        else:
            result[_free_label(name, result)] = m
    return result


def _free_label(name: str, labels: Collection[str]) -> str:
    """Return a name, or the first of ``name 2``, ``name 3``, ... that is not among labels."""
    numbered = (f"{name} {number}" for number in count(2))
    return next(label for label in chain([name], numbered) if label not in labels)


def _labels_of_curves(measurements: dict[str, Measurement]) -> list[str]:
    return [label for label, m in measurements.items() if isinstance(m.data, CoolingCurve)]
