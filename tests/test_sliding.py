"""Rough spheres that slide: Coulomb's limit of the tangential impulse in impacts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.state import tangential_impulse
from jaxgran.scene.gas import ReducedRough
from jaxgran.theory.equations import sliding_shares
from tests.beads import hard_gas


def sliding(friction, dimension=3, beta=0.5, T_rot=0.0, **elements) -> jaxgran.Gas:
    surface = jaxgran.Rough(beta, rotational_temperature=T_rot, friction=friction)
    return hard_gas(0.9, 0.02, dimension, surface=surface, **elements)


@pytest.mark.parametrize("dimension", [2, 3])
def test_impulse_sticks_below_the_limit_and_slides_at_it(dimension):
    n, mu, q, eps = 2000, 0.2, 0.4, 0.9
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(n, dimension))
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    relative = rng.normal(size=(n, dimension))
    spin = jnp.asarray(rng.normal(size=(n, 1 if dimension == 2 else 3)))
    push = (1 + eps) / 2 * np.abs(np.sum(relative * normal, axis=1))
    limited, free = (
        tangential_impulse(
            jnp.asarray(relative),
            spin,
            jnp.asarray(normal),
            jnp.ones(n, bool),
            rough.eta,
            rough,
            jnp.asarray(push),
        )
        for rough in (ReducedRough(*map(jnp.asarray, (0.5, q, 0.0, f))) for f in (mu, 1e9))
    )
    size, most = np.linalg.norm(free.kick, axis=1), mu * push
    slides = size > most
    assert 0.2 < slides.mean() < 0.9
    np.testing.assert_array_equal(limited.kick[~slides], free.kick[~slides])
    expected = free.kick * (most / size)[:, None]
    np.testing.assert_allclose(limited.kick[slides], expected[slides], rtol=1e-12)
    # Angular momentum: the torque on either sphere is that of the kick.
    np.testing.assert_allclose(
        np.linalg.norm(limited.spin_change, axis=1) * q,
        np.linalg.norm(limited.kick, axis=1),
        rtol=1e-12,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "model, limits",
    [
        (jaxgran.DSMC(300), (None, 1e9, 0.1)),
        (jaxgran.HardSpheres(100), (1e9, 0.1)),
    ],
)
def test_large_friction_is_no_limit(model, limits):
    walls = jaxgran.Walls(12.0, restitution=0.8, tangential_restitution=0.3)
    gas = sliding(None, container=walls)
    if isinstance(model, jaxgran.HardSpheres):
        gas = gas.replace(packing_fraction=100 * np.pi / 6 / 12.0**3)
    *stuck, slid = [
        jaxgran.cool(
            dataclasses.replace(gas, surface=dataclasses.replace(gas.surface, friction=mu)),
            [2.0, 5.0],
            model=model,
            key=jax.random.key(0),
            progress=False,
        )
        for mu in limits
    ]
    for name in ("temperature", "rotational_temperature"):
        each = [np.asarray(getattr(curve, name)) for curve in stuck]
        np.testing.assert_allclose(each[-1], each[0], rtol=1e-13)  # two programs
        assert np.all(np.abs(np.asarray(getattr(slid, name)) / each[0] - 1) > 1e-3)


@pytest.mark.parametrize("dimension, mu", [(2, 2.0), (3, 0.03), (3, 0.3)])
def test_shares_are_averages_over_slips_and_normal_speeds(dimension, mu):
    rough, n = ReducedRough(*map(jnp.asarray, (0.5, 0.4, 0.0, mu))), 2_000_000
    rng = np.random.default_rng(0)
    slip = rng.normal(size=(n, dimension - 1)) * np.sqrt(1 + 0.7 / 0.4)
    slip = np.linalg.norm(slip, axis=1)  # over sqrt(2 T)
    eta, push = float(rough.eta), 0.9 * rng.rayleigh(size=n)
    kick = np.minimum(eta * slip, mu * push)
    expected = (
        np.mean(kick * slip) / np.mean(eta * slip**2),
        np.mean(kick**2) / np.mean((eta * slip) ** 2),
    )
    found = sliding_shares(rough, rough.eta, 0.7, dimension, jnp.asarray(0.9))
    np.testing.assert_allclose(found, expected, rtol=4e-3)  # 2e6 samples


@pytest.mark.slow
@pytest.mark.parametrize("dimension, mu, T_rot", [(2, 0.3, 0.0), (3, 0.05, 0.0), (3, 0.1, 1.0)])
def test_theory_beside_dsmc(dimension, mu, T_rot):
    gas = sliding(mu, dimension)
    gas = gas.replace(rotational_temperature=T_rot * float(gas.temperature))
    times = np.array([3.0, 10.0, 30.0]) * float(gas.mean_free_time)
    theory = jaxgran.cool(gas, times, model=jaxgran.KineticTheory(correlations=False))
    model = jaxgran.DSMC(20_000, 2)
    curve = jaxgran.cool(gas, times, model=model, key=jax.random.key(0), progress=False)
    ratio, expected = (c.rotational_temperature / c.temperature for c in (theory, curve))
    np.testing.assert_allclose(theory.temperature, curve.temperature, rtol=0.02)
    # Spins that begin at 0 are not Gaussian: 3 % (3D, 2D) without a limit, too.
    np.testing.assert_allclose(ratio, expected, rtol={2: 0.09, 3: 0.07}[dimension])


@pytest.mark.slow
def test_a_fit_finds_friction_and_roughness_from_both_temperatures():
    truth = sliding(0.2, beta=0.5)
    times = np.linspace(0.0, 40.0, 25)[1:] * float(truth.mean_free_time)
    made = jaxgran.cool(truth, times)
    errors = {
        f"{name}_error": 0.005 * getattr(made, name)
        for name in ("temperature", "rotational_temperature")
    }
    curve = jaxgran.CoolingCurve(
        times=times,
        temperature=made.temperature,
        rotational_temperature=made.rotational_temperature,
        **errors,
    )
    start = sliding(0.5, beta=0.2)
    result = jaxgran.fit(start, curve, free=("friction", "tangential_restitution"))
    np.testing.assert_allclose(result.value("friction")[0], 0.2, rtol=0.01)
    np.testing.assert_allclose(result.value("tangential_restitution")[0], 0.5, atol=0.02)
