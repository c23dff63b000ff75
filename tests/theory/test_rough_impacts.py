"""Averages over the impacts of rough spheres: by numerical integration, and over sampled pairs."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma

from jaxgran.theory.rough_impacts import rough_energy_moments, slip_moments


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("m", [0.03, 0.7, 4.9, 40.0])
def test_slip_moments_are_averages_over_slips_and_normal_speeds(dimension, m):
    def mean(power_y, power_z, power_x):
        def integrand(angle):
            x, y = np.sin(angle), np.cos(angle)
            z = min(y, m * x)
            return y ** (power_y + dimension - 2) * z**power_z * x ** (power_x + 1)

        power = power_y + power_z + power_x + dimension
        radial = 2 ** ((power - 1) / 2) * gamma((power + 1) / 2)
        norm = 1 if dimension == 3 else np.sqrt(2 / np.pi)
        return norm * radial * quad(integrand, 0, np.pi / 2, points=[np.arctan(1 / m)])[0]

    powers = [(1, 1, 0), (0, 2, 0), (2, 2, 0), (3, 1, 0), (0, 4, 0), (1, 3, 0), (1, 1, 2)]
    powers.append((0, 2, 2))
    expected = [mean(*x) for x in powers]
    np.testing.assert_allclose(slip_moments(jnp.asarray(m), dimension), expected, rtol=1e-10)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("friction", [None, 0.2, 0.05])
def test_energies_of_rough_impacts_are_those_of_sampled_pairs(dimension, friction):
    rng, n = np.random.default_rng(0), 400_000
    spin, q, beta, eps = 1.3, 0.4, 0.2, 0.8
    eta, kick = q * (1 + beta) / (2 * (1 + q)), (1 + eps) / 2
    g_n = 2 * np.sqrt(rng.exponential(1, n))  # relative, of variance 2 T, weighted by itself
    g = np.sqrt(2) * rng.normal(size=(n, dimension - 1))
    s = np.sqrt(2 * spin) * rng.normal(size=(n, dimension - 1))
    slip = np.linalg.norm(g + s, axis=1)
    impulse = eta * slip
    if friction is not None:
        impulse = np.minimum(impulse, friction * kick * g_n)
    e = -(1 - eps**2) * g_n**2 / 4 + impulse**2 - impulse * np.sum(g * (g + s), 1) / slip
    e_rot = impulse**2 / q - impulse * np.sum(s * (g + s), 1) / slip
    m = None if friction is None else jnp.asarray(friction * kick / eta / np.sqrt(1 + spin))
    loss = 1 - eps**2
    losses = jnp.asarray(2 * loss), jnp.asarray(8 * loss**2)
    args = jnp.asarray(eta), jnp.asarray(q), jnp.asarray(2.0), jnp.asarray(2 * spin)
    means, squares = rough_energy_moments(losses, m, *args, dimension)
    sampled = [e, e_rot], [e * e, e * e_rot, e_rot * e_rot]
    closed = means, [squares[0, 0], squares[0, 1], squares[1, 1]]
    for values, expected in zip(sum(sampled, []), [*closed[0], *closed[1]], strict=True):
        # Four standard errors of a sample.
        assert abs(values.mean() - float(expected)) < 4 * values.std() / np.sqrt(n)
    assert squares[0, 1] == squares[1, 0]
