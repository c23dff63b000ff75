"""Replicas on two CPU devices; `test_groups.py` runs these tests in a process that has them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.groups import Groups, grouped
from tests.beads import assert_same, glass_beads, lattice, soft_beads

TIMES = jnp.array([0.01, 0.03])
KEY = jax.random.key(4)
GAS = glass_beads(packing_fraction=0.1)


def cool(model, gas=GAS, **options):
    return jaxgran.cool(gas, TIMES, model=model, progress=False, **options)


def fastest(particles):
    return jnp.sort(jnp.sum(particles.velocity**2, axis=1))[-2:]


def test_there_are_two_devices():
    devices = tuple(jax.devices())
    assert len(devices) == 2
    assert grouped(2, 20) == Groups(2, devices) and grouped(3, 0) == Groups(3, devices)
    with jax.default_device(devices[1]):
        assert grouped(2, 20) == grouped(2, 8192) == Groups(1)


def test_a_replica_is_the_same_whatever_their_number(tmp_path):
    files = {"save": fastest, "trajectory": tmp_path / "run.xyz"}
    two = cool(jaxgran.HardSpheres(20, replicas=2), key=KEY, **files)
    three = cool(jaxgran.HardSpheres(20, replicas=3), key=KEY, save=fastest)
    for field in ("temperature", "collisions", "displacement", "saved"):
        each = [np.asarray(getattr(curve.replicas, field)) for curve in (two, three)]
        np.testing.assert_array_equal(each[0], each[1][:2])
    np.testing.assert_array_equal(two.particles.velocity, three.particles.velocity[:2])
    assert not np.array_equal(*two.replicas.temperature)
    assert two.temperature_error.shape == TIMES.shape
    assert two.saved.shape == (2, 2)  # times, and the two numbers of `fastest`
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.0.xyz", "run.1.xyz"]
    saved = jaxgran.read_particles(tmp_path / "run.1.xyz")
    np.testing.assert_array_equal(saved.position[-1], two.particles.position[1])


@pytest.mark.parametrize("kind", [jaxgran.HardSpheres, jaxgran.SoftSpheres, jaxgran.DSMC])
def test_a_replica_is_a_run_of_its_own(kind):
    gas = soft_beads(0.05, 0.2, packing_fraction=0.1)
    two = cool(kind(20, replicas=2), gas, key=KEY)
    alone = cool(kind(20), gas, key=jax.random.fold_in(KEY, 1))
    # Another program, which rounds in another way: some ten collisions grow it.
    np.testing.assert_allclose(two.replicas.temperature[1], alone.temperature, rtol=1e-6)


def test_derivatives_are_those_of_each_replica():
    model = jaxgran.HardSpheres(20, replicas=2)

    def log_temperature(x):
        A = GAS.value("dissipative_constant") * jnp.exp(x)
        return jnp.log(cool(model, GAS.replace(dissipative_constant=A)).replicas.temperature)

    values, slopes = jax.jvp(log_temperature, (0.0,), (1.0,))
    reverse = jax.grad(lambda x: log_temperature(x)[1, -1])(0.0)
    assert slopes.shape == values.shape == (2, 2)
    assert np.all(slopes < 0) and slopes[0, -1] != slopes[1, -1]
    np.testing.assert_allclose(reverse, slopes[1, -1], rtol=1e-12)


def test_the_replicas_have_one_checkpoint(tmp_path):
    path = tmp_path / "run.ckpt"
    model = jaxgran.DSMC(200, replicas=3)
    curve = cool(model, checkpoint=path)
    assert [p.name for p in tmp_path.iterdir()] == ["run.ckpt"]
    assert_same(cool(model, checkpoint=path), curve)
    # In one array, on a chosen device, they are other runs.
    with jax.default_device(jax.devices()[0]), pytest.raises(ValueError, match="another run"):
        cool(model, checkpoint=path)


def test_whoever_finds_the_pairs_the_replicas_are_the_same():
    gas = soft_beads(0.05, 0.2, packing_fraction=0.1)
    times, start = [0.5 * float(gas.mean_free_time)], lattice(gas, 64, replicas=2)
    models = (
        jaxgran.SoftSpheres(64, replicas=2, start=start, neighbours=by)
        for by in ("sweep", "cells", "jax-md")
    )
    sweep, *others = (jaxgran.cool(gas, times, model=model, progress=False) for model in models)
    for other in others:
        np.testing.assert_allclose(other.particles.velocity, sweep.particles.velocity, atol=1e-9)
