import io
from contextlib import redirect_stderr
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tqdm import tqdm

import jaxgran
from jaxgran.gradients.rule import Records
from jaxgran.particles import run
from jaxgran.particles.run import RunFailure, compiling, run_through_times
from tests.beads import assert_same, glass_beads

TIMES = np.array([0.0, 0.3, 1.0, 1.1, 2.5])
STEPS = 2 + 3 + 1 + 6  # of at most 0.25, from time to time


class State(NamedTuple):
    time: jax.Array
    x: jax.Array
    count: jax.Array


def start():
    return State(jnp.zeros(()), jnp.array([1.0, 2.0]), jnp.zeros((), jnp.int32))


def advance(state, until):
    dt = jnp.minimum(0.25, until - state.time)
    last = until - state.time <= 0.25
    time = jnp.where(last, until, state.time + dt)
    return State(time, state.x * jnp.exp(-dt), state.count + 1)


def observe(state):
    values = {"temperature": state.x**2, "total": jnp.sum(state.x), "count": state.count}
    return Records(values, {}, {})


class Calls:
    """`advance`, counted, that raises something at one call."""

    def __init__(self, at=None, error=KeyboardInterrupt):
        self.number, self.at, self.error = 0, at, error

    def __call__(self, state, until):
        if self.number == self.at:
            jax.tree.map(lambda x: x.delete(), state)  # as a program does that takes its buffers
            raise self.error
        self.number += 1
        return advance(state, until)


def quiet(*args, **options):
    """The last state and the records of a run that does not fail."""
    *found, fault = run_through_times(*args, progress=False, **options)
    assert fault == 0
    return tuple(found)


@pytest.mark.parametrize(
    "error, at", [(KeyboardInterrupt, 0), (KeyboardInterrupt, STEPS - 1), (MemoryError, 7)]
)
def test_a_run_that_ends_early_is_resumed_and_then_read_back(tmp_path, monkeypatch, error, at):
    if error is MemoryError:  # the run cannot write a checkpoint as it dies
        monkeypatch.setattr(run, "CHECKPOINT_SECONDS", 0.0)
    saved = {"scene": {"name": "toy"}, "path": tmp_path / "run.npz"}
    whole = quiet(start(), TIMES, advance, observe)
    with pytest.raises(error):
        quiet(start(), TIMES, Calls(at, error), observe, **saved)
    assert saved["path"].exists()
    rest = Calls()
    resumed = quiet(start(), TIMES, rest, observe, **saved)
    assert rest.number == STEPS - at
    assert all(isinstance(leaf, jax.Array) for leaf in resumed[0])
    for found in (resumed, quiet(start(), TIMES, Calls(0), observe, **saved)):
        assert_same(found, whole)


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def eager(monkeypatch):
    """Bars are drawn at once."""
    monkeypatch.setattr(run, "tqdm", lambda **kw: tqdm(**(kw | {"delay": 0, "mininterval": 0})))


def shown(stream, capsys, **settings):
    with redirect_stderr(stream):
        run_through_times(start(), TIMES, advance, observe, label="toy", **settings)
    assert capsys.readouterr() == ("", "")  # nothing elsewhere
    return stream.getvalue()


def test_the_bar_shows_the_temperature_on_a_terminal_alone(eager, capsys):
    last = shown(Terminal(), capsys).split("\r")[-1]
    # The mean of 1 and 4, cooled by exp(-2 x 2.5).
    assert last.startswith("toy: 100%") and "T/T_0 = 0.0168" in last and "left" in last
    assert shown(io.StringIO(), capsys) == ""


def test_compiling_is_said_until_the_program_runs_where_a_bar_would_be():
    with redirect_stderr(Terminal()) as stream, compiling(object(), progress=True):
        assert stream.getvalue() == "\rcompiling ..."
    assert stream.getvalue().split("\r")[-2:] == [" " * 13, ""]  # removed, for the bar
    for stream, progress in ((Terminal(), False), (io.StringIO(), True)):
        with redirect_stderr(stream), compiling(object(), progress):
            pass
        assert stream.getvalue() == ""


def test_a_run_says_that_it_compiles_once(monkeypatch):
    monkeypatch.setattr(run, "_COMPILED", set())
    said, model = [], jaxgran.DSMC(64, replicas=2)
    for _ in range(2):
        with redirect_stderr(Terminal()) as stream:
            jaxgran.cool(glass_beads(), [1e-3], model=model)
        said.append("compiling ..." in stream.getvalue())
    assert said == [True, False]


def test_the_bar_goes_on_where_the_run_was(tmp_path, eager, capsys):
    path = tmp_path / "run.npz"
    with pytest.raises(KeyboardInterrupt):
        quiet(start(), TIMES, Calls(6), observe, path=path)  # at t = 1.1 of 2.5
    first = shown(Terminal(), capsys, path=path).split("\r")[1]
    assert first.startswith("toy:  44%")


def test_a_failure_leaves_nan_and_a_status():
    def fails(state, until):
        if state.time >= 1.0:
            raise RunFailure(16)
        return advance(state, until)

    state, records, fault = run_through_times(start(), TIMES, fails, observe, progress=False)
    assert "not a finite number" in jaxgran.explain_status(fault) and state.time == 1.0
    total = records.values["total"]
    assert np.all(np.isfinite(total[:3])) and np.all(np.isnan(total[3:]))
