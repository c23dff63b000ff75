"""`cool` for every model: sizes, types of numbers, and what is checked before a run."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads

GAS = glass_beads(0.3, packing_fraction=0.1)
TAU = float(GAS.mean_free_time)
SOFT, DSMC = jaxgran.SoftSpheres(20), jaxgran.DSMC(50)


def cool(gas=GAS, times=(TAU,), **options):
    return jaxgran.cool(gas, times, progress=False, **options)


def test_whole_numbers_of_numpy_are_taken():
    model = jaxgran.DSMC(np.int64(50), replicas=np.int32(2))
    assert type(model.num_particles) is int and model == jaxgran.DSMC(50, replicas=2)


@pytest.mark.parametrize("model", [jaxgran.KineticTheory(), DSMC, SOFT])
def test_every_model_can_be_sized(model):
    sized = model.sized_for(GAS)
    assert type(sized) is type(model)
    assert (sized is model) == (model is not SOFT)


def test_a_checkpoint_that_cannot_be_written_is_told_before_the_run(tmp_path):
    for path in (tmp_path / "none" / "x.ckpt", tmp_path):
        with pytest.raises(OSError, match="cannot write"):
            cool(model=SOFT, checkpoint=path)


@pytest.mark.minutes
@pytest.mark.parametrize("kind", [jaxgran.HardSpheres, jaxgran.DSMC])
def test_single_precision_has_no_trend(kind):
    model = kind(50, replicas=32)
    gas = glass_beads(0.03, packing_fraction=0.1)
    unit = float(gas.diameter / jnp.sqrt(gas.temperature))
    times = np.geomspace(1.0, 1000.0, 12) * unit  # a soft step is .004 of the unit
    double = cool(gas, times, model=model, key=jax.random.key(1)).replicas
    with jax.enable_x64(False):
        narrow = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), gas)
        single = cool(narrow, np.float32(times), model=model, key=jax.random.key(2)).replicas
    each = [np.log(np.asarray(r.temperature, float)) for r in (double, single)]
    assert each[0].mean(axis=0)[-1] < np.log(0.3)
    # Slopes of ln T in ln t over the last decades: of each replica, as its times are correlated.
    late = np.log(times[5:])
    slopes = [np.polyfit(late, logs[:, 5:].T, 1)[0] for logs in each]
    for a, b in (slopes, [logs[:, -1] for logs in each]):
        error = np.hypot(a.std(ddof=1), b.std(ddof=1)) / len(a) ** 0.5
        print(kind.__name__, b.mean() - a.mean(), error)
        assert abs(b.mean() - a.mean()) < 3 * error < 0.06


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [
        jaxgran.KineticTheory(),
        DSMC,
        pytest.param(jaxgran.HardSpheres(20), marks=pytest.mark.minutes),
        pytest.param(SOFT, marks=pytest.mark.minutes),
    ],
)
def test_models_run_without_promotion_of_types(model):
    save = "particles" if model.saves else None
    sized = model.sized_for(GAS)

    def temperature(A):
        return cool(GAS.replace(dissipative_constant=A), model=sized, save=save).temperature[0]

    A = GAS.value("dissipative_constant")
    with jax.numpy_dtype_promotion("strict"):
        assert np.isfinite(cool(model=model, save=save).temperature[0])
        jax.eval_shape(jax.jit(jax.vmap(jax.grad(temperature))), A[None])


def test_what_tree_at_changed_is_checked():
    gas = eqx.tree_at(lambda gas: gas.diameter, GAS, jnp.asarray(-1.0))
    with pytest.raises(ValueError, match="diameter must lie in"):
        cool(gas)
