"""Transformed time of runs with drag, and their derivatives in its rate."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.elements import flight_time, true_duration
from jaxgran.scene.reduced import ReducedDrag
from tests.beads import hard_gas


@pytest.mark.parametrize("z", [0.0, 1e-9, 0.00999, 0.01001, 0.5])
def test_durations_invert_each_other_with_their_derivatives(z):
    start, duration = 0.3, 2.0

    def again(rate):
        """Return a duration that was transformed, at the velocity that is left, and back."""
        drag = ReducedDrag(rate, None)
        left = 1 - rate * start
        return true_duration(drag, start, flight_time(rate, duration) * left)

    value, slope = jax.value_and_grad(again)(z / duration)
    np.testing.assert_allclose(value, duration, rtol=1e-14)
    np.testing.assert_allclose(slope, 0.0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("model", [jaxgran.DSMC(500), jaxgran.HardSpheres(64)])
def test_a_gas_without_drag_has_a_derivative_in_its_rate(model):
    """At constant eps drag changes no collision: T is exp(-2 gamma t) T(s), s = t - gamma t^2/2."""
    gas = dataclasses.replace(hard_gas(0.8, 0.1), drag=jaxgran.StokesDrag(0.0))
    times = gas.mean_free_time * jnp.array([2.0, 4.0])

    def logs(rate):
        curve = jaxgran.cool(gas.replace(drag_rate=rate), times, model=model, progress=False)
        return jnp.log(curve.temperature)

    _, slope = jax.jvp(logs, (0.0,), (1.0,))
    _, by_time = jax.jvp(
        lambda t: jnp.log(jaxgran.cool(gas, t, model=model, progress=False).temperature),
        (times,),
        (jnp.ones(2),),
    )
    np.testing.assert_allclose(slope, -2 * times - times**2 / 2 * by_time, rtol=1e-9)
    rate = 0.1 / float(times[-1])
    difference = (logs(rate) - logs(0.0)) / rate
    np.testing.assert_allclose(slope, difference, rtol=0.1)
