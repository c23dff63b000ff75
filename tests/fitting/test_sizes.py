"""Fits of curves of spheres of unequal sizes, and the files that describe them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.theory.sizes import energy_ratio
from tests.beads import glass_beads

SPREAD = 0.15
HEADER = {"eta": 0.05, "diameter": 2e-3, "density": 2500, "Y": 5e7, "nu": 0.22, "T0": 0.01}


@pytest.fixture(scope="module")
def gas():
    gas = glass_beads()
    return replace(gas, diameter_sd=SPREAD * gas.diameter)


@pytest.fixture(scope="module")
def curve(gas):
    times = np.geomspace(0.1, 40, 25) * float(gas.mean_free_time)
    return jaxgran.cool(gas, times, model=jaxgran.KineticTheory())


@pytest.mark.slow
@pytest.mark.parametrize("of_energy", [False, True])
def test_a_curve_without_noise_gives_its_own_constant(gas, curve, of_energy):
    T = np.asarray(curve.temperature)
    if of_energy:
        T = T * np.asarray(energy_ratio(SPREAD, jnp.log(curve.size_ratio)))
    measured = jaxgran.CoolingCurve(np.asarray(curve.times), T)
    measurement = jaxgran.Measurement(gas, measured, num_particles=10**7, of_energy=of_energy)
    free = ("dissipative_constant", "temperature")
    result = jaxgran.fit(measurement, free=free, quick=True, progress=False)
    A, error = (float(np.squeeze(x)) for x in result.value("dissipative_constant"))
    # Of many grains: the determinant of C prefers less noise, so a smaller A, by 1/N.
    assert pytest.approx(float(gas.value("dissipative_constant")), rel=2e-3) == A
    assert 1e-4 < error / A < 0.02


@pytest.mark.minutes
@pytest.mark.slow
def test_the_likelihood_is_differentiable_in_the_spread(gas, curve):
    measured = jaxgran.CoolingCurve(np.asarray(curve.times), np.asarray(curve.temperature))
    measurement = jaxgran.Measurement(gas, measured, num_particles=250)

    def value(diameter_sd):
        return jaxgran.log_likelihood(gas.replace(diameter_sd=diameter_sd), measurement)

    at = 1.1 * gas.diameter_sd
    slope = float(jax.grad(value)(at))
    step = 1e-3 * at
    difference = float((value(at + step) - value(at - step)) / (2 * step))
    assert slope == pytest.approx(difference, rel=1e-3)
    assert slope < 0


def test_a_file_gives_the_spread_and_the_mean_mass(tmp_path, curve):
    header = HEADER | {"diameter_sd": "0.3 mm", "N": 250}
    lines = [f"# {key}: {value}" for key, value in header.items()]
    spread = 0.3e-3 / HEADER["diameter"]
    mass = float(jaxgran.sphere_mass(2e-3, 2500.0)) * (1 + 3 * spread**2)
    pairs = zip(np.asarray(curve.times), np.asarray(curve.temperature), strict=True)
    rows = [f"{t!r},{1.5 * mass * T!r}" for t, T in ((float(t), float(T)) for t, T in pairs)]
    path = tmp_path / "energies.csv"
    path.write_text("\n".join([*lines, "t,energy", *rows]))
    measurement = jaxgran.read_measurement(path)
    assert measurement.of_energy
    copy = tmp_path / "copy.csv"
    jaxgran.write_curve(copy, measurement.curve, dict(measurement.header))
    assert jaxgran.read_measurement(copy).of_energy
    assert float(measurement.gas.value("diameter_sd")) == pytest.approx(0.3e-3)
    np.testing.assert_allclose(measurement.curve.temperature, curve.temperature, rtol=1e-6)


def test_a_file_with_too_wide_a_spread_is_refused(tmp_path):
    header = HEADER | {"diameter_sd": "0.5 mm"}
    path = tmp_path / "wide.csv"
    lines = [f"# {key}: {value}" for key, value in header.items()]
    path.write_text("\n".join([*lines, "t,T", "0.1,9e-3", "1,5e-3", "3,1e-3"]))
    with pytest.raises(ValueError, match=r"diameter_sd is 0\.25 of the diameter"):
        jaxgran.read_measurement(path)
