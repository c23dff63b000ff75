"""Laws with vectors, networks and splines, and fits of many parameters."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads


class Network(jaxgran.RestitutionLaw):
    """A law whose exponent of loss is a network: it has arrays, and a function among its leaves."""

    net: eqx.nn.MLP

    def restitution(self, normal_speed):
        return jnp.exp(-0.1 * jnp.exp(jnp.vectorize(lambda v: self.net(jnp.log(v)))(normal_speed)))


WEIGHT = "net.layers[0].weight"
NETWORK = Network(eqx.nn.MLP("scalar", "scalar", 3, 1, activation=jnp.tanh, key=jax.random.key(0)))


def gas_of(law):
    gas = glass_beads()
    return jaxgran.Gas(
        law,
        diameter=gas.diameter,
        mass=gas.mass,
        packing_fraction=gas.packing_fraction,
        temperature=gas.temperature,
    )


def curve_of(gas, num_points=40, relative_error=0.01):
    times = jnp.geomspace(0.3, 300.0, num_points) * gas.mean_free_time
    T = jaxgran.cool(gas, times).temperature
    return jaxgran.CoolingCurve(times, T, temperature_error=relative_error * T)


@pytest.mark.parametrize(
    "model",
    [
        jaxgran.KineticTheory(),
        jaxgran.DSMC(200),
        pytest.param(jaxgran.HardSpheres(64), marks=pytest.mark.slow),
    ],
)
def test_networks_are_laws(model):
    gas = gas_of(NETWORK)
    times = jnp.array([0.5, 2.0]) * gas.mean_free_time

    @jax.jit
    def last(weight):
        changed = gas.replace(**{WEIGHT: weight})
        return jaxgran.cool(changed, times, model=sized, progress=False).temperature[-1] / 0.01

    sized = model.sized_for(gas) if hasattr(model, "sized_for") else model
    weight, along = gas.value(WEIGHT), jnp.array([[1.0], [-0.5], [2.0]])
    forward = jax.jvp(last, (weight,), (along,))[1]
    backward = jnp.sum(jax.grad(last)(weight) * along)
    np.testing.assert_allclose(forward, backward, rtol=1e-8)
    if not model.stochastic:
        h = 1e-4
        slope = (last(weight + h * along) - last(weight - h * along)) / (2 * h)
        np.testing.assert_allclose(forward, slope, rtol=1e-5)


def test_names_of_the_arrays_of_a_law():
    gas = gas_of(NETWORK)
    names = ("net.layers[0].weight", "net.layers[0].bias")
    assert [name for name in gas.domains if name in names] == [*names]
    other = gas.replace(**{WEIGHT: jnp.ones((3, 1))})
    assert jnp.all(other.value(WEIGHT) == 1)
    with pytest.raises(ValueError, match="got 'tanh'"):
        gas_of(Network("tanh"))
    with pytest.raises(ValueError, match="SoftSpheres needs the Viscoelastic law"):
        jaxgran.cool(gas, [1.0], model=jaxgran.SoftSpheres(64))


def test_vectors_are_fitted():
    law = jaxgran.RestitutionSeries([-0.2, 0.03], [0.2, 0.4])
    gas = gas_of(law)
    curve = curve_of(gas)
    result = jaxgran.fit(gas.replace(coefficients=[-0.1, 0.0]), curve, free=("coefficients",))
    assert result.names == ("coefficients",)
    assert result.element_names == ("coefficients[0]", "coefficients[1]")
    estimate, error = result.value("coefficients")
    np.testing.assert_allclose(estimate, law.coefficients, atol=1e-4)
    assert error.shape == (2,)
    assert result.value("coefficients[1]") == (estimate[1], error[1])
    assert "coefficients[1]" in repr(result)


def test_all_floats_of_a_law_are_free():
    class Power(jaxgran.RestitutionLaw):
        loss_at_one: float
        power: float

        def restitution(self, normal_speed):
            return 1 - self.loss_at_one * normal_speed**self.power

    gas = gas_of(Power(0.15, 0.2))
    result = jaxgran.fit(gas.replace(power=0.1), curve_of(gas), free="law")
    assert result.names == ("loss_at_one", "power")
    np.testing.assert_allclose(result.estimate, [0.15, 0.2], rtol=1e-3)

    class Fixed(jaxgran.RestitutionLaw):
        def restitution(self, normal_speed):
            return 0.9

    with pytest.raises(ValueError, match='free="law", but the law Fixed has no floats'):
        jaxgran.fit(gas_of(Fixed()), curve_of(gas), free="law")
