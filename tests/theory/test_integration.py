"""The loop over the steps of a solver, and its output between them."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.theory.solver import FIRST_STEP, integrate_at

TIMES = np.linspace(0.0, 5.0, 64)


@partial(jax.jit, static_argnums=0, static_argnames="max_steps")
def solved(velocity, start, times, rtol=1e-9, max_steps=1000):
    controller = diffrax.PIDController(rtol=rtol, atol=rtol)
    options = {"solver": diffrax.Tsit5(scan_kind="lax"), "controller": controller}
    start, times = jnp.asarray(start), jnp.asarray(times)
    return integrate_at(velocity, start, times, max_steps=max_steps, **options)


@jax.jit
def solved_by_diffrax(rtol):
    controller = diffrax.PIDController(rtol=rtol, atol=rtol)
    options = {"saveat": diffrax.SaveAt(ts=TIMES), "stepsize_controller": controller}
    term = diffrax.ODETerm(lambda t, y, args: rotation(t, y))
    start = jnp.array([1.0, 0.0])
    return diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 5.0, FIRST_STEP, start, **options)


def rotation(t, y):
    return jnp.stack([y[1], -y[0]])


def decay(t, y):
    return -y


@pytest.mark.parametrize("rtol", [1e-4, 1e-9])
def test_an_oscillation_is_that_of_diffrax_and_of_the_closed_form(rtol):
    values, reached = solved(rotation, [1.0, 0.0], TIMES, rtol)
    assert reached
    exact = np.stack([np.cos(TIMES), -np.sin(TIMES)], axis=1)
    # Errors of steps add up over some ten steps each radian.
    np.testing.assert_allclose(values, exact, atol=50 * rtol)
    # The same steps.
    np.testing.assert_allclose(values, solved_by_diffrax(rtol).ys, atol=1e-13)


@pytest.mark.parametrize(
    "times",
    [
        np.zeros(16),  # the start alone
        np.repeat([1e-12, 2.0], [1, 15]),  # padded
        np.linspace(1.0, 1.01, 160),  # more than a window in one step
        np.geomspace(1e-9, 40.0, 20),  # of a fit under jax.vmap: not padded to a multiple of 16
    ],
)
def test_times_of_every_kind(times):
    values, reached = solved(decay, [1.0], times)
    assert reached
    np.testing.assert_allclose(values[:, 0], np.exp(-times), atol=1e-8)


def test_members_of_a_batch_keep_their_own_steps():
    @jax.jit
    def one(rate):
        return solved(lambda t, y: -rate * y, [1.0], TIMES)[0]

    rates = jnp.array([0.1, 1.0, 30.0])
    for rate, values in zip(rates, jax.vmap(one)(rates), strict=True):
        np.testing.assert_allclose(values, one(rate), atol=1e-14)  # another order of sums


def test_what_does_not_end_says_so():
    values, reached = solved(lambda t, y: y**2, [1.0], TIMES, max_steps=200)  # infinite at t = 1
    assert not reached
    # As far as it came it is right, with the tolerance times the growth of errors, y^2 <= 100.
    early = TIMES < 0.9
    np.testing.assert_allclose(values[early, 0], 1 / (1 - TIMES[early]), rtol=1e-6)
