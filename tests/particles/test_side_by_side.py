"""Replicas as runs of their own."""

import os
import re
import subprocess
import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads, lattice

DEVICES = "JAX_NUM_CPU_DEVICES"
TIMES = jnp.array([0.01, 0.03])


@pytest.fixture
def two_devices(monkeypatch):
    """One device stands for two, where there are not two."""
    if DEVICES in os.environ:
        assert jax.device_count() == 2
        return
    monkeypatch.setattr(jax, "local_devices", lambda: jax.devices()[:1] * 2)


def cool(gas, model, **options):
    return jaxgran.cool(gas, TIMES, model=model, progress=False, **options)


def fastest(particles):
    return jnp.sort(jnp.sum(particles.velocity**2, axis=1))[-2:]


@pytest.mark.slow  # compiles for one replica, and for one on each device
def test_a_replica_is_the_same_whatever_their_number(two_devices, tmp_path):
    gas, key = glass_beads(packing_fraction=0.1), jax.random.key(4)
    files = {"save": fastest, "trajectory": tmp_path / "run.xyz"}
    two = cool(gas, jaxgran.HardSpheres(20, replicas=2), key=key, **files)
    three = cool(gas, jaxgran.HardSpheres(20, replicas=3), key=key, save=fastest)
    for field in ("temperature", "collisions", "displacement", "saved"):
        each = [np.asarray(getattr(curve.replicas, field)) for curve in (two, three)]
        np.testing.assert_array_equal(each[0], each[1][:2])
    alone = cool(gas, jaxgran.HardSpheres(20), key=jax.random.fold_in(key, 1), save=fastest)
    np.testing.assert_array_equal(two.replicas.temperature[1], alone.temperature)
    np.testing.assert_array_equal(two.replicas.saved[1], alone.replicas.saved[0])
    np.testing.assert_array_equal(two.particles.velocity, three.particles.velocity[:2])
    np.testing.assert_array_equal(two.particles.position[1], alone.particles.position[0])
    assert not np.array_equal(*two.replicas.temperature)
    assert two.temperature_error.shape == TIMES.shape
    assert two.saved.shape == (2, 2)  # times, and the two numbers of `fastest`
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.0.xyz", "run.1.xyz"]


@pytest.mark.slow  # compiles for one replica
def test_each_replica_has_a_checkpoint(two_devices, tmp_path):
    gas, path = glass_beads(packing_fraction=0.1), tmp_path / "run.ckpt"
    model = jaxgran.DSMC(200, replicas=2)
    curve = cool(gas, model, checkpoint=path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.ckpt.0", "run.ckpt.1"]
    again = cool(gas, model, checkpoint=path)
    np.testing.assert_array_equal(again.temperature, curve.temperature)
    path.touch()
    with pytest.raises(ValueError, match="written by replicas in one array"):
        cool(gas, model, checkpoint=path)


@pytest.mark.slow
def test_an_error_of_one_ends_the_others_and_is_raised(two_devices, tmp_path):
    gas = glass_beads(packing_fraction=0.1, dissipative_constant=0.0)
    times, model = [3e5 * gas.mean_free_time], jaxgran.DSMC(200, replicas=2)  # a minute
    (tmp_path / "run.ckpt.0").touch()
    began = time.monotonic()
    with pytest.raises(ValueError, match="run.ckpt.0 is no checkpoint"):
        jaxgran.cool(gas, times, model=model, progress=False, checkpoint=tmp_path / "run.ckpt")
    assert time.monotonic() - began < 30


def run_apart(gas, spheres, replicas, folder):
    """Whether replicas have a run each, seen by what is refused first."""
    model = jaxgran.HardSpheres(spheres, replicas=replicas)
    files = {"checkpoint": folder / "run.ckpt", "trajectory": folder / "none" / "run.xyz"}
    files["checkpoint"].touch()
    with pytest.raises((ValueError, OSError)) as error:
        jaxgran.cool(gas, TIMES, model=model, progress=False, **files)
    assert re.search("written by replicas in one array|cannot write", str(error.value))
    return error.type is ValueError


MANY = 8192
"""Spheres of a replica from which on one array saves no time."""


def test_replicas_stand_in_one_array_on_one_device_or_a_chosen_one(tmp_path, request):
    apart = partial(run_apart, glass_beads(packing_fraction=0.1), folder=tmp_path)
    assert not apart(20, 2) and not apart(MANY - 1, 2) and not apart(MANY, 1)
    assert apart(MANY, 2)
    request.getfixturevalue("two_devices")
    assert apart(20, 2) and not apart(20, 1)
    with jax.default_device(jax.devices()[0]):
        assert not apart(20, 2) and not apart(MANY, 2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [jaxgran.HardSpheres, jaxgran.SoftSpheres])
def test_large_replicas_on_one_device_run_in_turn(kind):
    gas = glass_beads(packing_fraction=0.1)
    start, times = lattice(gas, MANY, replicas=2), [0.1 * gas.mean_free_time]
    second = start._replace(position=start.position[1:], velocity=start.velocity[1:])
    two = jaxgran.cool(gas, times, model=kind(MANY, replicas=2, start=start))
    alone = jaxgran.cool(gas, times, model=kind(MANY, start=second))
    np.testing.assert_array_equal(two.replicas.temperature[1], alone.temperature)
    np.testing.assert_array_equal(two.particles.velocity[1], alone.particles.velocity[0])


@pytest.mark.slow  # two devices need a process of their own, which compiles for each
def test_two_real_devices():
    test = f"{__file__}::{test_a_replica_is_the_same_whatever_their_number.__name__}"
    command = [sys.executable, "-m", "pytest", "-n0", "-m", "slow", "-p", "no:cacheprovider", test]
    with_two = os.environ | {DEVICES: "2"}
    done = subprocess.run(command, env=with_two, capture_output=True, text=True, check=False)
    assert "1 passed" in done.stdout, done.stdout
