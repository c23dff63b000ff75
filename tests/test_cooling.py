"""The options of a run are arguments of `jaxgran.cool`; what a model is, is not."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import status
from jaxgran.particles.dsmc import collisions

OPTIONS = ("key", "progress", "checkpoint", "throw")
MODELS = (jaxgran.KineticTheory, jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres)


def test_a_model_is_a_description():
    for model in MODELS:
        assert not set(OPTIONS) & set(inspect.signature(model).parameters)
    assert set(OPTIONS) <= set(inspect.signature(jaxgran.cool).parameters)


@pytest.mark.parametrize(
    "kind", [jaxgran.DSMC, pytest.param(jaxgran.HardSpheres, marks=pytest.mark.slow)]
)
def test_the_key_fixes_the_run(beads, kind):
    gas = beads(0.3, packing_fraction=0.1)
    times = [float(gas.mean_free_time)]

    def final(**options):
        return float(jaxgran.cool(gas, times, model=kind(50), **options).temperature[0])

    assert final() == final() == final(key=jax.random.key(0))
    assert final() != final(key=jax.random.key(1))


@pytest.mark.slow
def test_a_failed_run_returns_its_status(beads, monkeypatch):
    gas = beads(0.15)
    times = np.array([1e-3, 1e3]) * float(gas.mean_free_time)
    few_steps = jaxgran.KineticTheory(max_steps=2)
    with pytest.raises(RuntimeError, match="largest number of steps"):
        jaxgran.cool(gas, times, model=few_steps)
    curve = jaxgran.cool(gas, times, model=few_steps, throw=False)
    assert status.has(curve.status, status.MAX_STEPS_REACHED) and np.all(
        np.isnan(curve.temperature)
    )

    monkeypatch.setattr(collisions, "CEILING", 2.0)  # many pairs are faster
    curve = jaxgran.cool(gas, times[:1] + 3 * times[1:] / 1e3, model=jaxgran.DSMC(200), throw=False)
    assert status.has(curve.status, status.TOO_FAST) and np.isnan(curve.temperature[-1])


@pytest.mark.parametrize(
    "kind", [jaxgran.HardSpheres, pytest.param(jaxgran.SoftSpheres, marks=pytest.mark.slow)]
)
def test_a_run_of_spheres_that_fails_keeps_what_it_has(beads, kind):
    gas = beads(0.15, packing_fraction=0.05)
    side = gas.box_side(2)
    position = jnp.array([[[0.2, 0.5, 0.5], [0.8, 0.5, 0.5]]]) * side
    velocity = jnp.zeros_like(position).at[0, 0, 0].set(jnp.nan)
    model = kind(2, start=jaxgran.Particles(position, velocity, side))
    with pytest.raises(RuntimeError, match="not a finite number"):
        jaxgran.cool(gas, [1e-3], model=model)
    curve = jaxgran.cool(gas, [1e-3], model=model, throw=False)
    assert status.has(curve.status, status.NOT_FINITE) and np.isnan(curve.temperature[0])
    assert "not a finite number" in jaxgran.explain_status(int(curve.status))


def test_a_checkpoint_where_there_is_no_run_is_refused(beads):
    with pytest.raises(ValueError, match="KineticTheory has no run to be saved"):
        jaxgran.cool(beads(), [1.0], checkpoint="run.npz")


def test_other_models_are_refused(beads):
    for other in ("soft", 3, jaxgran.SoftSpheres):
        with pytest.raises(ValueError, match="model must be a"):
            jaxgran.cool(beads(), [1.0], model=other)
