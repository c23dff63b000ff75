"""Every route to a derivative of a curve agrees with every other, in every float of the gas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxgran
from tests.beads import glass_beads

TAUS = jnp.array([0.3, 3.0, 30.0, 300.0])


SCENE = {"diameter": 0.002, "mass": 1e-5, "packing_fraction": 0.1, "temperature": 0.01}
ELEMENTS = {
    "surface": jaxgran.Rough(0.3, rotational_temperature=1e-3),
    "container": jaxgran.Walls(0.05, restitution=0.8, tangential_restitution=0.2),
    "drag": jaxgran.StokesDrag(0.3, rotational_rate=0.5),
    "drive": jaxgran.WhiteNoise(1e-3),
}
VISCOELASTIC = jaxgran.Viscoelastic(5e7, 0.22, 3e-6)
GASES = {
    "viscoelastic": jaxgran.Gas(VISCOELASTIC, **SCENE),
    "series": jaxgran.Gas(jaxgran.RestitutionSeries([-0.2, 0.05], [0.2, 0.4]), **SCENE),
    "all elements": jaxgran.Gas(VISCOELASTIC, **SCENE, **ELEMENTS),
}


def logs(gas, times):
    # Tighter than the default, whose noise differences would show.
    curve = jaxgran.cool(gas, times, model=jaxgran.KineticTheory(rtol=1e-9))
    each = curve.temperature, curve.collisions, curve.displacement, curve.rotational_temperature
    return jnp.log(jnp.stack([values for values in each if values is not None]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["series", "all elements"])
def test_all_routes_agree(name):
    gas = GASES[name]
    times = TAUS * gas.mean_free_time
    values = {name: gas.value(name) for name in gas.domains}
    flat, unravel = ravel_pytree(values)

    def of(log_scale):
        scaled = unravel(flat * jnp.exp(log_scale))
        return logs(gas.replace(**scaled), times)

    # Slopes and values by one program.
    forward_and_values = jax.jit(jax.jacfwd(lambda x: (of(x),) * 2, has_aux=True))
    zero = jnp.zeros_like(flat)
    forward, reverse = forward_and_values(zero)[0], jax.jit(jax.jacrev(of))(zero)
    # Five-point difference: the solver's noise of 1e-9 over h and a fifth derivative of order
    # ten times h^4 balance near h = 5e-3, with an error of some 1e-6.
    h = 5e-3 * jnp.eye(flat.size)
    at = [[forward_and_values(k * x)[1] for k in (-2, -1, 1, 2)] for x in h]
    difference = [(8 * (b - a) - (more - less)) / (12 * 5e-3) for less, a, b, more in at]
    np.testing.assert_allclose(forward, jnp.stack(difference, -1), rtol=1e-5, atol=3e-6)
    # Forward and reverse share their Jacobian: round-off.
    np.testing.assert_allclose(reverse, forward, rtol=1e-10, atol=1e-13)
    # The mass of hard spheres is the one float that no curve depends on.
    names = [n for n, v in sorted(values.items()) for _ in range(v.size)]
    expected = jnp.array([n != "mass" or "youngs_modulus" in names for n in names])
    assert jnp.all(jnp.any(forward != 0, axis=(0, 1)) == expected)


@pytest.mark.slow
def test_second_derivative():
    gas = GASES["viscoelastic"]
    times = TAUS * gas.mean_free_time

    def loss(log_a):
        return jnp.sum(logs(gas.replace(dissipative_constant=jnp.exp(log_a)), times)[0])

    x, h = jnp.log(3e-6), 1e-3
    hessian = jax.jacfwd(jax.grad(loss))(x)
    difference = (jax.grad(loss)(x + h) - jax.grad(loss)(x - h)) / (2 * h)
    np.testing.assert_allclose(hessian, difference, rtol=1e-4)


def test_a_solver_that_fails_has_no_derivative():
    gas = glass_beads(0.3, packing_fraction=0.1)
    model = jaxgran.KineticTheory(max_steps=2)
    times = gas.mean_free_time * jnp.asarray([1.0, 1e4])

    def temperature(A):
        changed = gas.replace(dissipative_constant=A)
        return jaxgran.cool(changed, times, model=model).temperature[-1]

    assert np.all(np.isnan(jax.jit(jax.value_and_grad(temperature))(gas.dissipative_constant)))
