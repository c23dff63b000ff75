"""Sizes of arrays are made for one model."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import jaxgran
from jaxgran import HardSpheres, SoftSpheres
from tests.beads import soft_beads


def test_sizes_are_those_of_one_model():
    gas = soft_beads(0.05, 0.2, packing_fraction=0.1)
    soft, hard = (kind(100).sized_for(gas) for kind in (SoftSpheres, HardSpheres))
    for sized, name, value in (
        (soft, "steps_per_contact", 80),
        (soft, "replicas", 2),
        (hard, "replicas", 3),
        (hard, "neighbours", "cells"),
    ):
        changed = dataclasses.replace(sized, **{name: value})
        with pytest.raises(
            ValueError, match=f"sized for {name} = .*{value}.* sized_for.gas. again"
        ):
            jaxgran.cool(gas, [1.0], model=changed)
    elsewhere = SoftSpheres(100, neighbours="jax-md").sized_for(gas)
    with pytest.raises(ValueError, match="leave neighbours out"):
        jax.jit(lambda t: jaxgran.cool(gas, t, model=elsewhere).temperature)(jnp.array([1e-3]))
