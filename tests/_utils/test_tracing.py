"""Compiled programs, and the memory maps that they take."""

from pathlib import Path

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import tracing
from jaxgran.particles import progress
from tests.beads import glass_beads

GAS = glass_beads(0.3, packing_fraction=0.1)
TAU = float(GAS.mean_free_time)


def cool(gas=GAS, times=(TAU,), **options):
    return jaxgran.cool(gas, times, progress=False, **options)


def test_programs_are_dropped_before_the_limit_of_memory_maps(monkeypatch):
    cleared = []
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(0))
    monkeypatch.setattr(tracing, "MAX_MAP_SHARE", 0.0)
    if not Path("/proc/self/maps").exists():
        pytest.skip("not Linux")
    for _ in range(2):
        progress.drop_programs_near_limit("a program")
        with progress.compiling("a program", False):
            pass
    assert len(cleared) == 1


@pytest.mark.slow
@pytest.mark.minutes
def test_many_numbers_of_spheres_stay_below_a_limit_of_memory_maps(monkeypatch):
    maps = Path("/proc/self/maps")
    if not maps.exists():
        pytest.skip("not Linux")

    def num_maps():
        return len(maps.read_bytes().splitlines())

    # One number of spheres adds some 1100 maps; the limit of Linux would need 40 of them.
    allowed = num_maps() + 2500
    limit = int(Path("/proc/sys/vm/max_map_count").read_text())
    monkeypatch.setattr(tracing, "MAX_MAP_SHARE", allowed / limit)
    counts = []
    for number in range(30, 38):
        curve = cool(times=[0.1 * TAU], model=jaxgran.HardSpheres(number))
        assert np.isfinite(curve.temperature[0])
        counts.append(num_maps())
    print(counts, allowed)
    assert max(counts) < allowed + 1200  # programs of one number, after the last check
    assert np.sum(np.diff(counts) < 0) >= 2
