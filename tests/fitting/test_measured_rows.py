"""How a measured curve becomes rows: which values count, and with which errors."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.candidates import second_density, with_duration
from jaxgran.fitting.measured_rows import curve_rows
from tests.beads import glass_beads
from tests.fitting.curves import A, cooled_beads, fitted, rough_beads

GAS = glass_beads()
TIMES = np.append(0.0, np.geomspace(0.5, 60.0, 20)) * float(GAS.mean_free_time)
CURVE = jaxgran.cool(GAS, TIMES, progress=False)
T = np.asarray(CURVE.temperature)


def rows_of(gas=GAS, fits_T_0=False, **known):
    names = ("temperature_error", "rotational_temperature", "rotational_temperature_error")
    columns = {name: known.pop(name) for name in names if name in known}
    curve = jaxgran.CoolingCurve(TIMES, T, **columns)
    measurement = jaxgran.Measurement(gas, curve, **known)
    theory = jaxgran.KineticTheory()
    return curve_rows("", measurement, theory, fits_T_0=fits_T_0, fits_t0=False)[0]


def test_the_first_value_counts_by_the_error_that_is_used():
    chance = (2 / (3 * 1000)) ** 0.5 * T  # of independent grains: not an error
    known = {"num_particles": 1000, "rounding": {"temperature": 1e-9}}
    assert rows_of(**known, temperature_error=chance).used[0, 0] == 0
    assert rows_of(**known, temperature_error=chance, fits_T_0=True).used[0, 0] == 1
    assert rows_of(**known, temperature_error=chance, errors_measured=True).used[0, 0] == 1
    # T_rot has errors of its own.
    known = {"temperature_error": 0.01 * T, "rotational_temperature": 0.1 * T}
    assert list(rows_of(rough_beads(), **known).used[0]) == [1, 0]
    both = known | {"rotational_temperature_error": 0.01 * T}
    assert list(rows_of(rough_beads(), **both).used[0]) == [1, 1]


def test_the_error_of_tracked_grains_is_in_the_budget():
    noise = 0.03 * jax.random.normal(jax.random.key(0), T.shape)
    curve = jaxgran.CoolingCurve(TIMES, T * np.exp(noise), temperature_error=1e-3 * T)
    known = {"num_particles": 1000, "errors_measured": True}
    errors = []
    for tracked in (None, 50):
        measurement = jaxgran.Measurement(GAS, curve, tracked=tracked, **known)
        result = jaxgran.fit(measurement, quick=True, progress=False)
        errors.append(result.standard_error[0])
    # Alone 50 grains give T to 11 %, and 20 points far apart a part of it: most of the error.
    assert errors[1] > 1.5 * errors[0]
    assert result.error_budget["sampling"][0] > 0.5 * errors[1]


def test_the_sampling_of_spins_is_an_error_of_T_rot():
    known = {"rotational_temperature": 0.1 * T, "num_particles": 1000, "tracked": 50}
    rows = rows_of(rough_beads(), **known)
    np.testing.assert_allclose(rows.errors[:, 1], 0.1 * T * (2 / 3 / 50 * 0.95) ** 0.5)
    assert np.all(rows.errors[:, 0] == 0)  # the filter knows the sampling of T


def test_plans_keep_the_start_of_a_late_clock():
    t0 = 100 * float(GAS.mean_free_time)
    late = dataclasses.replace(CURVE, times=CURVE.times + t0)
    measurement = jaxgran.Measurement(GAS, late, num_particles=1000, priors={"t0": (t0, 0.1)})
    longer = np.asarray(with_duration(measurement, 2.0).curve.times)
    assert longer[0] == pytest.approx(t0)
    assert longer[-1] - t0 == pytest.approx(2 * TIMES[-1])
    denser = np.asarray(second_density(measurement).curve.times)
    ratio = (denser[1:] - t0) / TIMES[1:]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)


@pytest.mark.slow
def test_imitations_begin_with_the_gas():
    t0 = 20 * float(GAS.mean_free_time)
    error = t0 / 40
    late = jaxgran.CoolingCurve(TIMES[1:] + t0, T[1:], temperature_error=0.02 * T[1:])
    known = {"num_particles": 250, "priors": {"t0": (t0, error)}, "errors_measured": True}
    absent = ("walls", "roughness", "drag", "friction")
    measurement = jaxgran.Measurement(GAS, late, absent=absent, **known)
    result = jaxgran.fit(measurement, progress=False)
    assert abs(result.start_time[""] - t0) < 3 * error
    imitation = jaxgran.imitate(result, runs=6, progress=False)
    ratio = imitation.estimate / float(result.gas.value(A))
    # Runs of 250 grains with T to 2 % scatter by some 5 %; from t = 0 on A was 1.9 to 2.6 times it.
    assert np.all(np.abs(np.log(ratio)) < 0.3)


@pytest.mark.slow
def test_displacements_of_the_same_grains_do_not_average():
    """More times tell little more: <dr^2> of N grains is one random number, and not a new one."""
    errors = []
    for num_points in (20, 80):
        gas, curve = cooled_beads(
            relative_error=0.3, num_points=num_points, quantities=("temperature", "displacement")
        )
        curve = dataclasses.replace(curve, displacement_error=None)
        result = fitted(gas, curve, num_particles=100)
        errors.append(float(result.standard_error[0]))
    assert errors[1] > 0.7 * errors[0]
