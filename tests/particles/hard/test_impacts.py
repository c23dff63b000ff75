"""Derivatives through hard spheres: the energies that impacts exchange."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxgran
from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles.hard.impacts import ImpactEvents, exchange_gains, impact_effect
from tests.beads import glass_beads, hard_gas, lattice


@pytest.mark.slow
@pytest.mark.parametrize(
    "law",
    [
        glass_beads(0.4).law,
        jaxgran.ConstantRestitution(0.7),
        jaxgran.RestitutionSeries([-0.2, 0.03], [0.2, 0.4]),
    ],
)
def test_gains_are_slopes_of_the_loss(law):
    gas = dataclasses.replace(glass_beads(0.4), law=law)
    scene = jaxgran.HardSpheres(50).scene(gas)
    g = jnp.array([0.03, 0.5, 2.0])
    normal = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (3, 1))
    impact = ImpactEvents(0 * g, normal, g[:, None] * normal, g, None, jnp.zeros(3, bool))
    flat, unravel = ravel_pytree(scene.material)

    def gain(flat, log_scale=0.0):
        faster = impact._replace(speed=g * jnp.exp(log_scale))
        return -impact_effect(scene._replace(material=unravel(flat)), faster).lost

    h = 1e-5
    steps = h * jnp.eye(flat.size)
    pairs = [(gain(flat + e), gain(flat - e)) for e in steps] + [(gain(flat, h), gain(flat, -h))]
    expected = jnp.stack([(more - less) / (2 * h) for more, less in pairs])
    directions = jax.vmap(unravel)(jnp.eye(flat.size))
    tangents = ExchangeTangents.initial(directions, scene.material, normal, 1)
    found = exchange_gains(scene, tangents, impact, jnp.array([True, True, False]))
    assert np.all(found[..., 2] == 0)  # this impact does not happen
    in_time = flat.size  # no impact has a longer or shorter duration
    assert np.all(found[in_time] == 0)
    # A central difference errs by h^2 and by round-off over h.
    known = np.delete(found[:, 0], in_time, axis=0)
    np.testing.assert_allclose(known[:, :2], expected[:, :2], atol=1e-9)


COEFFICIENT = 0.8


@pytest.fixture(scope="module")
def constant():
    """ln T of a gas of constant restitution, of (e, ln of all times, ln T_0), and its slopes."""
    gas = hard_gas(COEFFICIENT, 0.1)
    start = lattice(gas, 100, replicas=8)
    model = jaxgran.HardSpheres(100, replicas=8, start=start).sized_for(gas, spare=2.0)
    times = jnp.array([0.3, 1.0, 3.0]) * gas.mean_free_time

    def f(x, checkpoint=None):
        changed = gas.replace(coefficient=x[0], temperature=jnp.exp(x[2]))
        run = jaxgran.extend.Run(checkpoint=checkpoint)
        return jnp.log(model.simulate(changed, times * jnp.exp(x[1]), run).temperature)

    at = jnp.array([COEFFICIENT, 0.0, 0.0])
    slopes, values = jax.jacfwd(lambda x: (f(x),) * 2, has_aux=True)(at)  # by one program
    return f, at, values, slopes


@pytest.mark.slow
def test_constant_restitution_has_the_slopes_of_haff(constant):
    _, _, log_temperature, slopes = constant
    e, cooled = COEFFICIENT, 1 - jnp.exp(log_temperature / 2)
    # T = (1 + gamma t)^-2 with gamma as 1 - e^2, and the gas's own gamma: of Haff's law only a_2,
    # which depends on e, changes that, by 1 %.
    np.testing.assert_allclose(slopes[:, 0], 4 * e / (1 - e**2) * cooled, rtol=0.02)
    # The rate is a mean over the run: 240 impacts up to the first time, 2400 to the last.
    np.testing.assert_allclose(slopes[:, 1], -2 * cooled, rtol=0.04)
    # The start brings its own speeds.
    np.testing.assert_array_equal(slopes[:, 2], 0.0)


@pytest.mark.slow  # compiles what is written between blocks
def test_a_checkpoint_keeps_the_tangents(constant, tmp_path):
    f, at, _, slopes = constant
    kept = partial(f, checkpoint=tmp_path / "a.npz")
    for _ in range(2):  # run, and read
        np.testing.assert_array_equal(jax.jacfwd(kept)(at), slopes)
    with pytest.raises(ValueError, match="another run"):
        kept(at)


def test_a_start_has_no_projected_slope():
    gas = hard_gas(0.8, 0.01)
    apart = jnp.array([[[1.0, 1.0, 1.0], [3.0, 1.0, 1.0]]])

    def f(scale):
        start = jaxgran.Particles(apart, scale * apart, gas.box_side(2))
        return jaxgran.cool(gas, [1e-3], model=jaxgran.HardSpheres(2, start=start)).temperature[0]

    for derivative in (jax.grad, jax.jacfwd):
        with pytest.raises(ValueError, match="chaos"):
            derivative(f)(1.0)
