"""Derivatives of every model: refused at second order, and nan where values are nan."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads

GAS = glass_beads(0.3, packing_fraction=0.1)
TAU = float(GAS.mean_free_time)


def cool(gas=GAS, times=(TAU,), **options):
    return jaxgran.cool(gas, times, progress=False, **options)


@pytest.mark.parametrize("kind", [jaxgran.SoftSpheres, jaxgran.HardSpheres, jaxgran.DSMC])
def test_second_derivatives_are_refused(kind):
    model = kind(20, replicas=2).sized_for(GAS)

    def log_temperature(x):
        A = GAS.value("dissipative_constant") * jnp.exp(x)
        curve = cool(GAS.replace(dissipative_constant=A), model=model)
        return jnp.log(curve.temperature[0])

    for second in (jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f))):
        with pytest.raises(ValueError, match="second derivative .* KineticTheory"):
            jax.eval_shape(second(log_temperature), 0.0)


DENSE = ("packing_fraction", 0.8)
HEATING = ("dissipative_constant", -1e-6)
NAN_CASES = [
    (jaxgran.KineticTheory(), *DENSE),
    pytest.param(jaxgran.KineticTheory(), *HEATING, marks=pytest.mark.slow),
    pytest.param(jaxgran.DSMC(20, replicas=2), *HEATING, marks=pytest.mark.minutes),
    pytest.param(jaxgran.HardSpheres(20).sized_for(GAS), *DENSE, marks=pytest.mark.minutes),
    pytest.param(jaxgran.SoftSpheres(20).sized_for(GAS), *HEATING, marks=pytest.mark.minutes),
]


@pytest.mark.slow
@pytest.mark.parametrize("model, name, value", NAN_CASES)
def test_derivatives_are_nan_where_values_are(model, name, value):
    def temperature(x):
        return cool(GAS.replace(**{name: x}), model=model, throw=False).temperature[0]

    def forward(x):
        return jax.jvp(temperature, (x,), (jnp.ones_like(x),))

    reverse = jax.value_and_grad(temperature)
    x, allowed = jnp.asarray(value), GAS.value(name)
    for found in (forward(x), reverse(x), jax.jit(reverse)(x)):
        assert np.all(np.isnan(found))
    for both in (forward, reverse):
        found = np.asarray(jax.vmap(both)(jnp.stack([x, allowed])))
        assert np.all(np.isnan(found[:, 0])) and np.all(np.isfinite(found[:, 1]))
