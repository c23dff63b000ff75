"""How fast particles forget their velocities, from displacements whose covariance is known."""

import numpy as np
import pytest
from scipy.integrate import quad

from jaxgran.data.displacements import Step
from jaxgran.data.velocity_memory import displacement_factor, fit_memory, free_flight_squares

NU_V = 6.0
"""1/s."""

T = 0.01
"""m^2/s^2."""

ERROR = 2e-3
"""Error of one coordinate of a position, m; over 0.1 s it adds 8 % to T."""

FRAMES = np.array([0.0, 0.08, 0.2, 0.3, 0.42, 0.5, 0.6])
"""s."""


def covariance_of_positions():
    """Covariance of x(t) - x(0) at the frames: T exp(-nu_v |u - w|) integrated over u and w."""

    def integrated_over_w(u, t):
        return T / NU_V * (2 - np.exp(-NU_V * u) - np.exp(-NU_V * (t - u)))

    def element(s, t):
        return quad(integrated_over_w, 0.0, s, args=(t,))[0]

    return np.array([[element(min(s, t), max(s, t)) for t in FRAMES] for s in FRAMES])


def steps_with(covariance, n):
    """Steps of n particles in one dimension, whose displacements have exactly this covariance."""
    rng = np.random.default_rng(0)
    numbers = rng.standard_normal((n, len(covariance)))
    numbers -= numbers.mean(axis=0)
    orthonormal = np.linalg.qr(numbers)[0] * np.sqrt(n)
    columns = (orthonormal @ np.linalg.cholesky(covariance).T).T
    middles = (FRAMES[1:] + FRAMES[:-1]) / 2
    durations = np.diff(FRAMES)
    rows = zip(middles, durations, columns, strict=True)
    return [Step(float(t), float(dt), np.arange(n), x[:, None]) for t, dt, x in rows]


def made_steps(error=0.0, n=4000):
    """Steps with a known memory, and T by their displacements."""
    positions = covariance_of_positions() + error**2 * np.eye(len(FRAMES))
    difference = np.diff(np.eye(len(FRAMES)), axis=0)
    covariance = difference @ positions @ difference.T
    return steps_with(covariance, n), np.diag(covariance) / np.diff(FRAMES) ** 2


@pytest.mark.parametrize("x", [1e-6, 1e-3, 0.3, 5.0, 100.0])
def test_the_factor_of_displacements_is_a_double_integral(x):
    integral = quad(lambda t: 2 * (x - t) * np.exp(-t), 0.0, x, epsrel=1e-12)[0]
    # Below 1e-3 it is a series with an error of x^2/12.
    assert displacement_factor(np.array([x]))[0] == pytest.approx(integral / x**2, rel=1e-7)


def test_free_flight_is_found_from_displacements_with_impacts():
    free = np.geomspace(0.01, 100.0, 9)
    for rate in (0.0, 0.2, 5.0):
        squares = free * displacement_factor(rate * np.sqrt(free))
        np.testing.assert_allclose(free_flight_squares(squares, rate), free, rtol=1e-12)


@pytest.mark.parametrize("error", [0.0, ERROR])
def test_the_memory_is_found(error):
    steps, measured_T = made_steps(error)
    memory = fit_memory(steps, measured_T, None, error)
    # The tolerance of the search; the model is exact for velocities of one exponential.
    assert memory.rate == pytest.approx(NU_V / T**0.5, rel=1e-5)
    assert memory.localisation_error is None and memory.rate_ratio is None


def test_the_error_of_positions_is_found_with_the_memory():
    memory = fit_memory(*made_steps(ERROR), None, None)
    assert memory.rate == pytest.approx(NU_V / T**0.5, rel=1e-4)
    assert memory.localisation_error == pytest.approx(ERROR, rel=1e-4)


def test_an_error_of_positions_that_is_not_there_is_not_found():
    memory = fit_memory(*made_steps(), None, None)
    assert memory.localisation_error is None
    assert memory.rate == pytest.approx(NU_V / T**0.5, rel=1e-5)


def test_the_rate_is_compared_with_theory():
    expected = 2 * NU_V / T**0.5
    memory = fit_memory(*made_steps(), expected, 0.0)
    assert memory.rate_ratio == pytest.approx(memory.rate / expected, rel=1e-12)
    # 4000 particles know the rate better than theory, whose error is 20 %: it hardly moves.
    assert memory.rate_ratio == pytest.approx(0.5, rel=0.05)


def test_few_particles_leave_the_rate_near_theory():
    expected = 2 * NU_V / T**0.5
    few = fit_memory(*made_steps(n=8), expected, 0.0).rate_ratio
    more = fit_memory(*made_steps(n=80), expected, 0.0).rate_ratio
    assert 0.5 < more < few < 1


def test_particles_in_free_flight_have_no_memory_of_impacts():
    velocity = 0.1 * np.random.default_rng(1).standard_normal((300, 3))
    durations = np.diff(FRAMES)
    middles = (FRAMES[1:] + FRAMES[:-1]) / 2
    rows = zip(middles, durations, strict=True)
    steps = [Step(float(t), float(dt), np.arange(300), velocity * dt) for t, dt in rows]
    T_of_steps = np.full(len(steps), velocity.var())
    assert fit_memory(steps, T_of_steps, None, 0.0).rate == 0


@pytest.mark.parametrize("enskog, rate", [(None, 0.0), (30.0, 30.0)])
def test_one_step_shows_nothing(enskog, rate):
    steps, measured_T = made_steps()
    memory = fit_memory(steps[:1], measured_T[:1], enskog, None)
    assert memory == (rate, None, None)
