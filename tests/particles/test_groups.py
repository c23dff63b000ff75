"""Groups of replicas, and devices that share them."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.groups import MIN_SPHERES_PER_RUN, Groups, grouped
from tests.beads import glass_beads, lattice


def test_replicas_stand_in_one_array_unless_they_are_large():
    assert grouped(2, 20) == grouped(2, MIN_SPHERES_PER_RUN - 1) == Groups(1)
    assert grouped(1, MIN_SPHERES_PER_RUN) == grouped(2, 0) == Groups(1)
    assert grouped(3, MIN_SPHERES_PER_RUN) == Groups(3)
    with jax.default_device(jax.devices()[0]):
        assert grouped(2, MIN_SPHERES_PER_RUN) == Groups(1)


def test_devices_have_the_same_number_of_groups():
    np.testing.assert_array_equal(Groups(3).rows, [0, 1, 2])
    np.testing.assert_array_equal(Groups(3, ("a", "b")).rows, [0, 1, 2, 2])
    np.testing.assert_array_equal(Groups(4, ("a", "b")).rows, [0, 1, 2, 3])


@pytest.mark.parametrize("groups", [Groups(1), Groups(3), Groups(3, ("a", "b"))])
def test_joined_groups_are_the_arrays_that_were_split(groups):
    position = np.arange(36.0).reshape(18, 2)  # of three replicas
    split = groups.split({"position": position, "spin": None})
    assert split["position"].shape == (len(groups.rows), 18 // groups.number, 2)
    joined = groups.join(split)
    np.testing.assert_array_equal(joined["position"], position)
    assert joined["spin"] is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", [jaxgran.HardSpheres, jaxgran.SoftSpheres])
def test_large_replicas_on_one_device_run_in_turn(kind):
    n, gas = MIN_SPHERES_PER_RUN, glass_beads(packing_fraction=0.1)
    start, times = lattice(gas, n, replicas=2), [0.1 * gas.mean_free_time]
    second = start._replace(position=start.position[1:], velocity=start.velocity[1:])
    two = jaxgran.cool(gas, times, model=kind(n, replicas=2, start=start))
    alone = jaxgran.cool(gas, times, model=kind(n, start=second))
    np.testing.assert_array_equal(two.replicas.temperature[1], alone.temperature)
    np.testing.assert_array_equal(two.particles.velocity[1], alone.particles.velocity[0])


@pytest.mark.slow  # two devices need a process of their own, which compiles for each
@pytest.mark.minutes
def test_two_devices():
    tests = Path(__file__).with_name("on_two_devices.py")
    command = [sys.executable, "-m", "pytest", "-n0", "-p", "no:cacheprovider", str(tests)]
    with_two = os.environ | {"JAX_NUM_CPU_DEVICES": "2"}
    done = subprocess.run(command, env=with_two, capture_output=True, text=True, check=False)
    assert " passed" in done.stdout and "failed" not in done.stdout, done.stdout
