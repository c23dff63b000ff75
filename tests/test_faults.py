"""Faults: every wrong result is reported."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import ReducedLaw, RestitutionLaw, Run
from jaxgran.particles import dynamics as moving
from jaxgran.particles.run import block_until_ready, in_thread, run_through_times
from tests.beads import glass_beads, hard_gas

GAS = glass_beads(0.3, packing_fraction=0.1)
TAU = float(GAS.mean_free_time)
CURVE = jaxgran.CoolingCurve(times=[0.1, 0.2, 0.3, 0.4], temperature=[4e-3, 3e-3, 2e-3, 1e-3])
SOFT, DSMC = jaxgran.SoftSpheres(20), jaxgran.DSMC(50)
TESTS = Path(__file__).parent
MASKED = np.ma.masked_all(1)


class NoRestitution(RestitutionLaw):
    """A law that lacks a member."""


class NotReduced(RestitutionLaw):
    """A law whose reduced law is itself, which is none."""

    def reduced(self, *, diameter, mass, speed):
        return self

    def restitution(self, normal_speed):
        return jnp.exp(-normal_speed)


class InMetres(NotReduced, ReducedLaw):
    """A law that takes speeds in units of a reference speed for speeds in m/s."""


class OfMass(NotReduced, ReducedLaw):
    """A law with a float called like one of the gas."""

    mass: float = 1.0
    domains = {"mass": jaxgran.Domain()}

    def restitution(self, normal_speed):
        return 0.9 * jnp.ones_like(normal_speed)


class BelowZero(RestitutionLaw):
    """A law that is meant for slow impacts."""

    slope: float

    def restitution(self, normal_speed):
        return 1 - self.slope * normal_speed


def chi2(scale):
    curve = dataclasses.replace(CURVE, temperature=scale * CURVE.temperature)
    return jaxgran.fit(GAS, curve).chi2


def cool(gas=GAS, times=(TAU,), **options):
    return jaxgran.cool(gas, times, progress=False, **options)


REFUSED = [
    # what is given, the call, what is said
    ("many gases at once", lambda: cool(GAS.replace(mass=[1.0, 2.0])), "mass .* shape .2,.*vmap"),
    ("many gases in a fit", lambda: jaxgran.fit(GAS.replace(mass=np.ones(4)), CURVE), "vmap"),
    ("the class of a model", lambda: cool(model=jaxgran.SoftSpheres), "got the class SoftSpheres"),
    ("a number for a model", lambda: cool(model=3), "model must be a jaxgran model, got 3"),
    ("a number for a key", lambda: cool(model=SOFT, key=5), "jax.random.key.5., got 5"),
    ("a number for a path", lambda: cool(model=SOFT, checkpoint=5), "checkpoint must be a path"),
    ("complex times", lambda: cool(times=[1j]), "times must be a list of numbers"),
    ("a negative time", lambda: cool(times=[1.0, -1.0]), "finite and not negative, got -1"),
    ("an infinite time", lambda: cool(times=[0.0, np.inf]), "finite and not negative, got inf"),
    ("a time twice", lambda: cool(times=[0.0, 2.0, 2.0]), "must increase, got 2 after 2"),
    ("no times", lambda: cool(times=[]), r"a list of numbers, got shape \(0,\)"),
    ("a word for save", lambda: cool(model=SOFT, save="velocity"), 'a replica, or "particles"'),
    ("saved without particles", lambda: cool(save=lambda p: 1), "KineticTheory has no particles"),
    ("no curve", lambda: jaxgran.fit(GAS, None), "curve must be a jaxgran.CoolingCurve, got None"),
    ("no gas", lambda: jaxgran.fit(None, CURVE), "gas must be a jaxgran.Gas, got None"),
    ("negative capacity", lambda: SOFT.sized_for(GAS, spare=-1), "spare must lie in"),
    ("no fit", lambda: jaxgran.diagnose(None, CURVE), "got NoneType and CoolingCurve"),
    ("a start of a tuple", lambda: cool(model=jaxgran.SoftSpheres(20, start=(1, 2))), "Particles"),
    ("a text for a number", lambda: jaxgran.Viscoelastic("5e7", 0.2, 1e-6), "got '5e7'"),
    ("a truth value for a number", lambda: GAS.replace(mass=True), "mass must be a number"),
    ("a text for a choice", lambda: jaxgran.KineticTheory(sonine="no"), "must be True or False"),
    ("a truth value for a count", lambda: jaxgran.DSMC(50, replicas=True), "whole number >= 1"),
    ("a text for an interval", lambda: jaxgran.SoftSpheres(20, projection="x"), "number"),
    ("a negative tolerance", lambda: jaxgran.KineticTheory(rtol=-1), "rtol must lie in"),
    ("no steps", lambda: jaxgran.KineticTheory(max_steps=0), "max_steps must be a whole number"),
    ("a negative number of spheres", lambda: GAS.box_side(-5), "num_particles must be a whole"),
    ("a negative beta", lambda: jaxgran.viscoelastic_restitution(-1.0), "beta must lie in"),
    ("an empty series", lambda: jaxgran.RestitutionSeries([], []), "same length, 1 or more"),
    ("a law's float named as the gas's", lambda: hard_gas(OfMass()), "'mass'.*rename it"),
    ("a law without restitution", lambda: NoRestitution(), "define restitution"),
    ("a law in wrong units", lambda: hard_gas(InMetres()), "0.04979 at 0.3 m/s .* leave `reduced`"),
    ("a law below 0", lambda: cool(hard_gas(BelowZero(1.0))), "eps = -[0-9.]+ at a speed of"),
    ("a law that is nan", lambda: cool(hard_gas(BelowZero(jnp.nan))), "must be|must lie"),
    ("the derivative of a fit", lambda: jax.grad(chi2)(1.0), "no derivative .*log_likelihood"),
    ("jitted", lambda: jax.eval_shape(jax.jacfwd(jax.jit(chi2)), 1.0), "no derivative in the gas"),
    ("a text for throw", lambda: jaxgran.cool(GAS, (TAU,), throw="no"), "throw must be True or"),
    ("a number for progress", lambda: jaxgran.cool(GAS, (TAU,), progress=5), "must be True"),
    ("an array without some values", lambda: jaxgran.DropTest(MASKED, [0.9], [0.01]), "are masked"),
    ("no particles", lambda: jaxgran.read_particles(None), "must be the name of a file, got None"),
    ("a list for a header", lambda: jaxgran.read_curve("a.csv", [1]), "must be a dictionary"),
    ("None in a header", lambda: jaxgran.read_gas({"eta": None}), "dictionary of texts"),
    ("four dimensions", lambda: jaxgran.read_particles("a.gsd", dimension=4), "must be 2 or 3"),
    ("no positions", lambda: cool(model=DSMC, trajectory="a.gsd"), "DSMC has no positions"),
    ("a suffix", lambda: cool(model=SOFT, trajectory="a.dcd"), "ends in .gsd or .xyz, got 'a.dcd'"),
    ("a number for a trajectory", lambda: cool(model=SOFT, trajectory=3), "must be a path, got 3"),
    ("a law that is not reduced", lambda: hard_gas(NotReduced()), "must return a .*ReducedLaw"),
]


for point, field, value in (
    (2, "temperature", 1e308),
    (2, "temperature", 1e-320),
    (3, "times", 1e308),
    (1, "temperature_error", 1e-300),
):
    slip = dataclasses.replace(CURVE, temperature_error=0.01 * CURVE.temperature)
    slip = dataclasses.replace(slip, **{field: getattr(slip, field).at[point].set(value)})
    words = re.escape(f"{value:g}, which cannot be measured")
    REFUSED.append((f"{field} of {value:g}", lambda slip=slip: jaxgran.fit(GAS, slip), words))


@pytest.mark.parametrize("call, words", [pytest.param(c, w, id=n) for n, c, w in REFUSED])
def test_refused(call, words):
    with pytest.raises((ValueError, TypeError), match=words) as error:
        call()
    assert error.type is ValueError or "abstract" in str(error.value)


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
        with pytest.raises(ValueError, match="status must be that of a curve"):
            jaxgran.explain_status(wrong)


def test_particles_of_all_replicas_are_told():
    with pytest.raises(ValueError, match=r"got \(1, 5, 3\): take particles.position\[0\]"):
        jaxgran.observables.pair_correlation(np.zeros((1, 5, 3)), 1.0, [0.0, 0.1])


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


@pytest.mark.slow
def test_members_of_a_batch_out_of_range_say_so():
    phi, A = (float(GAS.value(name)) for name in ("packing_fraction", "dissipative_constant"))
    many = jax.vmap(lambda p, a: cool(GAS.replace(packing_fraction=p, dissipative_constant=a)))
    curve = many(jnp.array([phi, 0.9, phi]), jnp.array([A, A, -1.0]))
    assert curve.status[0] == 0 and np.isfinite(curve.temperature[0])
    assert "2 of 2 curves: a float of the gas" in jaxgran.explain_status(curve.status[1:])
    assert np.all(np.isnan(curve.temperature[1:]))


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


class Standing:
    """A state whose time does not advance."""

    time = np.zeros(())


def test_a_run_that_stands_still_ends():
    state, records, fault = run_through_times(
        Standing(), np.ones(1), lambda s, end: s, lambda s: {"temperature": jnp.ones(())}
    )
    assert "no longer advances" in jaxgran.explain_status(fault)
    assert np.isnan(records["temperature"])


@pytest.mark.slow
@pytest.mark.parametrize("kind, x64", [(jaxgran.SoftSpheres, False), (jaxgran.HardSpheres, True)])
def test_blocks_that_stand_still_end(kind, x64, monkeypatch):
    with jax.enable_x64(x64):
        gas = glass_beads(0.3, packing_fraction=0.1)
        monkeypatch.setattr(moving, "MIN_FLIGHT", 1e9)  # no flight is long enough
        monkeypatch.setattr(moving, "MAX_STALLED", 3)
        jax.clear_caches()
        curve = kind(20).simulate(gas, jnp.array([TAU]), Run())
        jax.clear_caches()
    assert "no longer advances" in jaxgran.explain_status(curve.status)
    assert np.isnan(curve.temperature[0])


@jax.jit
def some_seconds():
    # Not of scalars: JAX does not return before such programs have ended.
    return jax.lax.fori_loop(0, 3000, lambda i, x: 0.99 * x @ x, jnp.eye(300))


@pytest.mark.parametrize(
    "wait", [lambda: in_thread(lambda: time.sleep(20)), lambda: block_until_ready(some_seconds())]
)
def test_waiting_can_be_interrupted(wait):
    some_seconds.lower().compile()

    def interrupt(*_):
        raise KeyboardInterrupt

    old = signal.signal(signal.SIGALRM, interrupt)
    began = time.monotonic()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.3)
        with pytest.raises(KeyboardInterrupt):
            wait()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)
    assert time.monotonic() - began < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", [jaxgran.HardSpheres, jaxgran.DSMC])
def test_single_precision_has_no_trend(kind):
    model = kind(50, replicas=32)
    gas = glass_beads(0.01, packing_fraction=0.1)
    unit = float(gas.diameter / jnp.sqrt(gas.temperature))
    times = np.geomspace(1.0, 3000.0, 12) * unit  # a soft step is .004 of the unit
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
    side = gas.box_side(2)
    apart = jnp.array([0.5 * distance * gas.diameter, 0.0, 0.0])
    along = jnp.array([speed, 0.0, 0.0])
    position, velocity = 0.5 * side + jnp.stack([apart, -apart]), jnp.stack([-along, along])
    return jaxgran.Particles(position[None], velocity[None], side)


def test_soft_spheres_that_start_overlapping_are_told():
    gas = GAS.replace(packing_fraction=0.02)
    jaxgran.SoftSpheres(2, start=two_spheres(gas, 1.01, 0.1)).check(gas)
    with pytest.warns(UserWarning, match="overlap: the energy of their contacts, .* J, becomes"):
        jaxgran.SoftSpheres(2, start=two_spheres(gas, 0.95, 0.1)).check(gas)


@pytest.mark.slow
def test_soft_spheres_start_overlapped_and_at_rest():
    overlap = 0.05
    gas = GAS.replace(dissipative_constant=0.0, packing_fraction=0.02)
    start = two_spheres(gas, 1 - overlap, 0.0)
    with pytest.warns(UserWarning, match="overlap"):
        curve = cool(gas, [0.0, 0.1 * TAU, TAU], model=jaxgran.SoftSpheres(2, start=start))
    kinetic = 1.5 * gas.mass * curve.temperature
    assert kinetic[0] == 0 and kinetic[-1] > 0
    total = kinetic + curve.elastic_energy
    np.testing.assert_allclose(total, total[0], rtol=3e-3)


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
import sys, jax, jax.numpy as jnp, jaxgran
from jaxgran import ReducedLaw, RestitutionLaw
jax.config.update("jax_enable_x64", True)
def slow(v): return FACTOR * jnp.ones_like(v)
class Own(RestitutionLaw, ReducedLaw):
    function: object
    domains = {}
    def reduced(self, *, diameter, mass, speed): return self
    def restitution(self, normal_speed): return self.function(normal_speed)
gas = jaxgran.Gas(Own(jax.tree_util.Partial(slow)), diameter=1.0, mass=1.0, packing_fraction=0.1,
    temperature=1.0)
print(repr(jaxgran.cool(gas, [1.0], model=jaxgran.DSMC(50), checkpoint=sys.argv[1]).temperature))
"""


@pytest.mark.slow
def test_a_run_of_a_users_law_resumes_in_another_process(tmp_path):
    def run(factor):
        script = tmp_path / "own.py"
        script.write_text(OWN_LAW.replace("FACTOR", factor))
        command = [sys.executable, str(script), str(tmp_path / "run.ckpt")]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    first, again, other = run("0.9"), run("0.9"), run("0.8")
    assert first.returncode == 0, first.stderr
    assert again.stdout == first.stdout and again.returncode == 0
    assert "belongs to another run" in other.stderr


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
