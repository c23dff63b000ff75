"""Minimisers of a sum of squares, on a power law whose parameters are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.fitting.optimise import is_converged, least_squares, quasi_newton
from tests.fitting.curves import TIMES, TRUTH, exact


@pytest.mark.parametrize("off, expected", [(0.0, True), (1e-3, True), (0.1, False), (1.0, False)])
def test_rest_is_told_in_standard_errors(off, expected):
    rng = np.random.default_rng(0)
    for scale in (1.0, 1e-6):  # of a parameter beside the other
        jacobian = rng.normal(size=(40, 2)) * [1.0, scale]
        residuals = 0.3 * rng.normal(size=40)
        best, *_ = np.linalg.lstsq(jacobian, residuals, rcond=None)
        standard_error = 0.3 * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
        moved = residuals - jacobian @ (best + off * standard_error)
        assert bool(is_converged(jnp.asarray(moved), jnp.asarray(jacobian))) == expected


def test_least_squares_end_in_rough_sums():
    # Residuals of curves by an adaptive solver over small errors: rough, as no derivative knows.
    def found(key):
        noise = 0.01 * jax.random.normal(key, TIMES.shape)

        def residuals(flat):
            rough = 1e-6 * jnp.sin(1e13 * jax.lax.stop_gradient(flat[0]) + jnp.arange(TIMES.size))
            return (exact(jnp.asarray(TRUTH)) + noise - exact(flat)) / 0.01 + rough

        return least_squares(residuals, jnp.zeros(2), 100)

    flat, num_steps, converged = jax.vmap(found)(jax.random.split(jax.random.key(0), 100))
    # Newton's steps double the digits: five are enough from here, and a few that noise refuses.
    assert jnp.all(converged) and jnp.max(num_steps) <= 8
    # Each answer errs by some .003 of each parameter, their mean by a tenth of that.
    np.testing.assert_allclose(jnp.mean(flat, axis=0), TRUTH, atol=0.003)


@pytest.mark.parametrize("off", [0.0, 0.3, 3.0, -6.0])
def test_quasi_newton_ends_where_least_squares_do(off):
    noise = 0.01 * jax.random.normal(jax.random.key(1), TIMES.shape)

    def residuals(flat):
        return (exact(jnp.asarray(TRUTH)) + noise - exact(flat)) / 0.01

    first = jnp.asarray(TRUTH) + off
    newton, _, newton_converged = least_squares(residuals, first, 100)
    flat, num_steps, converged = quasi_newton(residuals, first, 100)
    assert converged and newton_converged and num_steps < 40  # 6 to 23
    # The standard errors are some 3e-3; the tolerance of the search is 1e-7.
    np.testing.assert_allclose(flat, newton, atol=1e-5)


def test_quasi_newton_stays_at_a_minimum():
    flat, _, converged = quasi_newton(lambda flat: 0 * flat, jnp.ones(2), 100)
    assert converged
    np.testing.assert_array_equal(flat, 1.0)
