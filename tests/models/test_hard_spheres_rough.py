"""Rough hard spheres: single impacts, conserved quantities, and gases beside DSMC."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.hard.impacts import HardScene, ImpactEvents, pair_effect
from jaxgran.scene.reduced import ReducedRough
from tests.beads import glass_beads


def rough(gas, *values, **settings) -> jaxgran.Gas:
    return dataclasses.replace(gas, surface=jaxgran.Rough(*values, **settings))


@pytest.mark.parametrize("beta", [-1.0, -0.4, 0.7])
@pytest.mark.parametrize("dimension", [2, 3])
def test_impacts_keep_angular_momentum_and_follow_the_rule(dimension, beta):
    # Unit masses and diameters, I = q/4, spins s = w/2. In 2D as spheres in a plane.
    q, eps, n = 0.4, 0.8, 50
    rng = np.random.default_rng(1)
    r, w = rng.normal(size=(2, n, 3))
    v = np.stack([w, np.zeros_like(w)])
    omega = rng.normal(size=(2, n, 3))
    if dimension == 2:
        r[:, 2] = v[..., 2] = 0
        omega[..., :2] = 0
    normal = r / np.linalg.norm(r, axis=1, keepdims=True)
    approach = -np.sum(v[0] * normal, -1)
    v[0] = np.where(approach[:, None] < 0, -v[0], v[0])
    zero = jnp.zeros(())
    shown, turning = (slice(None), slice(None)) if dimension == 3 else (slice(2), slice(2, 3))
    scene = HardScene(
        *[zero] * 5, surface=ReducedRough(jnp.asarray(beta), jnp.asarray(q), zero)
    )._replace(law=jaxgran.ConstantRestitution(eps))
    effect = pair_effect(
        scene,
        ImpactEvents(
            time=jnp.zeros(n),
            normal=-jnp.asarray(normal[:, shown]),
            relative=jnp.asarray(v[0][:, shown]),
            speed=jnp.abs(approach),
            spin=jnp.asarray(omega.sum(0)[:, turning] / 2),
            elastic=jnp.zeros(n, bool),
        ),
    )
    change, spin_change = np.zeros((n, 3)), np.zeros((n, 3))
    change[:, shown], spin_change[:, turning] = effect.kick, effect.spin_change
    after = v + np.stack([change, -change])
    spun = omega + 2 * spin_change[None]

    def at_contact(v, omega):
        return v[0] - v[1] - 0.5 * np.cross(omega[0] + omega[1], normal)

    before, behind = at_contact(v, omega), at_contact(after, spun)

    def parts(u):
        along = np.sum(u * normal, -1, keepdims=True)
        return along, u - along * normal

    np.testing.assert_allclose(parts(behind)[0], -eps * parts(before)[0], atol=1e-12)
    np.testing.assert_allclose(parts(behind)[1], -beta * parts(before)[1], atol=1e-12)
    # Angular momentum about the point of contact.
    lever = np.stack([0.5 * normal, -0.5 * normal])
    rotational_gain = np.cross(lever, after - v) + q / 4 * (spun - omega)
    np.testing.assert_allclose(rotational_gain.sum(0), 0, atol=1e-12)
    np.testing.assert_allclose(rotational_gain, 0, atol=1e-12)  # of each sphere alone
    translation, rotation = (
        [c * np.sum(x**2, (0, 2)) for x in pair]
        for c, pair in ((0.5, (v, after)), (q / 8, (omega, spun)))
    )
    np.testing.assert_allclose(translation[0] - translation[1], 2 * effect.lost, atol=1e-12)
    np.testing.assert_allclose(rotation[1] - rotation[0], 2 * effect.rotational_gain, atol=1e-12)
    normal_part, slip = (np.sum(x**2, -1) for x in parts(before))
    lost = 0.25 * (1 - eps**2) * normal_part + 0.25 * q / (1 + q) * (1 - beta**2) * slip
    np.testing.assert_allclose(2 * (effect.lost - effect.rotational_gain), lost, atol=1e-12)


def run(gas, num_particles, replicas, taus, key=0, kind=jaxgran.HardSpheres):
    times = jnp.asarray(taus) * gas.mean_free_time
    model = kind(num_particles, replicas=replicas)
    return jaxgran.cool(gas, times, model=model, key=jax.random.key(key))


@pytest.mark.slow
def test_energy_of_rough_disks_is_conserved():
    gas = rough(glass_beads(dimension=2), 0.3, rotational_temperature=2e-3)
    curve = run(gas, 200, 2, [0.0, 1.0, 10.0])
    energy = 2 * curve.temperature + curve.rotational_temperature
    total = 0.5 * gas.mass * energy + curve.dissipated_energy
    np.testing.assert_allclose(total, total[0], rtol=1e-12)
    assert float(curve.rotational_temperature[0]) == pytest.approx(2e-3, rel=1e-12)


@pytest.mark.slow
def test_rough_disks_cool_as_in_dsmc():
    gas = rough(glass_beads(packing_fraction=0.02, dimension=2), 0.5)
    taus = [1.0, 5.0, 20.0]
    hard = run(gas, 500, 8, taus)
    dsmc = run(gas, 20_000, 2, taus, kind=jaxgran.DSMC)
    # Three standard errors, and 2 % for Enskog's collision rate: in a plane successive collisions
    # are correlated.
    for name in ("temperature", "rotational_temperature"):
        ratio = np.asarray(getattr(hard, name) / getattr(dsmc, name))
        error = np.hypot(
            getattr(hard, f"{name}_error") / getattr(hard, name),
            getattr(dsmc, f"{name}_error") / getattr(dsmc, name),
        )
        assert np.all(np.abs(ratio - 1) < 3 * error + 0.02)
