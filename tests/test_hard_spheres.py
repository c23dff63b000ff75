from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import events, simulation
from jaxgran.models.hard_spheres import HardSpheres, reduced_scene
from jaxgran.neighbours import find_pairs
from jaxgran.observables import pair_correlation

DATA = Path(__file__).parent.parent / "experiments" / "data"


def quiet(num_particles, **settings) -> HardSpheres:
    return HardSpheres(num_particles, progress=False, **settings)


def hard_gas(law=1.0, packing_fraction=0.1, dimension=3, **values) -> jaxgran.Gas:
    """Of diameter, mass and temperature 1, so that SI and reduced units are the same."""
    if not isinstance(law, jaxgran.RestitutionLaw):
        law = jaxgran.ConstantRestitution(law)
    values = {"diameter": 1.0, "mass": 1.0, "temperature": 1.0, **values}
    return jaxgran.Gas(law, packing_fraction=packing_fraction, dimension=dimension, **values)


def serial(gas, start, end):
    """A plain event-driven code: find the earliest of all impacts, execute it, begin again.

    Returns positions, velocities and how often each particle collided.
    """
    x, v = np.array(start.position[0]), np.array(start.velocity[0])
    side, now = float(start.box_side), 0.0
    i, j = np.triu_indices(len(x), 1)
    images = np.stack(np.meshgrid(*[[-1, 0, 1]] * x.shape[1], indexing="ij"), -1)
    images = side * images.reshape(-1, x.shape[1])
    counts, loss = np.zeros(len(x), int), 0.0
    just = None
    while True:
        r = (x[i] - x[j])[:, None] - side * np.round((x[i] - x[j]) / side)[:, None] + images
        w = (v[i] - v[j])[:, None]
        b, c, w2 = (r * w).sum(-1), (r * r).sum(-1) - 1, (w * w).sum(-1)
        square = b * b - w2 * c
        hit = (b < 0) & (square > 0)
        if just is not None:
            hit[just] = False  # receding but for round-off
        dt = np.where(hit, c / (np.sqrt(np.where(hit, square, 1.0)) - b), np.inf)
        pair, image = np.unravel_index(np.argmin(dt), dt.shape)
        step = max(dt[pair, image], 0.0)
        if now + step > end:
            return x + v * (end - now), v, counts, loss
        x, now = x + v * step, now + step
        a, b = i[pair], j[pair]
        normal = r[pair, image] + w[pair, 0] * step
        normal /= np.linalg.norm(normal)
        speed = -(v[a] - v[b]) @ normal
        eps = float(gas.restitution(speed))
        kick = 0.5 * (1 + eps) * speed * normal
        v[a], v[b] = v[a] + kick, v[b] - kick
        counts[[a, b]] += 1
        loss += 0.25 * (1 - eps**2) * speed**2
        just = pair


@pytest.mark.parametrize(
    "dimension, packing_fraction, law",
    [
        (2, 0.1, 0.9),
        (2, 0.6, 0.8),
        (3, 0.02, jaxgran.Viscoelastic(5e7, 0.22, 1e-6)),
        (3, 0.3, jaxgran.RestitutionSeries([-0.1], [0.2])),
        (3, 0.45, 1.0),
        (3, 0.2, 0.4),
    ],
)
def test_impacts_are_those_of_a_serial_code(dimension, packing_fraction, law):
    gas = hard_gas(law, packing_fraction, dimension)
    tau, n = float(gas.mean_free_time), 40
    start = jaxgran.cool(gas, [0.1 * tau], model=quiet(n)).particles
    num_impacts = 0
    for _ in range(4):
        curve = jaxgran.cool(gas, [3 * tau], model=quiet(n, contact_time=0.0, start=start))
        x, v, counts, loss = serial(gas, start, 3 * tau)
        assert round(float(curve.collisions[-1]) * n) == counts.sum()
        num_impacts += counts.sum() // 2
        # Round-off grows e^2 to e^5 in each of some three impacts of a sphere: 1e-16 to 1e-9.
        heat = float(np.sqrt(curve.temperature[-1]))
        np.testing.assert_allclose(curve.particles.velocity[0], v, atol=1e-7 * heat)
        apart = np.asarray(curve.particles.position[0]) - x
        side = float(start.box_side)
        np.testing.assert_allclose(apart - side * np.round(apart / side), 0.0, atol=1e-7)
        assert float(curve.dissipated_energy[-1]) * n == pytest.approx(loss, abs=1e-7)
        velocity = curve.particles.velocity / heat
        start = curve.particles._replace(velocity=velocity)
    assert num_impacts > 100
