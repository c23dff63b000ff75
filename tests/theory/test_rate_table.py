"""Tables of averages over impacts: their errors, and their derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.theory.averages import impact_moments
from jaxgran.theory.elements import ElementBounds
from jaxgran.theory.rate_table import RateTable, log_temperature_range
from tests.beads import glass_beads


@pytest.mark.minutes
def test_rate_table_is_exact_over_decades():
    laws = [
        glass_beads(0.15).reduced_law,
        glass_beads(2.0).reduced_law,
        jaxgran.ConstantRestitution(0.5),
        jaxgran.RestitutionSeries([-0.2], [0.5]),
        jaxgran.RestitutionSeries([-0.1], [1.0]),
    ]
    # Over five decades the series are exact to 1e-11; over twelve, to 1e-7 where least so.
    for law in laws:
        for duration, tolerance in ((1e-3, 1e-11), (1.0, 1e-11), (1e5, 1e-11), (1e12, 1e-7)):
            direct = partial(impact_moments, law, dimension=3)
            ends = log_temperature_range(law, jnp.asarray(duration), 3, ElementBounds())
            table = RateTable.from_function(direct, *ends, law.num_nodes)
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
