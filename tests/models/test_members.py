"""Members of a batch that differ in their law share one array: the same gases as one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import HardSpheres, SoftSpheres
from jaxgran.models import spheres
from tests.beads import glass_beads, hard_gas, soft_beads

HARD, SOFT = glass_beads(packing_fraction=0.05), soft_beads(0.05, 0.25, packing_fraction=0.05)
FACTORS = jnp.array([0.5, 1.0, 2.0])
SERIES = hard_gas(jaxgran.RestitutionSeries([-0.1, -0.02], [0.2, 0.4]))


def scaled(gas, name):
    """Return a function of a factor: the gas with a parameter times this factor."""
    return lambda factor: gas.replace(**{name: factor * gas.value(name)})


CASES = {
    "A, hard": (HardSpheres(40, replicas=2), HARD, "dissipative_constant", True),
    "stiffness, hard": (HardSpheres(40), HARD, "youngs_modulus", True),
    "list of numbers, hard": (HardSpheres(40), SERIES, "coefficients", True),
    "A, soft": (SoftSpheres(40, replicas=2), SOFT, "dissipative_constant", True),
    "stiffness, soft": (SoftSpheres(40), SOFT, "youngs_modulus", False),
    "T_0": (HardSpheres(40), HARD, "temperature", False),
}
"""Model, gas, parameter, and whether members share an array."""


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_members_are_the_gases_that_they_are_alone(case, monkeypatch):
    model, gas, name, shared = CASES[case]
    gas_at = scaled(gas, name)
    arrays = []
    batch_dynamics = spheres.AbstractSpheres.batch_dynamics

    def watched(self, *inputs):
        arrays.append(batch_dynamics(self, *inputs))
        return arrays[-1]

    monkeypatch.setattr(spheres.AbstractSpheres, "batch_dynamics", watched)
    # Few collisions: later ones are other ones, by chaos and by other windows and steps.
    times = np.linspace(0, 0.7, 4) * float(gas.mean_free_time)
    model = model.sized_for(gas_at(2.0))

    def curve(factor):
        return jaxgran.cool(gas_at(factor), times, model=model)

    together = jax.jit(jax.vmap(curve))(FACTORS)
    assert [dynamics is not None for dynamics in arrays] == [shared]
    one = jax.jit(curve)
    for k, factor in enumerate(FACTORS):
        alone = one(factor)
        member = jax.tree.map(lambda x, k=k: x[k], together)
        assert member.status == alone.status == 0
        assert jax.tree.structure(member) == jax.tree.structure(alone)
        # Members share windows or steps: impacts are exact, contacts as accurate as their steps.
        accuracy = 1e-4 if isinstance(model, HardSpheres) else 1e-3
        for quantity in ("temperature", "collisions", "displacement"):
            found, expected = getattr(member, quantity), getattr(alone, quantity)
            atol = accuracy * float(jnp.max(expected))
            np.testing.assert_allclose(found, expected, accuracy, atol, err_msg=quantity)
        velocities = member.particles.velocity, alone.particles.velocity
        speed = float(jnp.sqrt(gas.temperature))
        np.testing.assert_allclose(*velocities, atol=20 * accuracy * speed)
        of_replicas = member.replicas.temperature, alone.replicas.temperature
        np.testing.assert_allclose(*of_replicas, rtol=accuracy)
