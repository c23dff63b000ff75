"""The loop over the steps of a solver, and its output between them."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.theory.solver import FIRST_STEP, integrate_at

TIMES = np.linspace(0.0, 5.0, 64)


def solved(velocity, start, times, rtol=1e-9, max_steps=1000):
    return integrate_at(
        velocity,
        jnp.asarray(start),
        jnp.asarray(times),
        solver=diffrax.Tsit5(scan_kind="lax"),
        controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        max_steps=max_steps,
    )


@pytest.mark.parametrize("rtol", [1e-4, 1e-9])
def test_an_oscillation_is_that_of_diffrax_and_of_the_closed_form(rtol):
    def velocity(t, y):
        return jnp.stack([y[1], -y[0]])

    values, reached = solved(velocity, [1.0, 0.0], TIMES, rtol)
    assert reached
    exact = np.stack([np.cos(TIMES), -np.sin(TIMES)], axis=1)
    # Errors of steps add up over some ten steps each radian.
    np.testing.assert_allclose(values, exact, atol=50 * rtol)
    theirs = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: velocity(t, y)),
        diffrax.Tsit5(),
        t0=0.0,
        t1=5.0,
        dt0=FIRST_STEP,
        y0=jnp.array([1.0, 0.0]),
        saveat=diffrax.SaveAt(ts=TIMES),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
    )
    np.testing.assert_allclose(values, theirs.ys, atol=1e-13)  # the same steps


@pytest.mark.parametrize(
    "times",
    [
        np.zeros(16),  # the start alone
        np.repeat([1e-12, 2.0], [1, 15]),  # padded
        np.linspace(1.0, 1.01, 160),  # more than a window in one step
        np.geomspace(1e-9, 40.0, 32),
    ],
)
def test_times_of_every_kind(times):
    values, reached = solved(lambda t, y: -y, [1.0], times)
    assert reached
    np.testing.assert_allclose(values[:, 0], np.exp(-times), atol=1e-8)


def test_members_of_a_batch_keep_their_own_steps():
    rates = jnp.array([0.1, 1.0, 30.0])
    batch, _ = jax.vmap(lambda rate: solved(lambda t, y: -rate * y, [1.0], TIMES))(rates)
    for rate, values in zip(rates, batch, strict=True):
        alone, _ = solved(partial(lambda rate, t, y: -rate * y, rate), [1.0], TIMES)
        np.testing.assert_allclose(values, alone, atol=1e-14)  # another order of sums


def test_what_does_not_end_says_so():
    values, reached = solved(lambda t, y: y**2, [1.0], TIMES, max_steps=200)  # infinite at t = 1
    assert not reached
    # As far as it came it is right, with the tolerance times the growth of errors, y^2 <= 100.
    early = TIMES < 0.9
    np.testing.assert_allclose(values[early, 0], 1 / (1 - TIMES[early]), rtol=1e-6)


@pytest.mark.parametrize("number", [1, 4, 20])
def test_any_number_of_times_will_do(number):
    """Fits under jax.vmap have the times of the curve, which are not padded."""
    times = np.linspace(0.5, 3.0, number)
    values, reached = solved(lambda t, y: -y, [1.0], times)
    assert reached
    np.testing.assert_allclose(values[:, 0], np.exp(-times), rtol=1e-7)
