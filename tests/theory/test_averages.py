"""Averages over impacts and moments of a Sonine gas, each against an independent number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.theory.averages import NUM_RESTITUTIONS, collision_changes, impact_moments
from tests.beads import hard_gas, theory_curve, without


def test_averages_of_constant_restitution():
    # Closed forms for a_2 = 0, in share = S_d / sqrt(2 pi): share (1 - e^2)/2, share (1 + e)/d.
    e, law = 0.7, jaxgran.ConstantRestitution(0.7)
    for d, share in ((2, np.sqrt(2 * np.pi)), (3, 2 * np.sqrt(2 * np.pi))):
        moments = impact_moments(law, jnp.ones(()), d)
        mu_2 = share * (1 - e**2) / 2
        mu_4 = (d + 1.5 + e**2) * mu_2  # van Noije & Ernst 1998, Eq. (12)
        expected = [mu_2, mu_4, share * (1 + e) / d]
        np.testing.assert_allclose(moments[:, 0], expected, rtol=1e-12)


# a_2, a_3, D n sigma^(d-1)/sqrt(2 T) of the homogeneous cooling state: direct simulation by a code
# of its own in C, 1e5 particles over 25 relaxations of D. Errors: a_2 1e-4 (1.7e-4 for small eps),
# a_3 1.2e-4 (7e-4), D .1 %.
SIMULATED = """
3 1.0 0 0 .15245
3 .9 -.01560 -.00437 .16727
3 .8 -.01412 -.00541 .18385
3 .7 -.00074 -.00507 .20395
3 .5 .04794 -.01345 .25621
3 .2 .12769 -.05902 .39554
3 .05 .15621 -.08304 .51845
2 1.0 0 0 .20499
2 .9 -.03045 -.01065 .22326
2 .8 -.02669 -.01212 .24525
2 .7 -.00219 -.01041 .27039
2 .5 .07311 -.02610 .33772
2 .2 .17811 -.11173 .52190
2 .05 .20881 -.14798 .68425
"""
ROWS = np.array(SIMULATED.split(), float).reshape(-1, 5)


def cooling_state(dimension, eps):
    """a_2, a_3 and D, relaxed: all eps as one batch, so that each dimension is compiled once."""
    gas = hard_gas(0.5, 0.01, dimension)

    def one(e):
        # 60 collisions by Haff's law, exp(-11) of the start of D at eps = .05.
        loss = jnp.maximum((1 - e**2) / (2 * dimension), 1e-9)
        taus = jnp.expm1(60 * loss) / loss * jnp.array([0.5, 1.0])
        curve = theory_curve(
            gas.replace(coefficient=e), taus, corrections=without("correlations"), rtol=1e-6
        )
        reduced = curve.diffusion / gas.path_length / jnp.sqrt(2 * curve.temperature)
        return curve.sonine[-1], curve.third_sonine[-1], reduced[-1]

    return jax.vmap(one)(jnp.asarray(eps))


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_cooling_state_agrees_with_direct_simulation(dimension):
    _, eps, a2, a3, diffusion = ROWS[ROWS[:, 0] == dimension].T
    found = cooling_state(dimension, eps)
    # Asked: a_2 within 3 %, a_3 within 10 %, D within .5 %; besides, three errors of simulation.
    assert np.all(np.abs(found[0] - a2) < 0.03 * np.abs(a2) + 3e-4)
    assert np.all(np.abs(found[1] - a3) < 0.1 * np.abs(a3) + 4e-4)
    # Disks of eps = .05 are .6 % off, with an error of .1 % of the simulation.
    np.testing.assert_allclose(found[2], diffusion, rtol={3: 5e-3, 2: 6.5e-3}[dimension])
    # Second Sonine approximation over the first of elastic spheres (Chapman & Cowling, 10.21).
    first = {2: 0.19947, 3: 0.14960}[dimension]
    np.testing.assert_allclose(found[2][0] / first, {2: 1.0238, 3: 1.0172}[dimension], atol=2e-4)


def test_elastic_relaxation_of_a2_and_a3():
    # Elastic spheres in 3D: mu_4 linear in a_2 is 4 sqrt(2 pi) a_2 (van Noije & Ernst 1998).
    x, weights = np.polynomial.legendre.leggauss(60)
    g = 4.5 * (x + 1)
    weights = 4.5 * weights * g * np.exp(-(g**2) / 2)
    matrix = collision_changes(3, 3, tuple(g))[..., 0, :]
    weights *= 4 * np.pi / np.sqrt(8 * np.pi)
    np.testing.assert_allclose((matrix @ weights)[0], 0.0, atol=1e-12)  # energy is kept
    # Order 2 without the closure, by the same route.
    linear = collision_changes(3, 2, tuple(g))[1, 1, 0] @ weights
    np.testing.assert_allclose(linear, 4 * np.sqrt(2 * np.pi), rtol=1e-5)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("eps", [0.2, 0.7])
def test_changes_agree_with_sampled_impacts(dimension, eps):
    # One impact of two Maxwellian spheres at a time, sampled: changes of c^2, c^4, c^6 and of the
    # velocity of a labelled sphere at a fixed normal speed.
    rng, g, n = np.random.default_rng(1), 1.3, 400_000
    centre = rng.normal(0, 0.5, (n, dimension))
    relative = rng.normal(0, 1, (n, dimension))
    relative[:, 0] = g
    after = relative * np.r_[-eps, np.ones(dimension - 1)]
    one, other = centre + relative / 2, centre - relative / 2
    new, other_new = centre + after / 2, centre - after / 2
    square = [np.sum(x**2, axis=1) for x in (one, other, new, other_new)]
    sampled = [square[0] ** p + square[1] ** p - square[2] ** p - square[3] ** p for p in (1, 2, 3)]
    kept = np.sum(one * new, axis=1)
    s1, dot = [dimension / 2 + 1 - x for x in square], 4 / dimension
    for j in (False, True):
        lost = (square[0] - kept) if not j else square[0] * s1[0] - kept * s1[2]
        sampled += [dot * lost, dot * lost * s1[0]]
    powers = (1 - eps) ** np.arange(NUM_RESTITUTIONS)
    exact = np.einsum("rpn,p->r", collision_changes(dimension, 3, (g,))[:, 0], powers)
    for value, samples in zip(exact, sampled, strict=True):
        error = np.std(samples) / n**0.5
        assert abs(np.mean(samples) - value) < 4 * error + 1e-9
