"""Curves made of arrays: quantities with units, and what is checked."""

from datetime import timedelta

import jax.numpy as jnp
import numpy as np
import pint
import pytest
from pytest import approx

import jaxgran
from tests.data.curve_files import GAS, TIMES, T


@pytest.mark.parametrize(
    "curve_of",
    [
        lambda u: jaxgran.CoolingCurve(1e3 * TIMES * u.ms, 1e4 * T * u.cm**2 / u.s**2),
        lambda u: jaxgran.CoolingCurve([1e3 * t * u.ms for t in TIMES], T),
        lambda u: jaxgran.CoolingCurve((1e9 * TIMES).astype("m8[ns]"), T),
        lambda u: jaxgran.CoolingCurve([timedelta(seconds=t) for t in TIMES], T),
    ],
)
def test_quantities_with_units_are_converted(curve_of):
    curve = curve_of(pint.UnitRegistry())
    np.testing.assert_allclose(curve.times, TIMES, rtol=1e-4)
    np.testing.assert_allclose(curve.temperature, T)


def test_a_gas_takes_quantities_with_units():
    u = pint.UnitRegistry()
    gas = GAS.replace(diameter=3 * u.mm, packing_fraction=4 * u.percent)
    assert float(gas.diameter) == approx(0.003) and float(gas.packing_fraction) == approx(0.04)
    mass = jaxgran.sphere_mass(3 * u.mm, 1.2 * u.g / u.cm**3)
    assert float(mass) == approx(float(GAS.mass))
    times = 1e3 * TIMES[:3] * u.ms
    np.testing.assert_allclose(jaxgran.cool(GAS, times).times, TIMES[:3])
    with pytest.raises(ValueError, match="in m.2/s.2: Cannot convert"):
        GAS.replace(temperature=300 * u.K)


DATES = np.datetime64("2024-05-01") + (1e3 * TIMES).astype("m8[ms]")


WRONG_CURVES = [
    (lambda: jaxgran.CoolingCurve(DATES, T), "got dates, .* dates - dates.0."),
    (lambda: jaxgran.CoolingCurve(TIMES, T[:5]), "temperature has shape .5,."),
    (lambda: jaxgran.CoolingCurve(TIMES, -T), "point 0: T is -0.01.*give T_err"),
    (lambda: jaxgran.CoolingCurve(TIMES, np.nan * T), "point 0: T is nan"),
    (lambda: jaxgran.CoolingCurve(TIMES[::-1], T), "times must increase"),
    (lambda: jaxgran.CoolingCurve(TIMES, T, temperature_error=0.1), "temperature_error has shape"),
    (
        lambda: jaxgran.Measurement(GAS, jaxgran.CoolingCurve(TIMES[:, None], T[:, None])),
        "got shape .40, 1.; .*x.ravel",
    ),
    (lambda: GAS.replace(diameter=jnp.array(True)), "diameter must be a number"),
    (lambda: GAS.replace(diameter=jnp.array(1j)), "diameter must be a number"),
]


@pytest.mark.parametrize("call, words", WRONG_CURVES)
def test_curves_are_checked_where_they_are_made(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_only_times_and_temperatures_go_without_a_name():
    with pytest.raises(TypeError, match="positional"):
        jaxgran.CoolingCurve(TIMES, T, 0.3 * T)
