"""The driver gives the buffers of a state away where that state is not needed any more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import status
from jaxgran.data.curve import Run
from jaxgran.particles import run
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dsmc import collisions
from jaxgran.particles.run import compiled_segments

TIMES = jnp.array([0.01, 0.03])
MODELS = {
    "DSMC": jaxgran.DSMC(100, replicas=2),
    "HardSpheres": jaxgran.HardSpheres(20, replicas=2),
    "SoftSpheres": jaxgran.SoftSpheres(20, replicas=2),
}


@pytest.fixture
def given(monkeypatch):
    """The states that compiled code was given."""
    states = []

    def watched(forward, place):
        def call(*args, **options):
            states.append(args[place])
            return forward(*args, **options)

        return call

    compiled_advance = collisions.compiled_advance
    monkeypatch.setattr(run, "compiled_segments", watched(compiled_segments, 1))
    monkeypatch.setattr(
        collisions, "compiled_advance", lambda donate: watched(compiled_advance(donate), 0)
    )
    return states


def deleted(states):
    return {leaf.is_deleted() for state in states for leaf in jax.tree.leaves(state)}


@pytest.mark.parametrize("name", MODELS)
def test_states_are_donated_and_results_the_same(name, beads, given, tmp_path):
    gas = beads(packing_fraction=0.1)
    plain = jaxgran.cool(gas, TIMES, model=MODELS[name])
    assert given and deleted(given) == {True}
    given.clear()
    # An interrupted run saves the state from before the call under way: none is donated.
    kept = jaxgran.cool(gas, TIMES, model=MODELS[name], checkpoint=tmp_path / "run")
    last = given[-1]
    assert deleted([last]) == {False}
    jax.tree.map(np.testing.assert_array_equal, plain, kept)


@pytest.mark.parametrize("name", ["HardSpheres", "SoftSpheres"])
def test_a_start_of_the_user_is_not_donated(name, beads, given):
    gas = beads(packing_fraction=0.1)
    start = jaxgran.cool(gas, TIMES, model=MODELS[name]).particles
    # In units of the run already, so that no unit makes another array of it.
    unit = gas.replace(diameter=1.0, temperature=1.0)
    # Contacts as long, in mean free times, and impacts as dissipative, as before.
    longer = float(unit.contact_fraction / gas.contact_fraction) ** 2.5
    unit = unit.replace(youngs_modulus=longer * unit.value("youngs_modulus"))
    less = gas.thermal_beta / unit.thermal_beta
    unit = unit.replace(dissipative_constant=less * unit.value("dissipative_constant"))
    scaled = start._replace(
        position=start.position / gas.diameter,
        velocity=start.velocity / jnp.sqrt(gas.temperature),
        box_side=start.box_side / gas.diameter,
    )
    model = getattr(jaxgran, name)(20, replicas=2, start=scaled)
    given.clear()
    first = jaxgran.cool(unit, 100 * TIMES, model=model)
    assert deleted(given) == {True} and deleted([scaled]) == {False}
    again = jaxgran.cool(unit, 100 * TIMES, model=model)
    np.testing.assert_array_equal(first.temperature, again.temperature)


def test_a_run_that_fails_returns_its_last_good_state(beads, monkeypatch):
    gas = beads(packing_fraction=0.1)
    monkeypatch.setattr(run, "MAX_ROWS_PER_PARTICLE", 0)  # no array may grow
    tiny = MODELS["HardSpheres"].sized_for(gas).plan
    assert tiny is not None
    plan = tiny._replace(capacity=Capacity(*(4,) * len(Capacity._fields)))
    model = jaxgran.HardSpheres(20, replicas=2, plan=plan)
    curve = model.simulate(gas, TIMES, Run())
    assert int(curve.status) & (status.LIST_FULL.bit | status.CONTACTS_FULL.bit)
    assert np.all(np.isnan(curve.temperature))
    assert curve.particles is not None and np.all(np.isfinite(curve.particles.velocity))
