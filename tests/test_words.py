"""Text and HTML representations of a gas, a curve and a choice."""

import copy
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads


def test_repr_of_a_gas_has_units():
    gas = glass_beads()
    words = repr(gas)
    assert "dissipative_constant" in words and "m^2/s^2" in words and "f64[]" not in words
    assert f"{float(gas.mean_free_time):.4g} s" in words
    assert gas._repr_html_().startswith("<table><caption>Gas of Viscoelastic spheres, d = 3")


def test_repr_of_a_curve_lists_its_fields():
    curve = jaxgran.CoolingCurve([0.0, 1.0, 2.0], [4.0, 2.0, 1.0], temperature_error=[1, 1, 1])
    assert "3 times, t = 0 s to 2 s" in repr(curve) and "0.25" in repr(curve)
    assert "temperature, temperature_error" in curve._repr_html_()


def test_repr_of_a_choice_lists_its_reasons():
    choice = jaxgran.choose_model(glass_beads(), [1e-3, 1.0])
    assert repr(choice).startswith("Choice: kinetic theory, T within")
    assert all(reason in repr(choice) for reason in choice.reasons)
    assert "<th>1.</th>" in choice._repr_html_()


def test_repr_marks_batches_and_traced_values():
    gas, shown = glass_beads(), []
    jax.jit(lambda gas: shown.append(repr(gas)) or gas.temperature)(gas)
    assert "traced" in shown[0]
    many = jax.vmap(lambda a: gas.replace(dissipative_constant=a))(jnp.ones(3))
    assert "values of shape (3,)" in repr(many)


def test_floats_of_parts_are_attributes_of_the_gas():
    gas = glass_beads().replace(dissipative_constant=2e-6)
    assert float(gas.dissipative_constant) == 2e-6
    with pytest.raises(AttributeError, match="Gas has no attribute 'viscosity'"):
        _ = gas.viscosity
    for again in (copy.deepcopy(gas), pickle.loads(pickle.dumps(gas))):
        np.testing.assert_array_equal(again.dissipative_constant, gas.dissipative_constant)


def test_completion_shows_only_public_names():
    assert set(dir(jaxgran)) == {*jaxgran.__all__, "plot_curve", "plot_fit"}
