from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran import contact_force, impact

# beta, eps unclipped, eps clipped, contact time in X/v clipped: high-precision solutions of the
# impact equation, to the digits given.
REFERENCE = [
    (0.001, 0.99884734888593, 0.9988473573041, 3.2174368568),
    (0.01, 0.98854481865685, 0.98854743964273, 3.2117983002),
    (0.05, 0.94425997234334, 0.94439677917763, 3.1871469118),
    (0.1, 0.89214758729023, 0.89285887550655, 3.1572556558),
    (0.2, 0.79755006203945, 0.80096546813576, 3.1004127665),
    (0.5, 0.57382462866495, 0.59525150113513, 2.9504446857),
    (1.0, 0.33116481046664, 0.39393060322987, 2.7520265740),
    (5.0, 0.0016506820717733, 0.068899657679239, 2.0051302797),
]

SLOPES = [(0.01, -1.13698828), (0.1, -0.991601507), (0.5, -0.548253884), (1.0, -0.291955441)]
"""beta and d eps / d beta, clipped."""

unclipped_impact = jax.jit(partial(impact, clipped=False))
impact_and_slope = jax.jit(lambda beta: jax.jvp(impact, (beta,), (jnp.ones_like(beta),)))


@pytest.mark.figures
@pytest.mark.parametrize("beta, unclipped, clipped, duration", REFERENCE)
def test_impact_reproduces_reference(beta, unclipped, clipped, duration, record):
    result, _ = impact_and_slope(beta)
    # The solver's rtol is 1e-11; the reference has 13 digits (eps) and 11 (time).
    np.testing.assert_allclose(result.restitution, clipped, rtol=2e-11)
    np.testing.assert_allclose(result.duration, duration, rtol=5e-11)
    np.testing.assert_allclose(unclipped_impact(beta).restitution, unclipped, rtol=2e-11)
    record("impact", beta=beta, error=abs(float(result.restitution) / clipped - 1))


def test_elastic_impact():
    result, _ = impact_and_slope(0.0)
    np.testing.assert_allclose(result.restitution, 1.0, rtol=1e-10)
    # Closed forms: t_c = 2 (5/4)^(2/5) sqrt(pi) Gamma(7/5) / Gamma(9/10) and (5/4)^(2/5).
    np.testing.assert_allclose(result.duration, 3.21806546, rtol=1e-8)
    np.testing.assert_allclose(result.largest_overlap, (5 / 4) ** 0.4, rtol=1e-10)


def test_heavy_damping_limits():
    # Leading powers; the clipped one is approached as beta^(-5/3): 2e-4 at 1e3.
    clipped = impact_and_slope(1e3)[0].restitution
    unclipped = unclipped_impact(100.0).restitution
    np.testing.assert_allclose(clipped, (3 / 2) ** (2 / 3) * 1e3 ** (-5 / 3), rtol=2e-4)
    np.testing.assert_allclose(unclipped, 5.15838170427e-10, rtol=1e-10)


@pytest.mark.parametrize("beta, slope", SLOPES)
def test_derivative_of_restitution(beta, slope):
    _, result = impact_and_slope(beta)
    # The reference has nine digits.
    np.testing.assert_allclose(result.restitution, slope, rtol=5e-9)


def test_impact_obeys_the_contact_force():
    # The regular variable and the force law are two routes: Verlet on the second must reach the
    # first. 2e5 steps leave the sqrt onset's error, dt^(3/2) = 1e-6.
    beta, dt = 0.2, 3.2e-5

    def step(carry, _):
        xi, v = carry
        half = v - 0.5 * dt * contact_force(xi, v, 1.0, beta / 1.5)
        xi = xi + dt * half
        v = half - 0.5 * dt * contact_force(xi, half, 1.0, beta / 1.5)
        return (xi, v), None

    (_, v), _ = jax.lax.scan(step, (jnp.zeros(()), jnp.ones(())), None, length=110_000)
    np.testing.assert_allclose(-v, 0.80096546813576, rtol=5e-5)


def test_force_is_never_attractive_unless_asked():
    assert contact_force(1e-3, -1.0, 1.0, 1.0) == 0.0
    assert contact_force(1e-3, -1.0, 1.0, 1.0, clipped=False) < 0.0
    assert contact_force(-1e-3, 1.0, 1.0, 1.0) == 0.0
    grads = jax.grad(contact_force, argnums=(0, 1, 2, 3))(0.0, 1.0, 2.0, 0.5)  # at touch
    assert all(jnp.isfinite(g) for g in grads)
