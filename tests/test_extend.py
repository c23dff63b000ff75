"""A model of a user's own works wherever one of this package does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.extend import AbstractModel
from tests.beads import SI, glass_beads, hard_gas
from tests.fitting.curves import synthetic
from tests.own_model import HaffLaw

MEMBERS = sorted(AbstractModel.__abstractmethods__ | AbstractModel.__abstractclassvars__)


def gas_of(coefficient=0.9):
    return hard_gas(coefficient, 0.02, **SI)


def times_of(gas):
    return jnp.geomspace(0.3, 300.0, 40) * gas.mean_free_time


@pytest.mark.slow
def test_fit_finds_what_made_the_curve():
    gas = gas_of()
    curve = synthetic(gas, model=HaffLaw(), key=jax.random.key(0))
    free = ("coefficient", "temperature")
    unknown = gas.replace(coefficient=0.5, temperature=1.0)
    result = jaxgran.fit(jaxgran.Measurement(unknown, curve), model=HaffLaw(), free=free)
    assert bool(result.converged) and isinstance(result.model, HaffLaw)
    for name in free:
        estimate, error = result.value(name)
        assert abs(estimate - gas.value(name)) < 3 * error
        assert error < 0.01 * gas.value(name)
    assert np.all(result.error_budget["model"] > 0)
    known = "Haff law is consistent with this curve, which determines eps: "
    assert result.grade == "determined" and result.verdict.startswith(known)
    low, high = result.ranges["coefficient"]
    assert low < 0.9 < high


@pytest.mark.slow
def test_the_verdict_asks_the_model():
    gas = gas_of(0.6)
    curve = synthetic(gas, model=HaffLaw(), key=jax.random.key(2))
    result = jaxgran.fit(jaxgran.Measurement(gas, curve), model=HaffLaw(), free="coefficient")
    assert result.grade == "not consistent"
    assert "velocities are not Maxwellian" in result.reasons
    assert result.verdict == (
        "Haff law cannot be trusted in this scene, although the fit to this curve is good. "
        "This scene needs kinetic theory, which includes a_2."
    )


@pytest.mark.slow
def test_choice():
    gas = gas_of(0.95)
    times, models = times_of(gas), (HaffLaw(), jaxgran.KineticTheory())
    theory = jaxgran.cool(gas, times)
    off = jnp.abs(jnp.log(jaxgran.cool(gas, times, model=HaffLaw()).temperature))
    off = float(jnp.max(jnp.abs(off - jnp.abs(jnp.log(theory.temperature)))))
    rough = jaxgran.choose_model(gas, times, 0.1, models=models)
    assert isinstance(rough.model, HaffLaw)
    assert rough.reasons[0].startswith("Haff law: the fastest model whose estimated error")
    assert off < rough.error < 0.1  # a_2 is known, what Enskog's theory leaves out comes on top
    own, better = rough.candidates
    assert own.error == rough.error > better.error
    fine = jaxgran.choose_model(gas, times, (own.error + better.error) / 2, models=models)
    assert isinstance(fine.model, jaxgran.KineticTheory)
    viscous = glass_beads(0.1)
    own, _ = jaxgran.choose_model(viscous, times_of(viscous), models=models).candidates
    assert own.error is None and "HaffLaw needs ConstantRestitution" in own.refusal


def test_a_missing_member_is_named():
    for member in MEMBERS:
        members = {name: vars(HaffLaw)[name] for name in MEMBERS if name != member}
        part = type("Part", (AbstractModel,), members)
        with pytest.raises(TypeError, match=rf"Part.*\b{member}\b"):
            part()
