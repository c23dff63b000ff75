"""Single impacts in runs of hard spheres and of DSMC: the rule of rough spheres, and drag."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads
from tests.test_contract import BEADS, CASES, NO_LIMIT, given_elements

T_ROT = 0.4 * float(BEADS.temperature)
TAU = float(BEADS.mean_free_time)


def spheres_of(case, gas, end, key=0):
    """Velocities, spins s = sigma w/2 and places of all replicas, at the start and at the end."""
    times = np.linspace(0.0, end, 3)
    saved = case.run(gas, times, save="particles", key=jax.random.key(key)).saved
    parts = [saved.velocity, 0.5 * gas.diameter * saved.angular_velocity]
    parts += [saved.position] if case.model.has_positions else []
    return [np.reshape(np.asarray(x), (3, -1, x.shape[-1]))[::2] for x in parts]


def pairs_of(*kicks):
    """Indices of pairs that had one impact, that of each other: opposite kicks in all runs."""
    alone = True
    for kick in kicks:
        size, apart = np.linalg.norm(kick, axis=1), np.linalg.norm(kick[:, None] + kick, axis=2)
        alone = alone & (apart < 1e-9 * size.max()) & (size > 1e-3 * size.max())
    return np.nonzero(np.triu(alone, 1))


@pytest.mark.parametrize(
    "loss, beta, friction",
    [(1.0, 0.3, NO_LIMIT), (1.0, -1.0, NO_LIMIT), (0.0, 1.0, NO_LIMIT), (1.0, 0.3, 0.2)],
)
@pytest.mark.parametrize("dimension", [pytest.param(2, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("model", ["DSMC", pytest.param("hard spheres", marks=pytest.mark.slow)])
def test_impacts_keep_angular_momentum_and_follow_the_rule(model, dimension, loss, beta, friction):
    # Unit masses, I = q/4. In 2D as in a plane.
    case, q = CASES[model], 0.4
    gas = given_elements(case) if dimension == 3 else glass_beads(0.3, 2, packing_fraction=0.2)
    surface = jaxgran.Rough(beta, rotational_temperature=T_ROT, friction=friction)
    gas, eta = dataclasses.replace(gas, surface=surface), q * (1 + beta) / (2 * (1 + q))
    gas = gas.replace(dissipative_constant=loss * BEADS.value("dissipative_constant"))
    # Smooth spheres show the normals.
    smooth, end = gas.replace(tangential_restitution=-1.0), 0.4 * float(gas.mean_free_time)
    number = slides = 0
    for key in range(3):
        velocity, spin, *_ = spheres_of(case, gas, end, key)
        alone = spheres_of(case, smooth, end, key)[0]
        kick, changed, along = velocity[1] - velocity[0], spin[1] - spin[0], alone[1] - alone[0]
        i, j = pairs_of(along, kick)
        number += len(i)
        normal = np.pad(along[j], ((0, 0), (0, 3 - dimension)))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)

        def slip_and_approach(v, s, i=i, j=j, normal=normal):
            relative = np.pad(v[i] - v[j], ((0, 0), (0, 3 - v.shape[1])))
            both = np.pad(s[i] + s[j], ((0, 0), (3 - s.shape[1], 0)))
            at_contact = relative + np.cross(both, normal)
            approach = np.sum(at_contact * normal, -1)
            return at_contact - approach[:, None] * normal, approach

        before, after = map(slip_and_approach, velocity, spin)
        assert np.all(before[1] > 0)
        heat = float(gas.temperature) ** 0.5
        eps = np.asarray(gas.restitution(before[1]))
        limit = friction * (1 + eps) / 2 * before[1] / np.linalg.norm(before[0], axis=1)
        change = (1 + beta) * np.minimum(limit / max(eta, 1e-9), 1.0)[:, None]
        slides += np.sum(limit < eta)
        np.testing.assert_allclose(after[0], (1 - change) * before[0], atol=1e-9 * heat)
        np.testing.assert_allclose(after[1], -eps * before[1], atol=1e-9 * heat)
        # Angular momentum of each sphere about the point of contact.
        kick = np.pad(kick[i], ((0, 0), (0, 3 - dimension)))
        for k in (i, j):
            change = np.pad(changed[k], ((0, 0), (3 - changed.shape[1], 0)))
            np.testing.assert_allclose(np.cross(normal, kick), q * change, atol=1e-9 * heat)
    assert number > 20
    assert slides == 0 if friction == NO_LIMIT else 0.2 < slides / number < 0.9


@pytest.mark.slow
def test_laws_see_the_speeds_that_drag_has_left():
    case, gamma = CASES["hard spheres"], 1.0 / TAU
    gas, end = given_elements(case, drag=jaxgran.StokesDrag(gamma)), 0.5 * TAU
    gas = gas.replace(dissipative_constant=BEADS.value("dissipative_constant"))
    velocity, _, (place, _) = spheres_of(case, gas, end)
    kick = velocity[1] * np.exp(gamma * end) - velocity[0]
    i, j = pairs_of(kick)
    assert len(i) > 5
    # They meet where drag has left a share of their speeds and of the way without it.
    g, r, sigma = velocity[0][i] - velocity[0][j], place[i] - place[j], float(gas.diameter)
    b, square = np.sum(r * g, -1), np.sum(g**2, -1)
    way = (-b - np.sqrt(b**2 - square * (np.sum(r**2, -1) - sigma**2))) / square
    normal = (r + g * way[:, None]) / sigma
    approach, left = -np.sum(g * normal, -1), 1 - gamma * way
    assert np.min(left) < 0.7
    eps = np.asarray(gas.restitution(left * approach))
    expected = ((1 + eps) / 2 * approach)[:, None] * normal
    np.testing.assert_allclose(kick[i], expected, atol=1e-9 * float(gas.temperature) ** 0.5)
