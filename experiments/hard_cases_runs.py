"""Hard cases of runs: times, steps, lists, the solver's ends, fits, batches, faults on the way."""

import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from hard_cases_rows import (
    HARD_THEORY,
    PRECISIONS,
    Case,
    Row,
    flagged,
    precision,
    quiet,
    refusal,
    theory,
    unit_gas,
    worst,
)
from scenes import beads

import jaxgran
from jaxgran import blocks, checkpoint, closed_forms
from jaxgran.room import Room

DSMC, HARD, SOFT = jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres
FREE = "dissipative_constant"


def times_of_every_kind() -> list[Row]:
    """One time, 1e5 of them, some that do not start at 0, and twelve decades."""
    rows = []
    for name in PRECISIONS:
        with precision(name):
            gas = beads(0.05, 0.15)
            tau = float(gas.mean_free_time)
            # The solver's steps depend on where it ends: ten times its rtol, 1e-9 and 1e-5.
            allowed = 2e-8 if name == "float64" else 2e-4
            grid = np.linspace(1e-3, 10.0, 100_000)
            many = jaxgran.cool(gas, grid * tau, model=HARD_THEORY).temperature
            one, late = (
                jaxgran.cool(gas, grid[k] * tau, model=HARD_THEORY).temperature
                for k in ([50_000], [50_000, 90_000, 99_999])
            )
            error = max(
                worst(one, many[50_000]), worst(late[1:], many[jnp.array([90_000, 99_999])])
            )
            rows.append(Row("KineticTheory, 1, 3 and 1e5", name, error, allowed))
            wide = np.geomspace(1e-4, 1e8, 3) * tau
            ends = [
                float(theory(gas, jnp.asarray(t), FREE)[0][-1])
                for t in (wide, [0.0, wide[-2], wide[-1]])
            ]
            rows.append(Row("KineticTheory, 12 decades", name, worst(ends[0], ends[1]), allowed))
            few, more = np.array([1.0]) * tau, np.linspace(0.005, 1.0, 200) * tau
            for model in (DSMC, HARD, SOFT):
                soft = beads(0.05, 0.15, 0.02)
                a, b = (
                    float(jaxgran.cool(soft, t, model=quiet(model, 50)).temperature[-1])
                    for t in (few * float(soft.mean_free_time) / tau, _scaled(more, soft, tau))
                )
                # More times cut steps and windows: round-off, e^3 an impact; for soft spheres
                # other phases of onsets too, 1e-4 of an impact each.
                loose = 3e-2 if model is SOFT else 1e-3 if name == "float32" else 1e-6
                rows.append(Row(f"{model.__name__}, 1 and 200", name, worst(a, b), loose))
    return rows


def many_times() -> list[Row]:
    """1e5 output times through particles, beside one."""
    gas = beads(0.05, 0.15, 0.02)
    tau, rows = float(gas.mean_free_time), []
    for model in (DSMC, HARD, SOFT):
        many = jaxgran.cool(gas, np.linspace(1e-5, 1.0, 100_000) * tau, model=quiet(model, 50))
        one = jaxgran.cool(gas, [tau], model=quiet(model, 50))
        error = worst(one.temperature[-1], many.temperature[-1])
        loose = 3e-2 if model is SOFT else 1e-6  # as in `times_of_every_kind`
        rows.append(Row(f"{model.__name__}, 1 and 1e5", "float64", error, loose))
    return rows


def _scaled(times, gas, tau):
    return times * float(gas.mean_free_time) / tau


def steps_and_lists() -> list[Row]:
    """A step five times too large, and arrays ten times too small."""
    rows = []
    for model, option, asked in (
        (DSMC, {"step": 0.5}, "step must lie in"),
        (SOFT, {"steps_per_contact": 8}, "steps_per_contact must be a whole number >= 10"),
    ):
        call = lambda m=model, o=option: quiet(m, 50, **o)  # noqa: E731
        rows.append(refusal(f"{model.__name__}, step asked for", "float64", call, asked))
    gas = beads(0.1, 0.2, 0.05)
    times = np.array([0.3, 1.0]) * float(gas.mean_free_time)
    for model in (HARD, SOFT):
        usual = quiet(model, 100)
        plan = usual.sized_for(gas).plan
        tiny = plan._replace(room=Room(*(max(rows // 10, 1) for rows in plan.room)))
        grown, enough = (
            jaxgran.cool(gas, times, model=quiet(model, 100, plan=p)) for p in (tiny, None)
        )
        error = worst(grown.temperature, enough.temperature)
        rows.append(Row(f"{model.__name__}, lists", "float64", error, 0.0))  # bit for bit
        under_jit = jax.jit(
            lambda t, model=model, tiny=tiny: jaxgran.cool(
                gas, t, model=quiet(model, 100, plan=tiny)
            )
        )(jnp.asarray(times))
        words = jaxgran.explain_status(int(under_jit.status))
        right = np.all(np.isnan(under_jit.temperature)) and "list is full" in words
        error = 0.0 if right else np.inf
        rows.append(Row(f"{model.__name__}, lists in jit", "float64", error, 0.0, status=words))
    # Two spheres half inside each other: the first step is many times too large for them.
    still = jaxgran.cool(gas, [0.0], model=quiet(SOFT, 100)).particles
    assert still is not None
    shift = jnp.array([0.5, 0.0, 0.0]) * gas.diameter
    place = still.position.at[0, 1].set(still.position[0, 0] + shift)
    start = still._replace(position=jnp.mod(place, still.box_side))
    curve = jaxgran.cool(
        gas, [1e-9, times[0]], model=quiet(SOFT, 100, start=start, steps_per_contact=10)
    )
    assert curve.elastic_energy is not None and curve.dissipated_energy is not None
    held = np.asarray(
        1.5 * gas.mass * curve.temperature + curve.elastic_energy + curve.dissipated_energy
    )
    # Ten steps a contact, the coarsest allowed: a step is halved where it errs by more than this
    # part of the work it does.
    error = worst(held[1], held[0])
    rows.append(Row("SoftSpheres, step mended", "float64", error, blocks.EXCHANGE_TOLERANCE))
    return rows


def solver_ends() -> list[Row]:
    """Solver tolerance from 1e-3 to 1e-12; nearly elastic gases, where the equations are stiff."""
    rows = []
    gas = beads(0.05, 0.15)
    times = jnp.geomspace(0.01, 1e5, 3) * gas.mean_free_time
    exact, along = theory(gas, times, FREE, _hard(1e-13))
    for rtol in (1e-3, 1e-6, 1e-9, 1e-12):
        value, slope = theory(gas, times, FREE, _hard(rtol))
        error = float(np.max(np.abs(value - exact)))
        # Asked of every step; a run adds up some ten of them. Below 1e-12 there is round-off.
        allowed = max(20 * rtol, 1e-11)
        rows.append(
            Row(f"Tsit5, {rtol:g}", "float64", error, allowed, worst(slope, along), 5 * allowed)
        )
    stiff = jaxgran.KineticTheory(softness=False, solver=diffrax.Kvaerno5(), rtol=1e-7)
    value, slope = theory(gas, times, FREE, stiff)
    error = float(np.max(np.abs(value - exact)))
    rows.append(Row("Kvaerno5, 1e-07", "float64", error, 2e-6, worst(slope, along), 1e-5))
    weak = beads(0.05, 1e-6)
    late = jnp.geomspace(1.0, 1e9, 3) * weak.mean_free_time
    value, slope = theory(weak, late, FREE, stiff)
    told = jnp.log(closed_forms.paper_temperature(late / weak.mean_free_time, weak.delta))
    # The expansion is right to delta; a_2, of order delta, is left out of it, and is as small.
    error = float(np.max(np.abs(np.asarray(value) - np.asarray(told))))
    rows.append(Row("Kvaerno5, 1e9 collisions", "float64", error, 1e-5))
    for name in PRECISIONS:
        rows.append(
            refusal("Tsit5, 1e9 collisions", name, _nearly_elastic, "largest number of steps")
        )
    return rows


def _hard(rtol):
    return jaxgran.KineticTheory(softness=False, rtol=rtol)


def _nearly_elastic():
    gas = beads(0.05, 1e-6)
    jaxgran.cool(gas, jnp.geomspace(1.0, 1e9, 3) * gas.mean_free_time)


def _measured(gas, seed=0, error=0.01, points=40):
    times = jnp.geomspace(0.3, 300.0, points) * gas.mean_free_time
    exact = jaxgran.cool(gas, times, model=HARD_THEORY).temperature
    noise = error * np.random.default_rng(seed).standard_normal(points)
    noise = jnp.asarray(noise, exact.dtype)
    return jaxgran.CoolingCurve(
        times=times, temperature=exact * jnp.exp(noise), temperature_error=error * exact
    )


def _fitted(gas, curve, free=(FREE,), **options):
    """A fit without its warnings, and which those were."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result = jaxgran.fit(gas, curve, model=HARD_THEORY, free=free, **options)
    return result, " ".join(str(warning.message) for warning in said)


def fits() -> list[Row]:
    """Unidentifiable, outliers, wrong error bars, unexplained, from a start 100 times off."""
    rows = []
    for name in PRECISIONS:
        with precision(name):
            gas = beads(0.05, 0.15)
            truth = float(gas.value(FREE))
            curve = _measured(gas)
            best, _ = _fitted(gas, curve)
            sigma = float(best.standard_error[0])
            # In standard errors: three are passed once in 400.
            off = abs(float(best.estimate[0]) - truth) / sigma
            rows.append(Row("fit, in standard errors", name, off, 3.0))
            for factor in (0.01, 100.0):
                far = gas.replace(**{FREE: truth * factor})
                result, _ = _fitted(gas, curve, start=far)
                moved = abs(float(result.estimate[0] - best.estimate[0])) / sigma
                # The search stops at 1e-7, in float32 where its sum of squares ends, 3e-4 of it.
                rows.append(
                    Row(f"start {factor:g} off", name, moved, 1e-3 if name == "float64" else 0.1)
                )
            result, said = _fitted(gas, curve, (FREE, "youngs_modulus"))
            named = "does not determine dissipative_constant and youngs_modulus" in said
            rows.append(
                Row("unidentifiable", name, 0.0 if named else np.inf, 0.0, status="named, warned")
            )
            wrong = curve.temperature * jnp.where(jnp.arange(40) % 20 == 5, 1.2, 1.0)
            rows.append(_told("outliers", name, gas, curve, wrong, truth, "far outliers at t ="))
            boast = jaxgran.CoolingCurve(
                times=curve.times,
                temperature=curve.temperature,
                temperature_error=curve.temperature_error / 5,  # pyright: ignore
            )
            result, _ = _fitted(gas, boast)
            widened = float(result.standard_error[0]) / sigma
            # Taken from the scatter instead, which 40 points tell to 11 %.
            told = not jaxgran.diagnose(result, boast).explains
            rows.append(
                Row("error bars 5 times too small", name, worst(widened, 1.0), 0.3)
                if told
                else Row("error bars 5 times too small", name, np.inf, 0.3)
            )
            rises = curve.temperature[::-1]
            rows.append(_told("no model explains", name, gas, curve, rises, None, "drift"))
    return rows


def _told(case, name, gas, curve, temperature, truth, words) -> Row:
    """A fit of a spoilt curve must say so; its estimate lies within three of its own errors."""
    spoilt = jaxgran.CoolingCurve(
        times=curve.times, temperature=temperature, temperature_error=curve.temperature_error
    )
    result, _ = _fitted(gas, spoilt)
    diagnosis = jaxgran.diagnose(result, spoilt)
    said = not diagnosis.explains and words in " ".join(diagnosis.reasons)
    off = 0.0
    if truth is not None:
        off = abs(float(result.estimate[0]) - truth) / float(result.standard_error[0])
    return Row(case, name, off if said else np.inf, 3.0, status=diagnosis.verdict)


def one_of_a_batch_fails() -> list[Row]:
    """vmap over members of which one fails: the others are right, that one has a status."""
    rows = []
    for name in PRECISIONS:
        with precision(name):
            gas = beads(0.05, 0.15)
            a = gas.value(FREE)
            times = jnp.geomspace(1.0, 1e9, 3) * gas.mean_free_time

            few_steps = jaxgran.KineticTheory(softness=False, max_steps=3000)

            def cooled(x, gas=gas, times=times, model=few_steps):
                curve = jaxgran.cool(gas.replace(**{FREE: x}), times, model=model)
                return curve.temperature, curve.status

            some = a * jnp.array([1.0, 1e-6, 0.5])
            values, codes = jax.vmap(cooled)(some)
            rows.append(flagged("KineticTheory", name, values, codes, 1, "largest number of steps"))
            alone = [theory(gas.replace(**{FREE: x}), times, FREE)[0] for x in some[::2]]
            error = worst(np.log(values[::2] / gas.temperature), np.asarray(alone))
            rows.append(
                Row("KineticTheory, others", name, error, 1e-8 if name == "float64" else 1e-4)
            )
            if name == "float64":
                slope = jax.vmap(lambda x: jax.jvp(lambda y: cooled(y)[0], (x,), (x,))[1])(some)
                ok = np.all(np.isfinite(slope[::2])) and np.all(np.isnan(slope[1]))
                rows.append(Row("KineticTheory, slopes", name, 0.0 if ok else np.inf, 0.0))
            values, codes = jax.vmap(cooled)(a * jnp.array([1.0, jnp.nan, 0.5]))
            rows.append(flagged("KineticTheory, nan", name, values, codes, 1, "not a finite"))
    gas = beads(0.05, 0.15, 0.05)
    times = jnp.asarray([0.5 * float(gas.mean_free_time)])
    for model in (DSMC, HARD, SOFT):
        sized = quiet(model, 50)
        if model is not DSMC:
            sized = sized.sized_for(gas, spare=2.0)

        def simulated(x, sized=sized):
            curve = jaxgran.cool(gas.replace(**{FREE: x}), times, model=sized)
            return curve.temperature, curve.status

        some = gas.value(FREE) * jnp.array([1.0, jnp.nan, 0.5])
        values, codes = jax.jit(jax.vmap(simulated))(some)
        rows.append(flagged(model.__name__, "float64", values, codes, 1, "not a finite"))
        alone = [simulated(x)[0] for x in some[::2]]
        # Round-off through the melt's ten impacts; one run of 50 spheres differs by that.
        error = worst(values[::2], np.asarray(alone))
        rows.append(
            Row(f"{model.__name__}, others", "float64", error, 1e-9 if model is DSMC else 1e-3)
        )
    return rows


_WRITER = """
import sys, numpy as np
from jaxgran import checkpoint
path, start = sys.argv[1], int(sys.argv[2])
for k in range(start, 10**9):
    checkpoint.save(path, "scene", np.full(200_000, k))
"""

_NO_ROOM = """
import resource, signal, sys, numpy as np
from pathlib import Path
import jaxgran
from jaxgran import checkpoint
path = Path(sys.argv[1])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
curve = jaxgran.CoolingCurve(times=np.arange(1, 5000.0), temperature=np.arange(1, 5000.0))
for write in (
    lambda: checkpoint.save(path, "scene", np.full(200_000, 7)),
    lambda: jaxgran.write_curve(path, curve, {}, overwrite=True),
):
    try:
        write()
    except OSError as error:
        print(error)
"""


def faults_on_the_way() -> list[Row]:
    """A kill while writing, no room on the disk, a closed folder, a checkpoint of another run."""
    rows, like = [], np.zeros(200_000, int)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.npz"
        checkpoint.save(path, "scene", like)
        ages = []
        for delay in (0.05, 0.11, 0.17):
            writer = subprocess.Popen([sys.executable, "-c", _WRITER, str(path), "1"])
            before = path.stat().st_mtime_ns
            while path.stat().st_mtime_ns == before and writer.poll() is None:
                time.sleep(0.01)
            time.sleep(delay)
            writer.send_signal(signal.SIGKILL)
            writer.wait()
            ages.append(len(np.unique(checkpoint.load(path, "scene", like))))
        rows.append(_faultless("killed while writing", ages == [1, 1, 1], "the file is whole"))
        whole = path.read_bytes()
        for left in Path(folder).glob(".run.npz.*"):  # what a kill cannot clean up
            left.unlink()
        done = subprocess.run(
            [sys.executable, "-c", _NO_ROOM, str(path)], capture_output=True, text=True, check=False
        )
        said = done.stdout.strip().splitlines()
        right = len(said) == 2 and all("unharmed" in line and path.name in line for line in said)
        right = right and path.read_bytes() == whole and os.listdir(folder) == [path.name]
        words = (said[0] if said else done.stderr).replace(f"{folder}/", "")
        rows.append(_faultless("no room on the disk", right, words))
        nowhere = Path(folder) / "not there" / "run.npz"
        for what, write in (
            ("checkpoint", lambda: checkpoint.save(nowhere, "scene", like)),
            ("curve", lambda: _write_curve(nowhere)),
        ):
            asked = r"cannot write .*run\.npz"
            rows.append(refusal(f"{what}, no such folder", "float64", write, asked))
        gas = unit_gas(jaxgran.ConstantRestitution(0.9), 0.05)
        times = [float(gas.mean_free_time)]
        file = Path(folder) / "gas.npz"
        run = quiet(DSMC, 50, checkpoint=file)
        jaxgran.cool(gas, times, model=run)
        other = gas.replace(coefficient=0.8)
        call = lambda: jaxgran.cool(other, times, model=run)  # noqa: E731
        rows.append(refusal("another scene", "float64", call, "belongs to another scene"))
        saved = dict(np.load(file))
        np.savez(file, allow_pickle=False, **(saved | {"version": np.asarray("0.0.1")}))
        call = lambda: jaxgran.cool(gas, times, model=run)  # noqa: E731
        rows.append(refusal("another version", "float64", call, "written by jaxgran 0.0.1"))
    return rows


def _faultless(case: str, right: bool, status: str) -> Row:
    return Row(case, "float64", 0.0 if right else np.inf, 0.0, status=status)


def _write_curve(path):
    values = jnp.arange(1.0, 4.0)
    jaxgran.write_curve(path, jaxgran.CoolingCurve(times=values, temperature=values), {})


RUNS = [
    Case(
        "times: one, 1e5, not from 0, 12 decades",
        "output times move the result; late starts lose the beginning",
        "the run begins at 0 whatever is asked; particles pay milliseconds a time",
        times_of_every_kind,
    ),
    Case(
        "1e5 times through particles",
        "output every so many fixed steps; memory of every state",
        "right, at 1 to 2 ms a time",
        many_times,
        heavy=True,
    ),
    Case(
        "step 5 times too large, list 10 times too small",
        "energy appears, neighbours are lost, in silence",
        "refused, halved or grown and rerun; under jit nan and a status",
        steps_and_lists,
    ),
    Case(
        "stiff and non-stiff ends, rtol 1e-3 to 1e-12",
        "a tolerance that does nothing; a solver that creeps for ever",
        "the error follows; beyond some 1e6 collisions an error names the implicit solver",
        solver_ends,
    ),
    Case(
        "fits: open, spoilt, unexplained, far",
        "a number with a small error bar",
        "named, widened or disowned in words",
        fits,
    ),
    Case(
        "one member of a batch fails",
        "all members raise, or all are nan",
        "that one is nan with a status, the others are as alone",
        one_of_a_batch_fails,
    ),
    Case(
        "faults on the way",
        "half a file, a lost run, numbers of another run",
        "whole or not at all; refused with the reason",
        faults_on_the_way,
    ),
]
