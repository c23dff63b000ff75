"""A measurement: what was measured, the gas that it was measured of, and what is known of both."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.formatting import text_table
from jaxgran._utils.validation import (
    ANY,
    FRACTION,
    NON_NEGATIVE,
    POSITIVE,
    Domain,
    check_bool,
    checked_float,
    checked_int,
    float_array,
)
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.data.header_keys import ABSENT
from jaxgran.data.quantities import QUANTITIES
from jaxgran.scene.gas import Gas

START_TIME = "t0"
"""Name of the time, on the clock of the measurement, at which the gas had its temperature T_0 and
began to cool: the only parameter of a fit that is not a parameter of a gas."""

DENSITY = "density"
"""Name of the prior of the mass over the volume of a sphere, which is not a parameter of a gas."""

SMALLEST = 1e-30
"""Smallest value of a measurement that is allowed, SI."""

LARGEST = 1e30
"""Largest value of a measurement that is allowed, SI."""

MIN_ERROR = 1e-12
"""Smallest allowed relative error of a measurement."""

Priors = dict[str, tuple[Float[Array, "..."], Float[Array, "..."]]]
"""Known values and their standard errors, SI, by name, as `Measurement` takes them."""


class Measurement(eqx.Module):
    """A measured curve or drop test, with the gas and all that is known of both.

    Args:
        gas: the scene. Its values of parameters that a fit estimates are not used where the data
            give a guess (A, T_0, a constant restitution); the others are the guess.
        data: the measured `CoolingCurve`, or a `DropTest` of spheres of this gas. Without errors of
            T, a relative error that is the same at all times is estimated from the scatter.
        num_particles: N of the measured gas, if known. It gives the errors due to the randomness of
            single collisions and due to a flow that grows in the box, and corrects a model without
            noise for the faster cooling of few particles (a particle model needs as many particles
            as were measured).
        replicas: number of runs over which the curve is a mean. Errors of such a mean come from the
            grains and are left out, unless `errors_measured`.
        priors: known values and standard errors, SI, by name, as
            ``{"packing_fraction": (0.05, 0.002)}``: of parameters of the gas, of "density", which
            lets the mass vary, or of "t0". Each is Gaussian in the unconstrained scale (the
            logarithm of a positive parameter).
        absent: effects that are known to be absent, of "walls", "roughness", "drag" and "friction":
            a fit does not consider them as explanations of the curve.
        tracked: number of grains of each run that T is the mean of, if it is less than N: T then
            has a sampling error in addition. None if T is the mean over all grains.
        ensemble_start: True if T_0 of the gas is the temperature of an ensemble from which the
            initial velocities were drawn; False if it is the temperature of this run at its start.
        calibration_error: relative standard error of the scale of T, common to all times.
        errors_measured: True if the errors of the data are errors of measurement. Errors of T of
            one run that equal ``sqrt(2/(d N)) T`` are otherwise taken for the fluctuation of
            independent samples and left out, since the fluctuations of N grains are known.
        of_energy: True if T is the mean energy over the mean mass, ``<m v^2>/(d <m>)``, and not
            ``<v^2>/d``: the two differ for spheres of unequal sizes.
        rounding: last digit of a field of the curve as it was written, SI, one number or one for
            each time, as ``{"temperature": 1e-6}``; {} if all are exact.
        guesses: parameters of the gas whose values are guesses, which a fit must estimate.
        header: header of the file from which it was read, pairs of a key and a text, in SI.

    Raises:
        ValueError: naming the wrong field, what was given, what is allowed.

    >>> measured = jaxgran.CoolingCurve([0.1, 1.0, 3.0], [8e-3, 2e-3, 5e-4])
    >>> jaxgran.Measurement(gas, measured, num_particles=250).replicas
    1
    """

    gas: Gas
    data: CoolingCurve | DropTest
    num_particles: int | None = eqx.field(static=True, default=None)
    replicas: int = eqx.field(static=True, default=1)
    priors: Priors = eqx.field(default_factory=dict)
    absent: tuple[str, ...] = eqx.field(static=True, default=())
    tracked: int | None = eqx.field(static=True, default=None)
    ensemble_start: bool = eqx.field(static=True, default=False)
    calibration_error: float = eqx.field(static=True, default=0.0)
    errors_measured: bool = eqx.field(static=True, default=False)
    of_energy: bool = eqx.field(static=True, default=False)
    rounding: dict[str, Float[Array, "..."]] = eqx.field(default_factory=dict)
    guesses: tuple[str, ...] = eqx.field(static=True, default=())
    header: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())

    def __init__(
        self,
        gas: Gas,
        data: CoolingCurve | DropTest,
        num_particles: int | None = None,
        replicas: int = 1,
        priors: dict[str, tuple[Any, Any]] | None = None,
        absent: tuple[str, ...] = (),
        *,
        tracked: int | None = None,
        ensemble_start: bool = False,
        calibration_error: float = 0.0,
        errors_measured: bool = False,
        of_energy: bool = False,
        rounding: dict[str, Any] | None = None,
        guesses: tuple[str, ...] = (),
        header: tuple[tuple[str, str], ...] = (),
    ):
        if not isinstance(gas, Gas):
            raise ValueError(f"gas must be a jaxgran.Gas, got {type(gas).__name__}")
        gas.check_single()
        _check_data(data, gas)
        self.gas = gas
        self.data = data
        self.num_particles = _count_or_none("num_particles", num_particles)
        self.replicas = checked_int("replicas", replicas, 1)
        self.priors = _checked_priors(gas, {} if priors is None else priors)
        self.absent = _checked_absent(absent)
        self.tracked = _checked_tracked(tracked, self.num_particles)
        check_bool(
            ensemble_start=ensemble_start, errors_measured=errors_measured, of_energy=of_energy
        )
        self.ensemble_start = ensemble_start
        self.calibration_error = checked_float(
            "calibration_error", calibration_error, FRACTION, "0.02 stands for 2 %."
        )
        self.errors_measured = errors_measured
        self.of_energy = of_energy
        self.rounding = _checked_rounding({} if rounding is None else rounding, data)
        self.guesses = _checked_guesses(guesses, gas)
        self.header = tuple(header)

    @property
    def curve(self) -> CoolingCurve:
        """The measured curve.

        Raises:
            ValueError: for a drop test.
        """
        if isinstance(self.data, DropTest):
            raise ValueError("this measurement is a drop test, without a curve: use its data")
        return self.data

    def __repr__(self) -> str:
        N = "unknown" if self.num_particles is None else str(self.num_particles)
        rows = [
            ("gas", repr(self.gas).partition("\n")[0]),
            ("data", repr(self.data).partition("\n")[0]),
            ("N, runs", f"{N}, {self.replicas}"),
            ("known with an error", ", ".join(self.priors) or "nothing"),
            ("known to be absent", ", ".join(self.absent) or "nothing"),
        ]
        return text_table("Measurement", rows)


def _check_data(data: Any, gas: Gas) -> None:
    """Raise ValueError unless this is a measured curve, or a drop test of spheres of a gas."""
    if isinstance(data, CoolingCurve):
        data.check_measured()
        _check_magnitudes(data)
    elif isinstance(data, DropTest):
        data.check_gas(gas)
    else:
        raise ValueError(
            f"data must be a jaxgran.CoolingCurve or a jaxgran.DropTest, got "
            f"{type(data).__name__}. Make a curve of arrays by jaxgran.CoolingCurve(t, T), of "
            "a table of pandas by jaxgran.CoolingCurve.from_pandas(table)"
        )


def _check_magnitudes(curve: CoolingCurve) -> None:
    """Raise ValueError for values that cannot be measured, mostly typing or unit errors."""
    for name, quantity in QUANTITIES.items():
        given = getattr(curve, name)
        if given is None or not quantity.measured:
            continue
        values = np.asarray(given)
        smallest = SMALLEST
        if name.endswith("_error"):
            with_this_error = getattr(curve, name.removesuffix("_error"))
            if with_this_error is None:
                raise ValueError(f"the curve has {name} without the values. Leave it out as well.")
            smallest = MIN_ERROR * np.asarray(with_this_error)
        wrong = (values > 0) & ((values < smallest) | (values > LARGEST))
        if np.any(wrong):
            i = int(np.argmax(wrong))
            raise ValueError(
                f"point {i}: {quantity.column} is {values[i]:g}, which cannot be measured. Allowed "
                f"are {SMALLEST:g} to {LARGEST:g} in SI units, and errors above {MIN_ERROR:g} of "
                "the value: correct or remove the point"
            )


def _count_or_none(name: str, count: Any) -> int | None:
    return None if count is None else checked_int(name, count, 1)


def _checked_priors(gas: Gas, priors: Any) -> Priors:
    """Return priors as arrays.

    Raises:
        ValueError: for an unknown name, a value outside its range or an error that is not positive.
    """
    if not isinstance(priors, dict):
        raise ValueError(
            f"priors must be a dictionary of names, as {{'packing_fraction': (0.05, 0.002)}}, "
            f"got {priors!r:.60}"
        )
    converted = {}
    for name, pair in priors.items():
        if name not in (DENSITY, START_TIME) and name not in gas.domains:
            raise ValueError(
                f"priors: Gas has no parameter {name!r}; it has {', '.join(gas.domains)}, and "
                f"{DENSITY} and {START_TIME}"
            )
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError(
                f"priors: {name} needs (value, standard error), as (0.05, 0.002), got {pair!r:.60}"
            )
        value, error = pair
        domain = prior_domain(gas, name)
        domain.check(f"priors: {name}", value, "Give the known value, in SI units.")
        advice = "Leave out values that are known exactly."
        POSITIVE.check(f"priors: standard error of {name}", error, advice)
        if not np.all(np.isfinite(domain.to_free(np.asarray(value, float)))):
            raise ValueError(
                f"priors: {name} = {value} lies on the end of its range {domain}: give a value "
                "inside the range"
            )
        converted[name] = (float_array(value), float_array(error))
    return converted


def prior_domain(gas: Gas, name: str) -> Domain:
    """Return the allowed values of a parameter that may have a prior."""
    if name == START_TIME:
        return ANY
    if name == DENSITY:
        return POSITIVE
    return gas.domains[name]


def _checked_absent(absent: Any) -> tuple[str, ...]:
    """Return the names of effects that a user declares absent, or raise ValueError."""
    if not isinstance(absent, tuple | list) or not set(absent) <= set(ABSENT):
        raise ValueError(f"absent must be a tuple of {', '.join(ABSENT)}, got {absent!r}")
    return tuple(absent)


def _checked_tracked(tracked: Any, num_particles: int | None) -> int | None:
    """Return the number of tracked grains, or raise ValueError."""
    count = _count_or_none("tracked", tracked)
    if count is not None and num_particles is not None and count > num_particles:
        raise ValueError(f"tracked must be at most N = {num_particles}, got {count}")
    return count


def _checked_rounding(rounding: Any, data: CoolingCurve | DropTest) -> dict[str, Array]:
    """Return last digits of the fields of a curve as arrays, or raise ValueError."""
    fields = ("temperature", "rotational_temperature")
    if not isinstance(rounding, dict) or not set(rounding) <= set(fields):
        raise ValueError(
            f"rounding must be a dictionary of {' and '.join(fields)}, as "
            f"{{'temperature': 1e-6}}, got {rounding!r:.60}"
        )
    converted = {}
    for name, given in rounding.items():
        digit = float_array(given, f"rounding of {name}")
        NON_NEGATIVE.check(f"rounding of {name}", digit, "Give the last digit, SI.")
        is_number = digit.shape == ()
        is_of_times = isinstance(data, CoolingCurve) and digit.shape == data.times.shape
        if not (is_number or is_of_times):
            raise ValueError(
                f"rounding of {name} must be one number or one for each time, got shape "
                f"{digit.shape}"
            )
        converted[name] = digit
    return converted


def _checked_guesses(guesses: Any, gas: Gas) -> tuple[str, ...]:
    """Return names of parameters of a gas, or raise ValueError."""
    if isinstance(guesses, str) or not set(guesses) <= {*gas.domains}:
        raise ValueError(
            f"guesses must be a tuple of {', '.join(gas.domains)}, got {guesses!r:.60}"
        )
    return tuple(guesses)
