"""Hard cases of runs: times, steps, capacities, solver tolerances, fits, batches, file errors."""

import json
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

import jaxgran
from experiments.support.closed_forms import paper_temperature
from experiments.support.hard_cases.rows import (
    HARD_THEORY,
    PRECISIONS,
    Case,
    Row,
    flagged,
    precision,
    refusal,
    theory,
    unit_gas,
    worst,
)
from experiments.support.scenes import beads
from jaxgran.data import checkpoint
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.soft.dynamics import DRIFT_TOLERANCE

DSMC, HARD, SOFT = jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres
FREE = "dissipative_constant"

ENSKOG = {"softness": False, "order": 2, "correlations": False}
"""Options for which kinetic theory solves the equations of the references."""


def times_of_every_kind() -> list[Row]:
    """Test a single time, 1e5 times, times that do not start at 0, and twelve decades."""
    rows = []
    for name in PRECISIONS:
        with precision(name):
            gas = beads(0.05, 0.15)
            tau = float(gas.mean_free_time)
            # The solver's steps depend on the last time: ten times its rtol, 1e-9 and 1e-5.
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
            # More times shorten some steps and windows. That changes round-off, which grows by e^3
            # per impact, and for soft spheres the phases of steps at first touch, 1e-4 per impact.
            loose = 1e-3 if name == "float32" else 1e-6
            for kind, allowed in ((DSMC, loose), (HARD, loose), (SOFT, 3e-2)):
                soft = beads(0.05, 0.15, 0.02)
                a, b = (
                    float(jaxgran.cool(soft, t, model=kind(50)).temperature[-1])
                    for t in (few * float(soft.mean_free_time) / tau, _scaled(more, soft, tau))
                )
                rows.append(Row(f"{kind.__name__}, 1 and 200", name, worst(a, b), allowed))
    return rows


def many_times() -> list[Row]:
    """Test 1e5 output times of a particle model, compared with one."""
    gas = beads(0.05, 0.15, 0.02)
    tau, rows = float(gas.mean_free_time), []
    for kind, allowed in ((DSMC, 1e-6), (HARD, 1e-6), (SOFT, 3e-2)):  # see `times_of_every_kind`
        many = jaxgran.cool(gas, np.linspace(1e-5, 1.0, 100_000) * tau, model=kind(50))
        one = jaxgran.cool(gas, [tau], model=kind(50))
        error = worst(one.temperature[-1], many.temperature[-1])
        rows.append(Row(f"{kind.__name__}, 1 and 1e5", "float64", error, allowed))
    return rows


def _scaled(times, gas, tau):
    return times * float(gas.mean_free_time) / tau


def steps_and_lists() -> list[Row]:
    """Test a time step five times too large, and capacities ten times too small."""
    rows = []
    asked = "step must lie in"
    call = lambda: DSMC(50, step=0.5)  # noqa: E731
    rows.append(refusal("DSMC, step asked for", "float64", call, asked))
    asked = "steps_per_contact must be a whole number >= 10"
    call = lambda: SOFT(50, steps_per_contact=8)  # noqa: E731
    rows.append(refusal("SoftSpheres, step asked for", "float64", call, asked))
    gas = beads(0.1, 0.2, 0.05)
    times = np.array([0.3, 1.0]) * float(gas.mean_free_time)
    for kind in (HARD, SOFT):
        plan = kind(100).sized_for(gas).plan
        assert plan is not None
        capacity = Capacity(*(max(length // 10, 1) for length in plan.capacity))
        tiny = kind(100, plan=plan._replace(capacity=capacity))
        grown, enough = (jaxgran.cool(gas, times, model=model) for model in (tiny, kind(100)))
        error = worst(grown.temperature, enough.temperature)
        rows.append(Row(f"{kind.__name__}, lists", "float64", error, 0.0))  # bit for bit
        under_jit = jax.jit(lambda t, model=tiny: jaxgran.cool(gas, t, model=model))(
            jnp.asarray(times)
        )
        words = jaxgran.explain_status(int(under_jit.status))
        right = np.all(np.isnan(under_jit.temperature)) and "list is full" in words
        error = 0.0 if right else np.inf
        rows.append(Row(f"{kind.__name__}, lists in jit", "float64", error, 0.0, status=words))
    # Two spheres that overlap by half a diameter: the first step is many times too large for them.
    still = jaxgran.cool(gas, [0.0], model=SOFT(100)).particles
    assert still is not None
    shift = jnp.array([0.5, 0.0, 0.0]) * gas.diameter
    place = still.position.at[0, 1].set(still.position[0, 0] + shift)
    start = still._replace(position=jnp.mod(place, still.box_side))
    # A step is halved where its energy error is too large a share of the work that it does. At ten
    # steps per contact, the fewest allowed, the errors of many such steps still add up to more than
    # a run may have.
    later = [1e-9, times[0]]
    call = lambda: jaxgran.cool(gas, later, model=SOFT(100, start=start, steps_per_contact=10))  # noqa: E731
    rows.append(refusal("SoftSpheres, 10 steps", "float64", call, "energy balance"))
    curve = jaxgran.cool(gas, later, model=SOFT(100, start=start, steps_per_contact=20))
    assert curve.elastic_energy is not None and curve.dissipated_energy is not None
    held = np.asarray(
        1.5 * gas.mass * curve.temperature + curve.elastic_energy + curve.dissipated_energy
    )
    error = worst(held[1], held[0])
    rows.append(Row("SoftSpheres, step halved", "float64", error, DRIFT_TOLERANCE))
    return rows


def solver_ends() -> list[Row]:
    """Test solver tolerances from 1e-3 to 1e-12, and nearly elastic gases (stiff equations)."""
    rows = []
    gas = beads(0.05, 0.15)
    times = jnp.geomspace(0.01, 1e5, 3) * gas.mean_free_time
    exact, along = theory(gas, times, FREE, _hard(1e-13))
    for rtol in (1e-3, 1e-6, 1e-9, 1e-12):
        value, slope = theory(gas, times, FREE, _hard(rtol))
        error = float(np.max(np.abs(value - exact)))
        # The error of one step; some ten of them add up. At 1e-12 round-off is as large.
        allowed = max(20 * rtol, 1e-11)
        rows.append(
            Row(f"Tsit5, {rtol:g}", "float64", error, allowed, worst(slope, along), 5 * allowed)
        )
    stiff = jaxgran.KineticTheory(**ENSKOG, solver=diffrax.Kvaerno5(), rtol=1e-7)
    value, slope = theory(gas, times, FREE, stiff)
    error = float(np.max(np.abs(value - exact)))
    rows.append(Row("Kvaerno5, 1e-07", "float64", error, 2e-6, worst(slope, along), 1e-5))
    weak = beads(0.05, 1e-6)
    late = jnp.geomspace(1.0, 1e9, 3) * weak.mean_free_time
    value, slope = theory(weak, late, FREE, stiff)
    expected = jnp.log(paper_temperature(late / weak.mean_free_time, weak.delta))
    # The expansion is right to first order in delta, but for a_2, which it leaves out and which is
    # of that order too.
    error = float(np.max(np.abs(np.asarray(value) - np.asarray(expected))))
    rows.append(Row("Kvaerno5, 1e9 collisions", "float64", error, 1e-5))
    for name in PRECISIONS:
        rows.append(
            refusal("Tsit5, 1e9 collisions", name, _nearly_elastic, "largest number of steps")
        )
    return rows


def _hard(rtol):
    return jaxgran.KineticTheory(**ENSKOG, rtol=rtol)


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
    """Return a fit, and its warnings as one string."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result = jaxgran.fit(gas, curve, model=HARD_THEORY, free=free, **options)
    return result, " ".join(str(warning.message) for warning in said)


def fits() -> list[Row]:
    """Test undetermined parameters, outliers, wrong error bars, an unexplained curve, far guesses.

    Far guesses are wrong by a factor 100; no model explains the unexplained curve.
    """
    rows = []
    for name in PRECISIONS:
        with precision(name):
            gas = beads(0.05, 0.15)
            truth = float(gas.value(FREE))
            curve = _measured(gas)
            best, _ = _fitted(gas, curve)
            sigma = float(best.error_budget["measurement"][0])
            # In standard errors: three are exceeded once in 400 fits.
            off = abs(float(best.estimate[0]) - truth) / sigma
            rows.append(Row("fit, in standard errors", name, off, 3.0))
            for factor in (0.01, 100.0):
                far = gas.replace(**{FREE: truth * factor})
                result, _ = _fitted(gas, curve, start=far)
                moved = abs(float(result.estimate[0] - best.estimate[0])) / sigma
                # The search stops at 1e-7; in float32 chi^2 has a round-off of 3e-4.
                rows.append(
                    Row(f"start {factor:g} off", name, moved, 1e-3 if name == "float64" else 0.1)
                )
            result, said = _fitted(gas, curve, (FREE, "youngs_modulus"))
            named = "does not determine dissipative_constant and youngs_modulus" in said
            rows.append(
                Row("unidentifiable", name, 0.0 if named else np.inf, 0.0, status="named, warned")
            )
            wrong = curve.temperature * jnp.where(jnp.arange(40) % 20 == 5, 1.2, 1.0)
            rows.append(
                _diagnosed("outliers", name, gas, curve, wrong, truth, "far outliers at t =")
            )
            boast = jaxgran.CoolingCurve(
                times=curve.times,
                temperature=curve.temperature,
                temperature_error=curve.temperature_error / 5,  # pyright: ignore
            )
            result, _ = _fitted(gas, boast)
            widened = float(result.error_budget["measurement"][0]) / sigma
            # The fit estimates them from the scatter instead, which 40 points determine to 11 %.
            noticed = not jaxgran.diagnose(result, boast).explains
            rows.append(
                Row("error bars 5 times too small", name, worst(widened, 1.0), 0.3)
                if noticed
                else Row("error bars 5 times too small", name, np.inf, 0.3)
            )
            rises = curve.temperature[::-1]
            rows.append(_diagnosed("no model explains", name, gas, curve, rises, None, "drift"))
    return rows


def _diagnosed(case, name, gas, curve, temperature, truth, words) -> Row:
    """Return a row that passes if the diagnosis of a wrong curve contains `words`.

    The estimate must also be within three standard errors of the truth, if there is one.
    """
    corrupted = jaxgran.CoolingCurve(
        times=curve.times, temperature=temperature, temperature_error=curve.temperature_error
    )
    result, _ = _fitted(gas, corrupted)
    diagnosis = jaxgran.diagnose(result, corrupted)
    said = not diagnosis.explains and words in " ".join(diagnosis.reasons)
    off = 0.0
    if truth is not None:
        off = abs(float(result.estimate[0]) - truth) / float(result.error_budget["measurement"][0])
    return Row(case, name, off if said else np.inf, 3.0, status=diagnosis.verdict)


def one_of_a_batch_fails() -> list[Row]:
    """Test a batch of `jax.vmap` with one failing member, which must not affect the others."""
    rows = []
    for name in PRECISIONS:
        with precision(name):
            gas = beads(0.05, 0.15)
            a = gas.value(FREE)
            times = jnp.geomspace(1.0, 1e9, 3) * gas.mean_free_time

            few_steps = jaxgran.KineticTheory(**ENSKOG, max_steps=3000)

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
            rows.append(flagged("KineticTheory, nan", name, values, codes, 1, "outside its range"))
    gas = beads(0.05, 0.15, 0.05)
    times = jnp.asarray([0.5 * float(gas.mean_free_time)])
    # The others differ from single runs by round-off, which grows in the equilibration.
    for sized, allowed in (
        (DSMC(50), 1e-9),
        (HARD(50).sized_for(gas), 1e-3),
        (SOFT(50).sized_for(gas), 1e-3),
    ):
        model = type(sized).__name__

        def simulated(x, sized=sized):
            curve = jaxgran.cool(gas.replace(**{FREE: x}), times, model=sized)
            return curve.temperature, curve.status

        some = gas.value(FREE) * jnp.array([1.0, jnp.nan, 0.5])
        values, codes = jax.jit(jax.vmap(simulated))(some)
        rows.append(flagged(model, "float64", values, codes, 1, "outside its range"))
        alone = [jax.jit(simulated)(x)[0] for x in some[::2]]
        error = worst(values[::2], np.asarray(alone))
        rows.append(Row(f"{model}, others", "float64", error, allowed))
    return rows


_WRITER = """
import sys, numpy as np
from jaxgran.data import checkpoint
path, start = sys.argv[1], int(sys.argv[2])
for k in range(start, 10**9):
    checkpoint.save(path, {"N": "3"}, np.full(200_000, k))
"""

_DISK_FULL = """
import resource, signal, sys, numpy as np
from pathlib import Path
import jaxgran
from jaxgran.data import checkpoint
path = Path(sys.argv[1])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
curve = jaxgran.CoolingCurve(times=np.arange(1, 5000.0), temperature=np.arange(1, 5000.0))
for write in (
    lambda: checkpoint.save(path, {"N": "3"}, np.full(200_000, 7)),
    lambda: jaxgran.write_curve(path, curve, {}, overwrite=True),
):
    try:
        write()
    except OSError as error:
        print(error)
"""


def faults_on_the_way() -> list[Row]:
    """Test a killed process, a full disk, a missing folder, and checkpoints that do not belong.

    These are checkpoints of another run and of another version.
    """
    rows, like = [], np.zeros(200_000, int)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.ckpt"
        checkpoint.save(path, {"N": "3"}, like)
        ages = []
        for delay in (0.05, 0.11, 0.17):
            writer = subprocess.Popen([sys.executable, "-c", _WRITER, str(path), "1"])
            before = path.stat().st_mtime_ns
            while path.stat().st_mtime_ns == before and writer.poll() is None:
                time.sleep(0.01)
            time.sleep(delay)
            writer.send_signal(signal.SIGKILL)
            writer.wait()
            ages.append(len(np.unique(checkpoint.load(path, {"N": "3"}, like))))
        rows.append(_right("killed while writing", ages == [1, 1, 1], "the file is whole"))
        whole = path.read_bytes()
        for left in Path(folder).glob(".run.ckpt.*"):  # a killed process leaves its temporary file
            left.unlink()
        done = subprocess.run(
            [sys.executable, "-c", _DISK_FULL, str(path)],
            capture_output=True,
            text=True,
            check=False,
        )
        said = done.stdout.strip().splitlines()
        right = len(said) == 2 and all("not changed" in line and path.name in line for line in said)
        right = right and path.read_bytes() == whole and os.listdir(folder) == [path.name]
        words = (said[0] if said else done.stderr).replace(f"{folder}/", "")
        rows.append(_right("no room on the disk", right, words))
        nowhere = Path(folder) / "not there" / "run.ckpt"
        for what, write in (
            ("checkpoint", lambda: checkpoint.save(nowhere, {"N": "3"}, like)),
            ("curve", lambda: _write_curve(nowhere)),
        ):
            asked = r"could not write .*run\.ckpt"
            rows.append(refusal(f"{what}, no such folder", "float64", write, asked))
        gas = unit_gas(jaxgran.ConstantRestitution(0.9), 0.05)
        times = [float(gas.mean_free_time)]
        file = Path(folder) / "gas.ckpt"

        def resume(gas):
            jaxgran.cool(gas, times, model=DSMC(50), checkpoint=file)

        resume(gas)
        other = gas.replace(coefficient=0.8)
        asked = "belongs to another run: scene.law.coefficient was float64 0.9 and is float64 0.8"
        rows.append(refusal("another gas", "float64", lambda: resume(other), asked))
        header, body = file.read_bytes().split(b"\n", maxsplit=1)
        changed = json.loads(header) | {"version": "0.0.1"}
        file.write_bytes(json.dumps(changed).encode() + b"\n" + body)
        asked = "written by jaxgran 0.0.1"
        rows.append(refusal("another version", "float64", lambda: resume(gas), asked))
    return rows


def _right(case: str, right: bool, status: str) -> Row:
    return Row(case, "float64", 0.0 if right else np.inf, 0.0, status=status)


def _write_curve(path):
    values = jnp.arange(1.0, 4.0)
    jaxgran.write_curve(path, jaxgran.CoolingCurve(times=values, temperature=values), {})


RUNS = [
    Case(
        "times: one, 1e5, not from 0, 12 decades",
        "output times change the result; if the first is late, the beginning is left out",
        "every run begins at t = 0; an output time costs particle models milliseconds",
        times_of_every_kind,
    ),
    Case(
        "1e5 times through particles",
        "output only after fixed numbers of steps; memory for every state",
        "right, at 1 to 2 ms per output time",
        many_times,
        heavy=True,
    ),
    Case(
        "step 5 times too large, list 10 times too small",
        "energy grows or neighbours are missed, without a warning",
        "refused, or repeated with a smaller step or larger arrays; under jit nan and a status",
        steps_and_lists,
    ),
    Case(
        "stiff and non-stiff ends, rtol 1e-3 to 1e-12",
        "a tolerance without effect; a solver that does not finish",
        "the error follows rtol; beyond some 1e6 collisions an error advises the implicit solver",
        solver_ends,
    ),
    Case(
        "fits: open, corrupted, unexplained, far",
        "a wrong value with a small error bar",
        "a warning or the diagnosis says so, or the error bars are widened",
        fits,
    ),
    Case(
        "one member of a batch fails",
        "all members raise, or all are nan",
        "that one is nan with a status, the others are as in single runs",
        one_of_a_batch_fails,
    ),
    Case(
        "faults on the way",
        "incomplete files, lost runs, results of another run",
        "files are complete or unchanged; a wrong checkpoint is refused with the reason",
        faults_on_the_way,
    ),
]
