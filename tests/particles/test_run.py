"""The loop on the host: resumption, the bar, failures, and arrays that grow."""

import io
from contextlib import redirect_stderr
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tqdm import tqdm

import jaxgran
from jaxgran._utils import status
from jaxgran.gradients.rule import Records
from jaxgran.particles import progress, run
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.groups import Groups
from jaxgran.particles.run import Recorder, run_on_host, run_traced
from jaxgran.particles.snapshot import Units
from tests.beads import assert_same, glass_beads

TIMES = jnp.array([0.0, 0.3, 1.0, 1.1, 2.5])
STEPS = 1 + 2 + 3 + 1 + 6  # of at most 0.25, from time to time; at t = 0 a call does nothing
ROWS = Capacity(10, 0, 0, 0, 0)


class Decay(NamedTuple):
    time: jax.Array
    status: jax.Array
    needed: jax.Array
    x: jax.Array
    count: jax.Array


class Decaying(AbstractDynamics):
    """Particles whose velocities decay, in steps; one fails at a time, or needs longer arrays."""

    scene: jax.Array
    fails_at: jax.Array
    grows_at: jax.Array
    shape: tuple[int, int, int] = eqx.field(static=True, default=(2, 1, 1))
    capacity: Capacity = eqx.field(static=True, default=ROWS)

    @property
    def calls_host(self) -> bool:
        return False

    def random_start(self, key, each, reach):
        return None, jnp.zeros(key.shape, jnp.int32)

    @property
    def equilibrium(self):
        return None

    def with_new_velocities(self, start, key):
        return None

    def initial(self, start, key, directions):
        zero = jnp.zeros((), jnp.int32)
        return Decay(jnp.zeros(()), zero, jnp.zeros(5, jnp.int32), jnp.array([1.0, 2.0]), zero)

    def unfinished(self, state, until):
        return (state.status == status.OK) & (state.time < until)

    def advance(self, state, until):
        dt = jnp.minimum(0.25, until - state.time)
        last = until - state.time <= 0.25
        moved = state._replace(
            time=jnp.where(last, until, state.time + dt),
            x=state.x * jnp.exp(-self.scene * dt),
            count=state.count + 1,
        )
        unable = (state.time >= self.grows_at) & (self.capacity.pairs < 40)
        fault = status.flag(status.NOT_FINITE, state.time >= self.fails_at)
        fault |= status.flag(status.LIST_FULL, unable)
        needed = jnp.zeros(5, jnp.int32).at[0].set(40)
        failed = state._replace(status=fault, needed=needed)
        moved = jax.tree.map(lambda x, y: jnp.where(fault == status.OK, x, y), moved, failed)
        return jax.tree.map(
            lambda x, y: jnp.where(self.unfinished(state, until), x, y), moved, state
        )

    def observe(self, state):
        count = state.count * jnp.ones(2)
        return Records({"temperature": state.x**2, "count": count}, {}, {})

    def to_lab_frame(self, state):
        return state.x[:, None], state.x[:, None], None


def decaying(fails_at=np.inf, grows_at=np.inf) -> Recorder:
    one = jnp.ones(())
    dynamics = Decaying(one, jnp.asarray(fails_at), jnp.asarray(grows_at))
    return Recorder(dynamics, Units(one, one, one, one, one), None)


def on_host(recorder, **options):
    options = jaxgran.extend.Run(**{"progress": False} | options)
    return run_on_host(recorder, TIMES, None, jax.random.key(0), None, Groups(1), options, TIMES)


class Calls:
    """Compiled code that ends in an error at one call."""

    def __init__(self, monkeypatch, at=None, error=KeyboardInterrupt):
        self.number, self.at, self.error = 0, at, error
        self.compiled = run.over_groups
        monkeypatch.setattr(run, "over_groups", self)

    def __call__(self, function, *options, **more):
        program = self.compiled(function, *options, **more)
        if function is not run._advance:
            return program

        def call(shared, state):
            if self.number == self.at:
                raise self.error
            self.number += 1
            return program(shared, state)

        return call


@pytest.mark.parametrize(
    "error, at", [(KeyboardInterrupt, 0), (KeyboardInterrupt, STEPS - 1), (MemoryError, 7)]
)
def test_a_run_that_ends_early_is_resumed_and_then_read_back(tmp_path, monkeypatch, error, at):
    if error is MemoryError:  # the run cannot write a checkpoint as it dies
        monkeypatch.setattr(run, "CHECKPOINT_SECONDS", 0.0)
    recorder, path = decaying(), tmp_path / "run.ckpt"
    whole = on_host(recorder)
    with monkeypatch.context() as patch:
        Calls(patch, at, error)
        with pytest.raises(error):
            on_host(recorder, checkpoint=path)
    assert path.exists()
    with monkeypatch.context() as patch:
        rest = Calls(patch)
        resumed = on_host(recorder, checkpoint=path)
        # Saved at the time of a record, of which a first call finds that it is reached.
        assert rest.number == STEPS - at + (error is MemoryError)
    assert_same(resumed, whole)
    with monkeypatch.context() as patch:
        Calls(patch, 0)
        assert_same(on_host(recorder, checkpoint=path), whole)
    with pytest.raises(ValueError, match="another run: fails_at"):
        on_host(decaying(fails_at=9.0), checkpoint=path)


def test_both_loops_give_the_same():
    traced = run_traced(decaying(), TIMES, None, jax.random.key(0), None)
    found = on_host(decaying())
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), found, traced)


def test_arrays_that_are_too_short_grow_and_the_next_run_begins_with_them(monkeypatch):
    monkeypatch.setattr(run, "_LENGTHENED", {})
    whole = on_host(decaying())
    grown = on_host(decaying(grows_at=1.0))
    assert_same(grown, whole)
    assert run._LENGTHENED[ROWS].pairs >= 40
    monkeypatch.setattr(Capacity, "grown", lambda *args: pytest.fail("they grew again"))
    assert_same(on_host(decaying(grows_at=1.0)), whole)


def test_a_failure_leaves_nan_and_a_status():
    for result in (
        on_host(decaying(fails_at=1.0)),
        run_traced(decaying(fails_at=1.0), TIMES, None, jax.random.key(0), None),
    ):
        assert "not a finite number" in jaxgran.explain_status(result.status)
        T = result.records.values["temperature"]
        assert np.all(np.isfinite(T[:3])) and np.all(np.isnan(T[3:]))
        # The last good state is that at t = 1.
        np.testing.assert_allclose(result.particles[1][:, 0], np.exp(-1.0) * np.array([1.0, 2.0]))


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def eager(monkeypatch):
    """Bars are drawn at once."""
    monkeypatch.setattr(
        progress, "tqdm", lambda **kw: tqdm(**(kw | {"delay": 0, "mininterval": 0}))
    )


def shown(stream, capsys, **options):
    with redirect_stderr(stream):
        on_host(decaying(), progress=True, **options)
    assert capsys.readouterr() == ("", "")  # nothing elsewhere
    return stream.getvalue()


def test_the_bar_shows_the_temperature_on_a_terminal_alone(eager, capsys):
    last = shown(Terminal(), capsys).split("\r")[-1]
    # The mean of 1 and 4, cooled by exp(-2 x 2.5).
    assert last.startswith("100%") and "T/T_0 = 0.0168" in last and "left" in last
    assert shown(io.StringIO(), capsys) == ""


def test_the_bar_goes_on_where_the_run_was(tmp_path, eager, capsys, monkeypatch):
    path = tmp_path / "run.ckpt"
    with monkeypatch.context() as patch:
        Calls(patch, at=7)  # at t = 1.1 of 2.5
        with pytest.raises(KeyboardInterrupt):
            on_host(decaying(), checkpoint=path)
    first = shown(Terminal(), capsys, checkpoint=path).split("\r")[1]
    assert first.startswith(" 44%")


def test_compiling_is_said_until_the_program_runs_where_a_bar_would_be():
    with redirect_stderr(Terminal()) as stream, progress.compiling(object(), progress=True):
        assert stream.getvalue() == "\rcompiling ..."
    assert stream.getvalue().split("\r")[-2:] == [" " * 13, ""]  # removed, for the bar
    for stream, is_wanted in ((Terminal(), False), (io.StringIO(), True)):
        with redirect_stderr(stream), progress.compiling(object(), is_wanted):
            pass
        assert stream.getvalue() == ""


def test_a_run_says_that_it_compiles_once(monkeypatch):
    monkeypatch.setattr(progress, "_COMPILED", set())
    said, model = [], jaxgran.DSMC(64, replicas=2)
    for _ in range(2):
        with redirect_stderr(Terminal()) as stream:
            jaxgran.cool(glass_beads(), [1e-3], model=model)
        said.append("compiling ..." in stream.getvalue())
    assert said == [True, False]
