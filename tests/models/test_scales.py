"""Scales of a gas at some temperatures, against the properties of the gas at each of them."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.models.scales import scales_at
from jaxgran.theory.averages import impact_moments
from jaxgran.theory.density import softness_factor
from tests.beads import glass_beads, hard_gas


@pytest.mark.parametrize("gas", [glass_beads(0.15), hard_gas(0.9, 0.2)])
def test_scales_are_the_properties_of_the_gas_at_each_temperature(gas):
    temperatures = float(gas.temperature) * np.array([1.0, 0.1, 7.0])
    scales = scales_at(gas, temperatures)
    one = jnp.ones(())
    for k, T in enumerate(temperatures):
        now = gas.replace(temperature=T)
        law = now.reduced_law
        mu_2 = impact_moments(law, one, now.dimension)[0, 0]
        expected = {
            "mean_free_time": now.mean_free_time,
            "mean_free_path": now.mean_free_path,
            "volume": 1 / now.number_density,
            "contact_fraction": now.contact_fraction,
            "overlap": now.mean_overlap,
            "critical_box": now.critical_box,
            "softness": 1 - softness_factor(law, one, now.dimension),
            "cooling_rate": 2 / now.dimension * mu_2 * now.impact_speed / now.path_length,
            "restitution": now.restitution(now.impact_speed),
        }
        for name, value in expected.items():
            found = getattr(scales, name)[k]
            assert found == pytest.approx(float(value), rel=1e-12, abs=1e-15), name  # rounding
    first = scales_at(gas)
    assert first.mean_free_time == scales.mean_free_time[0]
    side = float(gas.box_side(300))
    assert first.box_side(300, gas.dimension) == pytest.approx(side, rel=1e-12)


def test_the_lowest_restitution_is_at_a_fast_impact():
    gas = glass_beads(0.15)
    fast = float(gas.restitution(3.7 * gas.impact_speed))  # eps falls with the speed
    lowest = scales_at(gas).lowest_restitution
    assert fast < lowest < fast + 0.01
