"""Compiled programs hold no call to the host and no transfer to it."""

import re

import jax
import jax.numpy as jnp
import pytest

import jaxgran

TIMES = jnp.array([0.005, 0.01])
HOST = re.compile(r"callback|infeed|outfeed|host_transfer|\bsend\b|\brecv\b|send-done|recv-done")
MODELS = {
    "theory": lambda gas: jaxgran.KineticTheory(),
    "DSMC": lambda gas: jaxgran.DSMC(50, replicas=2),
    "hard spheres": lambda gas: jaxgran.HardSpheres(30, replicas=2),
    "soft spheres": lambda gas: jaxgran.SoftSpheres(30, replicas=2),
    "hard spheres, many": lambda gas: jaxgran.HardSpheres(200_000),
}


def lowered(gas, model):
    if hasattr(model, "sized_for"):
        model = model.sized_for(gas)

    def temperature(a, key):
        changed = gas.replace(dissipative_constant=a)
        return jaxgran.cool(changed, TIMES, model=model, key=key).temperature

    return jax.jit(temperature).lower(1e-6, jax.random.key(0))


@pytest.mark.parametrize("name", MODELS)
def test_lowered_program_calls_nothing_on_the_host(name, beads):
    gas = beads(packing_fraction=0.1)
    assert HOST.search(lowered(gas, MODELS[name](gas)).as_text()) is None


def test_a_call_would_be_found(beads):
    gas = beads(packing_fraction=0.1)
    by_host = lowered(gas, jaxgran.HardSpheres(30, neighbours="scipy"))
    assert HOST.search(by_host.as_text()) is not None
