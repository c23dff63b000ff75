"""Faults: every wrong result is reported."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import tracing
from jaxgran.data import checkpoint
from jaxgran.extend import Run
from jaxgran.particles import run as particle_run
from jaxgran.particles import spheres as moving
from tests.beads import glass_beads, spheres

GAS = glass_beads(0.3, packing_fraction=0.1)
TAU = float(GAS.mean_free_time)
CURVE = jaxgran.CoolingCurve(times=[0.1, 0.2, 0.3, 0.4], temperature=[4e-3, 3e-3, 2e-3, 1e-3])
SOFT, DSMC = jaxgran.SoftSpheres(20), jaxgran.DSMC(50)
TESTS = Path(__file__).parent


def cool(gas=GAS, times=(TAU,), **options):
    return jaxgran.cool(gas, times, progress=False, **options)


def test_the_table_of_faults_names_tests_that_exist():
    text = (TESTS / "faults.md").read_text()
    named = re.findall(r"([\w/]+\.py)(?:::(\w+)(?:\[(.*?)\])?)?", text.partition("|---")[2])
    assert len(named) > 40
    for file, function, case in named:
        code = (TESTS / file).read_text()
        assert not function or f"def {function}(" in code, function
        assert not case or f'"{case}"' in code, case


def test_statuses_are_explained():
    assert jaxgran.explain_status(None) == jaxgran.explain_status(jnp.zeros(3, int)) == "ok"
    words = jaxgran.explain_status(np.array([0, 32, 32 | 1]))
    assert "2 of 3 curves: the simulated time" in words and "1 of 3 curves: the neigh" in words
    for wrong in (-1, 1.5, "x", 2**15):
        with pytest.raises(ValueError, match="status must come from a curve"):
            jaxgran.explain_status(wrong)


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


# --- derivatives ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [jaxgran.SoftSpheres, jaxgran.HardSpheres, jaxgran.DSMC])
def test_second_derivatives_are_refused(kind):
    model = kind(20, replicas=2).sized_for(GAS)

    def log_temperature(x):
        A = GAS.value("dissipative_constant") * jnp.exp(x)
        curve = cool(GAS.replace(dissipative_constant=A), model=model)
        return jnp.log(curve.temperature[0])

    for second in (jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f))):
        with pytest.raises(ValueError, match="second derivative .* KineticTheory"):
            jax.eval_shape(second(log_temperature), 0.0)


# --- runs that stop ------------------------------------------------------------------------------


@pytest.mark.slow
def test_blocks_that_stand_still_end(monkeypatch):
    monkeypatch.setattr(moving, "MIN_FLIGHT", 1e9)  # no flight is long enough
    monkeypatch.setattr(moving, "MAX_STALLED", 3)
    # No other test has 21 spheres.
    curve = jaxgran.HardSpheres(21).simulate(GAS, jnp.array([TAU]), Run())
    jax.clear_caches()
    assert "no longer advances" in jaxgran.explain_status(curve.status)
    assert np.isnan(curve.temperature[0])


@pytest.mark.slow
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


# --- hard starts ---------------------------------------------------------------------------------


def two_spheres(gas, distance, speed):
    """Two spheres at a distance in diameters that approach each other."""
    side, apart = gas.box_side(2), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    return spheres(0.5 * (side + distance * gas.diameter * apart), -speed * apart, side)


def test_soft_spheres_that_start_overlapping_are_told():
    gas = GAS.replace(packing_fraction=0.02)
    jaxgran.SoftSpheres(2, start=two_spheres(gas, 1.01, 0.1)).check(gas)
    with pytest.warns(UserWarning, match="overlap: the energy of their contacts, .* J, becomes"):
        jaxgran.SoftSpheres(2, start=two_spheres(gas, 0.95, 0.1)).check(gas)


@pytest.mark.slow
def test_heavily_damped_impacts_end():
    gas = glass_beads(1e4, packing_fraction=0.02)
    start = two_spheres(gas, 1.05, 0.1)
    soft, hard = (
        cool(gas, [0.0, TAU], model=kind(2, start=start))
        for kind in (jaxgran.SoftSpheres, jaxgran.HardSpheres)
    )
    ratio = soft.temperature / hard.temperature
    np.testing.assert_allclose(ratio, 1.0, atol=0.005)
    assert hard.temperature[1] < 1e-8 * hard.temperature[0]
    np.testing.assert_allclose(soft.dissipated_energy, hard.dissipated_energy, rtol=1e-3)


# --- files ---------------------------------------------------------------------------------------


OWN_LAW = """
import jax, jax.numpy as jnp
from jaxgran.extend import ReducedLaw, RestitutionLaw
from jaxgran.data.checkpoint import describe_run
def slow(v): return FACTOR * jnp.ones_like(v)
class Own(RestitutionLaw, ReducedLaw):
    function: object
    domains = {}
    def reduced(self, *, diameter, mass, speed): return self
    def restitution(self, normal_speed): return self.function(normal_speed)
print(describe_run(law=Own(jax.tree_util.Partial(slow))))
"""


@pytest.mark.slow
def test_a_users_law_is_described_alike_in_another_process(tmp_path):
    def described(factor):
        script = tmp_path / "own.py"
        script.write_text(OWN_LAW.replace("FACTOR", factor))
        return subprocess.check_output([sys.executable, script])

    assert described("0.9") == described("0.9") != described("0.8")


def test_files_keep_permissions_and_follow_links(tmp_path):
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    jaxgran.write_curve(link, CURVE, {}, overwrite=True)
    assert link.is_symlink() and target.read_text().startswith("t,T")
    assert target.stat().st_mode & 0o777 == 0o640
    old = os.umask(0o022)
    try:
        jaxgran.write_curve(tmp_path / "new.csv", CURVE, {})
    finally:
        os.umask(old)
    assert (tmp_path / "new.csv").stat().st_mode & 0o777 == 0o644


# --- derivatives of values that are nan ----------------------------------------------------------

DENSE = ("packing_fraction", 0.8)
HEATING = ("dissipative_constant", -1e-6)
NAN_CASES = [
    (jaxgran.KineticTheory(), *DENSE),
    pytest.param(jaxgran.KineticTheory(), *HEATING, marks=pytest.mark.slow),
    pytest.param(jaxgran.DSMC(20, replicas=2), *HEATING, marks=pytest.mark.slow),
    pytest.param(jaxgran.HardSpheres(20).sized_for(GAS), *DENSE, marks=pytest.mark.slow),
    pytest.param(jaxgran.SoftSpheres(20).sized_for(GAS), *HEATING, marks=pytest.mark.slow),
]


@pytest.mark.parametrize("model, name, value", NAN_CASES)
def test_derivatives_are_nan_where_values_are(model, name, value):
    def temperature(x):
        return cool(GAS.replace(**{name: x}), model=model, throw=False).temperature[0]

    def forward(x):
        return jax.jvp(temperature, (x,), (jnp.ones_like(x),))

    reverse = jax.value_and_grad(temperature)
    x, allowed = jnp.asarray(value), GAS.value(name)
    for found in (forward(x), reverse(x), jax.jit(reverse)(x)):
        assert np.all(np.isnan(found))
    for both in (forward, reverse):
        found = np.asarray(jax.vmap(both)(jnp.stack([x, allowed])))
        assert np.all(np.isnan(found[:, 0])) and np.all(np.isfinite(found[:, 1]))


def test_a_solver_that_fails_has_no_derivative():
    model = jaxgran.KineticTheory(max_steps=2)
    times = TAU * jnp.asarray([1.0, 1e4])

    def temperature(A):
        return cool(GAS.replace(dissipative_constant=A), times, model=model).temperature[-1]

    assert np.all(np.isnan(jax.jit(jax.value_and_grad(temperature))(GAS.dissipative_constant)))


@pytest.mark.parametrize(
    "model",
    [
        jaxgran.KineticTheory(),
        DSMC,
        pytest.param(jaxgran.HardSpheres(20), marks=pytest.mark.slow),
        pytest.param(SOFT, marks=pytest.mark.slow),
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


# --- limits --------------------------------------------------------------------------------------


def test_a_termination_saves_the_run_and_then_ends_the_process(tmp_path, monkeypatch):
    ended = []
    calls = []
    ready = particle_run.block_until_ready
    path = tmp_path / "run.ckpt"
    times = TAU * np.asarray([1.0, 2.0, 3.0])
    model = jaxgran.DSMC(200)
    whole = cool(GAS, times, model=model)

    def ready_and_terminated(tree):
        calls.append(0)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return ready(tree)

    monkeypatch.setattr(checkpoint.signal, "raise_signal", ended.append)
    monkeypatch.setattr(particle_run, "block_until_ready", ready_and_terminated)
    with pytest.raises(KeyboardInterrupt):
        cool(GAS, times, model=model, checkpoint=path)
    assert ended == [signal.SIGTERM] and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    calls = [0] * 3
    resumed = cool(GAS, times, model=model, checkpoint=path)
    np.testing.assert_array_equal(resumed.temperature, whole.temperature)


def test_programs_are_dropped_before_the_limit_of_memory_maps(monkeypatch):
    cleared = []
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(0))
    monkeypatch.setattr(tracing, "MAX_MAP_SHARE", 0.0)
    if not Path("/proc/self/maps").exists():
        pytest.skip("not Linux")
    for _ in range(2):
        with particle_run.compiling("a program", False):
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


@pytest.mark.slow
def test_a_gas_that_never_collides_is_equilibrated_at_once():
    gas = GAS.replace(packing_fraction=1e-12)
    began = time.monotonic()
    curve = cool(gas, [1.0], model=jaxgran.HardSpheres(20))
    assert time.monotonic() - began < 100  # compilation included
    np.testing.assert_allclose(curve.temperature, gas.temperature)
