"""Additions to a planned experiment: each is a function of a measurement.

It returns the measurement with the addition, a dictionary of several measurements by label, or None
where the addition does not apply. The values of T do not matter: `jaxgran.plan` computes them.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.data.header_keys import ABSENT
from jaxgran.data.measurement import START_TIME, Measurement
from jaxgran.scene.elements import Rough

CURVE = "curve"
"""Label of the planned curve among several measurements."""

Planned = Measurement | dict[str, Measurement]
Change = Callable[[Measurement], Planned | None]

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


class Candidate(NamedTuple):
    """An addition to an experiment.

    Attributes:
        name: in words.
        price: what it takes, in words.
        change: the addition as a function.
        kind: of the addition: two of one kind are not combined.
    """

    name: str
    price: str
    change: Change
    kind: str


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
        Candidate("half the errors", "four times as many frames or pixels", with_errors, "errors"),
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
        Candidate("a second density", "a second run", with_second_density, "density"),
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
            with_impacts,
            "impacts",
        ),
        Candidate(
            f"{NUM_IMPACTS} oblique impacts",
            f"eps to +-{IMPACT_ERROR:g}, eps_t to +-{TANGENTIAL_ERROR:g}, at "
            f"{IMPACT_ANGLES[0]:g} to {IMPACT_ANGLES[1]:g} degrees from the normal",
            with_oblique_impacts,
            "impacts",
        ),
        *(
            Candidate(f"no {name}: declared", price, partial(with_absence, effect=name), name)
            for name, price in HOW_TO_SHOW_ABSENCE.items()
        ),
    ]
    return [candidate for candidate in found if candidate.change(measurement) is not None]


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
    share = (logs - logs[0]) / (logs[-1] - logs[0])
    times[after] *= factor**share
    return with_curve(measurement, times=times + t0)


def _start_time(measurement: Measurement) -> float:
    """Return the time at which a gas begins to cool, s, as it is known."""
    return float(measurement.priors.get(START_TIME, (0.0, 0.0))[0])


def with_more_points(measurement: Measurement) -> Measurement | None:
    """Return a measurement of twice as many points: one of the same times, with the errors of the
    mean of two points."""
    if measurement.curve.temperature_error is None:
        return None
    return with_errors(measurement, 0.5**0.5)


def with_errors(measurement: Measurement, factor: float = 0.5) -> Measurement | None:
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
    priors = dict(measurement.priors)
    if gas.container is not None:
        longer = factor ** (1 / gas.dimension)
        gas = gas.replace(wall_side=longer * np.asarray(gas.value("wall_side")))
        if "wall_side" in priors:
            value, error = priors["wall_side"]
            priors["wall_side"] = longer * value, longer * error
    number = factor * measurement.num_particles
    return dataclasses.replace(measurement, gas=gas, num_particles=number, priors=priors)


def in_larger_box(measurement: Measurement) -> Measurement | None:
    """Return a measurement in a container twice as large, filled to the same density."""
    if measurement.gas.container is None:
        return None
    return with_more_grains(measurement, 2**measurement.gas.dimension)


def with_second_density(measurement: Measurement) -> dict[str, Measurement]:
    """Return the curve, and one of a denser gas or, near `MAX_PACKING`, of a more dilute one.

    A container stays, with more or fewer grains in it.
    """
    gas = measurement.gas
    ratio = DENSITY_RATIO
    if ratio * float(gas.packing_fraction) > MAX_PACKING:
        ratio = 1 / DENSITY_RATIO
    second = dataclasses.replace(
        measurement, gas=gas.replace(packing_fraction=ratio * np.asarray(gas.packing_fraction))
    )
    if "packing_fraction" in measurement.priors:
        value, error = measurement.priors["packing_fraction"]
        priors = measurement.priors | {"packing_fraction": (ratio * value, ratio * error)}
        second = dataclasses.replace(second, priors=priors)
    N = measurement.num_particles
    if gas.container is not None and N is not None:
        second = dataclasses.replace(second, num_particles=max(round(ratio * N), 1))
    t0 = _start_time(measurement)
    times = t0 + (np.asarray(measurement.curve.times) - t0) / ratio  # as many collisions
    return {CURVE: measurement, "second density": with_curve(second, times=times)}


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


def with_impacts(measurement: Measurement) -> dict[str, Measurement] | None:
    """Return the curve, and a drop test of normal impacts of two grains."""
    gas = measurement.gas
    if "friction" in gas.elements:
        return None
    thermal = float(np.sqrt(2 * gas.temperature))
    speed = np.geomspace(*IMPACT_SPEEDS, NUM_IMPACTS) * thermal
    eps = np.full(NUM_IMPACTS, 0.9)
    drops = DropTest(speed, eps, np.full(NUM_IMPACTS, IMPACT_ERROR))
    return {CURVE: measurement, "impacts": Measurement(gas, drops)}


def with_oblique_impacts(measurement: Measurement) -> dict[str, Measurement] | None:
    """Return the curve, and a drop test of oblique impacts of two rough grains."""
    gas = measurement.gas
    if not isinstance(gas.surface, Rough):
        return None
    thermal = float(np.sqrt(2 * gas.temperature))
    speed = np.full(NUM_IMPACTS, thermal)
    angle = np.radians(np.linspace(*IMPACT_ANGLES, NUM_IMPACTS))
    drops = DropTest(
        speed * np.cos(angle),
        np.full(NUM_IMPACTS, 0.9),
        np.full(NUM_IMPACTS, IMPACT_ERROR),
        tangential_speed=speed * np.sin(angle),
        tangential_restitution=np.zeros(NUM_IMPACTS),
        tangential_error=np.full(NUM_IMPACTS, TANGENTIAL_ERROR),
    )
    return {CURVE: measurement, "oblique impacts": Measurement(gas, drops)}


def with_absence(measurement: Measurement, effect: str) -> Measurement | None:
    """Return a measurement of which an effect is known to be absent."""
    gas = measurement.gas
    present = {"walls": "container", "roughness": "surface", "drag": "drag"}
    if effect in measurement.absent or present.get(effect) in gas.elements:
        return None
    slides = gas.surface is not None and "friction" not in gas.domains
    if effect == "friction" and not slides:
        return None
    assert effect in ABSENT
    return dataclasses.replace(measurement, absent=(*measurement.absent, effect))


def combined(first: Change, second: Change, measurement: Measurement) -> Planned | None:
    """Return a measurement with two additions; None if one of them does not apply."""
    changed = first(measurement)
    if isinstance(changed, Measurement):
        return second(changed)
    if changed is None:
        return None
    curves = _curves_of(changed)
    if not curves:
        return None
    both = {label: second(changed[label]) for label in curves}
    main = both[curves[0]]
    if not isinstance(main, dict):
        return changed | {label: m for label, m in both.items() if isinstance(m, Measurement)}
    # Its first curve is the planned one, which has a label already.
    added = dict(main)
    for label in _curves_of(main)[:1]:
        changed = changed | {curves[0]: added.pop(label)}
    return changed | {label + " 2" * (label in changed): m for label, m in added.items()}


def _curves_of(measurements: dict[str, Measurement]) -> list[str]:
    """Return the labels of measured curves."""
    return [label for label, m in measurements.items() if isinstance(m.data, CoolingCurve)]


def with_curve(measurement: Measurement, **fields: Any) -> Measurement:
    """Return a measurement with other fields of its curve."""
    curve = dataclasses.replace(measurement.curve, **as_jax_arrays(fields))
    return dataclasses.replace(measurement, data=curve)


def _impact_speeds(measurement: Measurement) -> str:
    thermal = float(np.sqrt(2 * measurement.gas.temperature))
    low, high = (x * thermal for x in IMPACT_SPEEDS)
    return f"{low:.2g} to {high:.2g} m/s"
