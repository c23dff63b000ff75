"""The waves of a flow that the measured memories keep of a tangent."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.accuracy import flow_memory
from experiments.support.flow_projection import kinetic_relaxation
from experiments.support.flow_waves import Memory, Waves, columns, fit, vectors

SIDE, NUMBER = 3.0, 400
RELAXATION = jnp.asarray(0.1)


@pytest.fixture(autouse=True)
def loose():
    """Experiments run without the tests' strictness of ranks."""
    with jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def gas():
    """Random places, and velocities with a shear flow along y that changes along x."""
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.uniform(0, SIDE, (NUMBER, 3)))
    v = jnp.asarray(rng.normal(size=(NUMBER, 3)))
    flow = jnp.cos(2 * jnp.pi * x[:, :1] / SIDE) * jnp.array([0.0, 1.0, 0.0])
    return x, v + flow - jnp.mean(v + flow, 0)


@pytest.mark.parametrize(("squares", "number"), [((1,), 3), ((2,), 6), ((1, 2), 9), ((8, 9), 21)])
def test_one_of_each_pair_of_wave_vectors(squares, number):
    found = vectors(3, squares)
    assert len(found) == number
    everyone = {tuple(n) for n in found} | {tuple(-n) for n in found}
    assert len(everyone) == 2 * number


def test_gradient_is_that_of_the_field(gas):
    x, v = gas
    waves = Waves(x, jnp.asarray(SIDE), (1, 2))
    across, along = waves.split(v)
    direction = jnp.asarray(np.random.default_rng(1).normal(size=x.shape))

    def field(x):
        return Waves(x, jnp.asarray(SIDE), (1, 2)).field(across)

    moved = jax.jvp(field, (x,), (direction,))[1]
    gradient = waves.gradient(across)
    # Round-off of some hundred terms of order one.
    np.testing.assert_allclose(moved, jnp.einsum("nij,nj->ni", gradient, direction), atol=1e-12)
    np.testing.assert_allclose(jnp.trace(gradient, axis1=1, axis2=2), 0.0, atol=1e-12)
    np.testing.assert_allclose(sum(jnp.sum(a * waves.k) for a in across), 0.0, atol=1e-12)
    assert float(jnp.max(jnp.abs(waves.field(along)))) > 0.01


@pytest.mark.parametrize(
    "name",
    [
        "transverse waves, 2",
        "waves of flow, heat, stress, 1",
        "energy, 2, Enskog's stress",
        "energy and stress, 2",
        "energy, stress, heat, density, 2",
    ],
)
def test_a_change_that_is_kept_is_found_again(gas, name):
    x, v = gas
    memory = flow_memory.MEMORIES[name]
    kept, _ = jax.jit(partial(columns, memory))(x, v, jnp.asarray(SIDE), RELAXATION)
    amounts = jnp.asarray(np.random.default_rng(2).normal(size=(2, len(kept))))
    rest = jnp.einsum("pa,and->pnd", amounts, kept)
    again = jnp.einsum("pa,and->pnd", fit(kept, rest, jnp.ones(NUMBER)), kept)
    # The ridge of the least squares is 1e-9 of a column.
    np.testing.assert_allclose(again, rest, atol=1e-6 * float(jnp.max(jnp.abs(rest))))


def test_what_is_kept_has_the_energy_of_temperature_and_bands(gas):
    x, v = gas
    memory = Memory(flow=((1,), (2,)), stress=((1,),))
    kept, _ = columns(memory, x, v, jnp.asarray(SIDE), RELAXATION)
    rest = jnp.asarray(np.random.default_rng(3).normal(size=(1, NUMBER, 3)))
    found = jnp.einsum("pa,and->pnd", fit(kept, rest, jnp.ones(NUMBER)), kept)
    lost = jnp.einsum("and,pnd->pa", kept, rest - found)
    # The ridge of the least squares is 1e-9 of a column.
    np.testing.assert_allclose(lost, 0.0, atol=1e-5)


def test_kinetic_viscosity_of_enskog():
    # phi = .3: eta_0 = .17631, chi = .85/.343, eta_K = eta_0 (1 + 1.6 .3 chi)/chi, rho = 1.8/pi.
    side = jnp.asarray((100 * np.pi / 6 / 0.3) ** (1 / 3))
    chi = 0.85 / 0.343
    expected = 0.176311 * (1 + 0.48 * chi) / chi / (1.8 / np.pi)
    assert float(kinetic_relaxation(100, side)) == pytest.approx(expected, rel=1e-5)  # its digits


def test_bounds_take_both_times():
    def row(at_30, at_100, error=0.01):
        return {"collisions": [30.0, 100.0], "d_ln_T_d_ln_A": [[at_30, at_100], [0.01, error]]}

    assert flow_memory.within_bounds(row(-0.979, -0.811))
    assert not flow_memory.within_bounds(row(-1.05, -0.811))
    assert not flow_memory.within_bounds(row(-0.979, -0.7))
    assert not flow_memory.within_bounds(row(-0.979, -0.811, error=0.2))
