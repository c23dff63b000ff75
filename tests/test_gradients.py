"""Every route to a derivative of a curve agrees with every other, in every float of the gas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxgran

TAUS = jnp.array([0.3, 3.0, 30.0, 300.0])


SCENE = {"diameter": 0.002, "mass": 1e-5, "packing_fraction": 0.1, "temperature": 0.01}
GASES = {
    "viscoelastic": jaxgran.Gas(jaxgran.Viscoelastic(5e7, 0.22, 3e-6), **SCENE),
    "constant": jaxgran.Gas(jaxgran.ConstantRestitution(0.9), **SCENE),
    "series": jaxgran.Gas(jaxgran.RestitutionSeries([-0.2, 0.05], [0.2, 0.4]), **SCENE),
}


def logs(gas, times):
    # Tighter than the default, whose noise differences would show.
    curve = jaxgran.cool(gas, times, model=jaxgran.KineticTheory(rtol=1e-9))
    return jnp.log(jnp.stack([curve.temperature, curve.displacement, curve.collisions]))


@pytest.mark.parametrize("law", ["viscoelastic", pytest.param("series", marks=pytest.mark.slow)])
def test_all_routes_agree(law):
    gas = GASES[law]
    times = TAUS * gas.mean_free_time
    values = {name: gas.value(name) for name in gas.domains}
    flat, unravel = ravel_pytree(values)

    @jax.jit
    def of(log_scale):
        scaled = unravel(flat * jnp.exp(log_scale))
        return logs(gas.replace(**scaled), times)

    zero = jnp.zeros_like(flat)
    forward, reverse = jax.jacfwd(of)(zero), jax.jacrev(of)(zero)
    # Five-point difference: the solver's noise of 1e-9 over h and a fifth derivative of order
    # ten times h^4 balance near h = 5e-3, with an error of some 1e-6.
    h = 5e-3 * jnp.eye(flat.size)
    difference = [(8 * (of(x) - of(-x)) - (of(2 * x) - of(-2 * x))) / (12 * 5e-3) for x in h]
    np.testing.assert_allclose(forward, jnp.stack(difference, -1), rtol=1e-5, atol=3e-6)
    # Forward and reverse share their Jacobian: round-off.
    np.testing.assert_allclose(reverse, forward, rtol=1e-10, atol=1e-13)
    assert jnp.all(jnp.any(forward != 0, axis=(0, 1)) == expected_to_matter(values))


def expected_to_matter(values):
    # The mass of hard spheres is the one float that no curve depends on.
    soft = "youngs_modulus" in values
    names = [n for n, v in sorted(values.items()) for _ in range(v.size)]
    return jnp.array([soft or n != "mass" for n in names])


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


@pytest.mark.slow
def test_haff_sensitivity_in_closed_form():
    gas = GASES["constant"]
    times = TAUS * gas.mean_free_time
    model = jaxgran.KineticTheory(sonine=False, correlations=False)

    def log_temperature(e):
        return jnp.log(jaxgran.cool(gas.replace(coefficient=e), times, model=model).temperature)

    e = 0.9
    gamma = (1 - e**2) / 6
    exact = 2 * TAUS / (1 + gamma * TAUS) * e / 3
    np.testing.assert_allclose(
        jax.jacfwd(log_temperature)(e), exact, rtol=1e-7
    )  # rtol of the solver
