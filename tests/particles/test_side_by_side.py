"""Replicas as runs of their own."""

import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles import run
from jaxgran.particles.run import block_until_ready, replica_devices, run_replicas

DEVICES = "JAX_NUM_CPU_DEVICES"
TIMES = jnp.array([0.01, 0.03])
MODELS = {"DSMC": 200, "HardSpheres": 20, "SoftSpheres": 20}


@pytest.fixture
def two_devices(monkeypatch):
    """One device stands for two, where there are not two."""
    if DEVICES in os.environ:
        assert jax.device_count() == 2
        return
    device = jax.devices()[0]
    monkeypatch.setattr(run, "replica_devices", lambda n, *_: (device,) * 2 if n > 1 else ())


def cool(gas, name, replicas, **options):
    model = getattr(jaxgran, name)(MODELS[name], replicas=replicas)
    return jaxgran.cool(gas, TIMES, model=model, progress=False, **options)


def fastest(particles):
    return jnp.sort(jnp.sum(particles.velocity**2, axis=1))[-2:]


@pytest.mark.slow  # compiles for one replica, and for one on each device
def test_a_replica_is_the_same_whatever_their_number(beads, two_devices, tmp_path):
    gas, key, name = beads(packing_fraction=0.1), jax.random.key(4), "HardSpheres"
    files = {"save": fastest, "trajectory": tmp_path / "run.xyz"}
    two = cool(gas, name, 2, key=key, **files)
    three = cool(gas, name, 3, key=key, save=fastest)
    for field in ("temperature", "collisions", "displacement", "saved"):
        each = [np.asarray(getattr(curve.replicas, field)) for curve in (two, three)]
        np.testing.assert_array_equal(each[0], each[1][:2])
    alone = cool(gas, name, 1, key=jax.random.fold_in(key, 1), save=fastest)
    np.testing.assert_array_equal(two.replicas.temperature[1], alone.temperature)
    np.testing.assert_array_equal(two.replicas.saved[1], alone.replicas.saved[0])
    np.testing.assert_array_equal(two.particles.velocity, three.particles.velocity[:2])
    np.testing.assert_array_equal(two.particles.position[1], alone.particles.position[0])
    assert not np.array_equal(*two.replicas.temperature)
    assert two.temperature_error.shape == TIMES.shape
    assert two.saved.shape == (2, 2)  # times, and the two numbers of `fastest`
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.0.xyz", "run.1.xyz"]


def test_each_replica_has_a_checkpoint(beads, two_devices, tmp_path):
    gas, path = beads(packing_fraction=0.1), tmp_path / "run.ckpt"
    curve = cool(gas, "DSMC", 2, checkpoint=path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.ckpt.0", "run.ckpt.1"]
    again = cool(gas, "DSMC", 2, checkpoint=path)
    np.testing.assert_array_equal(again.temperature, curve.temperature)
    path.touch()
    with pytest.raises(ValueError, match="written by replicas in one array"):
        cool(gas, "DSMC", 2, checkpoint=path)


def test_an_error_of_one_ends_the_others_and_is_raised():
    begun, devices = threading.Barrier(2), (jax.devices()[0],) * 2

    def one(k, run):
        begun.wait(timeout=20)
        if k == 0:
            raise RuntimeError("of the first")
        while True:  # until it is told to stop
            block_until_ready(jnp.zeros(()))

    with pytest.raises(RuntimeError, match="of the first"):
        run_replicas(one, 2, jaxgran.Run(), devices)


def test_replicas_stand_in_one_array_where_there_is_one_device_or_a_chosen_one():
    assert replica_devices(1) == () and replica_devices(2) == ()
    many = run.MIN_SPHERES_PER_RUN
    assert replica_devices(2, many - 1) == replica_devices(1, many) == ()
    assert replica_devices(2, many) == tuple(jax.devices())
    with jax.default_device(jax.devices()[0]):
        assert replica_devices(2, many) == ()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["HardSpheres", "SoftSpheres"])
def test_large_replicas_on_one_device_run_in_turn(name, beads, monkeypatch):
    monkeypatch.setattr(run, "MIN_SPHERES_PER_RUN", MODELS[name])
    gas, key = beads(packing_fraction=0.1), jax.random.key(4)
    two = cool(gas, name, 2, key=key)
    alone = cool(gas, name, 1, key=jax.random.fold_in(key, 1))
    np.testing.assert_array_equal(two.replicas.temperature[1], alone.temperature)


@pytest.mark.slow  # two devices need a process of their own, which compiles for each
def test_two_real_devices():
    test = f"{__file__}::{test_a_replica_is_the_same_whatever_their_number.__name__}"
    command = [sys.executable, "-m", "pytest", "-n0", "-m", "slow", "-p", "no:cacheprovider", test]
    with_two = os.environ | {DEVICES: "2"}
    done = subprocess.run(command, env=with_two, capture_output=True, text=True, check=False)
    assert "1 passed" in done.stdout, done.stdout
