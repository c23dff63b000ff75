"""Averages over impacts and their tables, each against an independent number."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.theory import averages as kinetics
from jaxgran.theory.averages import RateTable


def test_averages_of_constant_restitution():
    # Closed forms for a_2 = 0, in share = S_d / sqrt(2 pi): share (1 - e^2)/2, share (1 + e)/d.
    e, law = 0.7, jaxgran.ConstantRestitution(0.7)
    for d, share in ((2, np.sqrt(2 * np.pi)), (3, 2 * np.sqrt(2 * np.pi))):
        moments = kinetics.impact_moments(law, jnp.ones(()), d)
        mu_2 = share * (1 - e**2) / 2
        mu_4 = (d + 1.5 + e**2) * mu_2  # van Noije & Ernst 1998, Eq. (12)
        expected = [mu_2, mu_4, share * (1 + e) / d]
        np.testing.assert_allclose(moments[:, 0], expected, rtol=1e-12)


@pytest.mark.slow
def test_rate_table_is_exact_over_decades(beads):
    laws = [
        beads(0.15).reduced_law,
        beads(2.0).reduced_law,
        jaxgran.ConstantRestitution(0.5),
        jaxgran.RestitutionSeries([-0.2], [0.5]),
        jaxgran.RestitutionSeries([-0.1], [1.0]),
    ]
    # Over five decades the series are exact to 1e-11; over twelve, to 1e-7 where least so.
    for law in laws:
        for duration, tolerance in ((1e-3, 1e-11), (1.0, 1e-11), (1e5, 1e-11), (1e12, 1e-7)):
            direct = partial(kinetics.impact_moments, law, dimension=3)
            table = RateTable.from_function(direct, jnp.asarray(duration), 3, law.num_nodes)
            x = jnp.linspace(table.lowest, 0.0, 300)
            error = jax.vmap(table)(x)[:, 0, 0] / jax.vmap(direct)(jnp.exp(x / 2))[:, 0, 0] - 1
            assert jnp.max(jnp.abs(error)) < tolerance


@pytest.mark.parametrize("highest", [0.0, 0.7])
def test_a_table_with_slopes_is_the_table_its_derivative_and_those_given(highest):
    coefficients, along = np.random.default_rng(1).normal(size=(2, 12, 3, 3))
    highest = jnp.asarray(highest)
    table = RateTable(jnp.asarray(coefficients), jnp.asarray(-1.3), highest)
    both = table.with_slopes(jnp.asarray(along)[None])
    for x in (-1.2, -0.5, 0.0):
        value, slope = jax.jvp(table, (jnp.asarray(x),), (jnp.asarray(1.0),))
        other = RateTable(jnp.asarray(along), table.lowest, highest)(jnp.asarray(x))
        # Terms of order 12^2 nearly cancel in a derivative.
        expected = jnp.stack([value, slope, other])
        np.testing.assert_allclose(both(jnp.asarray(x)), expected, atol=1e-11)
