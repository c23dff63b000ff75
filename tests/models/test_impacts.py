"""Single impacts of hard spheres and of DSMC: the rule of rough spheres, and drag."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.dsmc.collisions import collide
from jaxgran.particles.hard.impacts import ImpactEvents, impact_effect
from jaxgran.scene.gas import ReducedDrag, ReducedRough, ReducedScene, SphereScene
from tests.beads import glass_beads

ZERO = jnp.zeros(())


def of_dsmc(relative, spin, material):
    """Normals that are drawn, changes of velocities and spins, energy lost and gain of the spins.

    The energies are those of both spheres of all pairs, in unit masses.
    """
    bits = jax.random.bits(jax.random.key(0), (2, len(relative)), jnp.uint32)
    smooth, rough = (
        collide(relative, bits, jnp.asarray(3.0), jnp.ones(()), scene, None, spin)
        for scene in (material._replace(surface=None), material)
    )
    size = jnp.linalg.norm(smooth.kick, axis=1, keepdims=True)
    normal = -smooth.kick / jnp.where(size > 0, size, 1.0)
    return normal, rough.kick, rough.spin_change, rough.loss / 2, rough.rotational_gain / 2


def of_hard_spheres(relative, spin, material):
    """The same at given normals."""
    normal = np.random.default_rng(1).normal(size=relative.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    speed = np.sum(relative * normal, -1)
    normal = jnp.asarray(np.sign(speed)[:, None] * normal)  # they approach
    n = len(relative)
    impact = ImpactEvents(jnp.zeros(n), normal, relative, jnp.abs(speed), spin, jnp.zeros(n, bool))
    effect = impact_effect(SphereScene(ZERO, None, ZERO, ZERO, material), impact)
    lost, gained = (2 * jnp.sum(x) for x in (effect.lost, effect.rotational_gain))
    return normal, effect.kick, effect.spin_change, lost, gained


@pytest.mark.parametrize("eps, beta", [(0.8, 0.3), (0.8, -1.0), (1.0, 1.0)])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("impacts", [of_dsmc, of_hard_spheres])
def test_impacts_keep_angular_momentum_and_follow_the_rule(impacts, dimension, eps, beta):
    # Unit masses and diameters, I = q/4, spins s = w/2, of both spheres. In 2D as in a plane.
    q, n, rng = 0.4, 400, np.random.default_rng(0)
    relative = jnp.asarray(rng.normal(size=(n, dimension)))
    spin = jnp.asarray(rng.normal(size=(n, 3 if dimension == 3 else 1)))
    surface = ReducedRough(jnp.asarray(beta), jnp.asarray(q), ZERO)
    material = ReducedScene(jaxgran.ConstantRestitution(eps), surface)
    normal, kick, spin_change, lost, gained = impacts(relative, spin, material)
    hit = np.any(normal != 0, axis=1)
    assert 50 < hit.sum() < n or impacts is of_hard_spheres and np.all(hit)
    assert not np.any(kick[~hit]) and not np.any(spin_change[~hit])

    def vectors(x):
        return np.pad(x[hit], ((0, 0), (0, 3 - x.shape[1])))

    def spins(x):
        return np.pad(x[hit], ((0, 0), (3 - x.shape[1], 0)))

    relative, normal, kick = map(vectors, (relative, normal, kick))
    spin, spin_change = map(spins, (spin, spin_change))

    def slip_and_approach(relative, spin):
        at_contact = relative + np.cross(spin, normal)
        along = np.sum(at_contact * normal, -1, keepdims=True) * normal
        return at_contact - along, along

    before = slip_and_approach(relative, spin)
    after = slip_and_approach(relative + 2 * kick, spin + 2 * spin_change)
    np.testing.assert_allclose(after[0], -beta * before[0], atol=1e-12)
    np.testing.assert_allclose(after[1], -eps * before[1], atol=1e-12)
    # Angular momentum of each sphere about the point of contact.
    np.testing.assert_allclose(np.cross(normal, kick), q * spin_change, atol=1e-12)
    assert float(lost) == pytest.approx(-np.sum((relative + kick) * kick), rel=1e-10)
    rotation = q * np.sum((spin + spin_change) * spin_change)
    assert float(gained) == pytest.approx(rotation, rel=1e-10, abs=1e-10)
    slip, approach = (np.sum(x**2) for x in before)
    expected = (1 - eps**2) / 4 * approach + q / (1 + q) * (1 - beta**2) / 4 * slip
    assert float(lost - gained) == pytest.approx(expected, rel=1e-10, abs=1e-10)


def test_laws_see_the_speeds_that_drag_has_left():
    n, gamma = 20, 0.3
    speed, time = jnp.linspace(0.1, 2.0, n), jnp.linspace(0.0, 2.5, n)
    law = glass_beads(0.5).reduced_law
    material = ReducedScene(law, drag=ReducedDrag(jnp.asarray(gamma / 2), None))
    scene = SphereScene(ZERO, None, jnp.asarray(2.0), ZERO, material)
    normal = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (n, 1))
    impact = ImpactEvents(time, normal, speed[:, None] * normal, speed, None, jnp.zeros(n, bool))
    eps = law.restitution(speed * (1 - gamma * time) / 2**0.5)
    lost = impact_effect(scene, impact).lost
    np.testing.assert_allclose(lost, (1 - eps**2) * speed**2 / 8, rtol=1e-9)
