"""A run of particles through the times of its records, for any `AbstractDynamics`.

Compiled code moves a state by a bounded amount of work (`AbstractProcess.advance`). There are two
loops around it. `run_traced` is a pure function of arrays for `jax.jit`, `jax.vmap` and
derivatives; arrays that are too short end it in nan and a status. `run_on_host` needs known
numbers. It shows progress, writes checkpoints and trajectories, can be interrupted, and lengthens
arrays that are too short.

A run on the host moves groups of replicas: see `jaxgran.particles.groups`.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import nan_where
from jaxgran._utils.waiting import block_until_ready
from jaxgran.data import checkpoint
from jaxgran.data.run_options import Run
from jaxgran.data.trajectory import Sphere, Trajectory
from jaxgran.gradients.rule import Records, Result
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import AbstractDynamics, AbstractProcess, P
from jaxgran.particles.groups import Groups, over_groups
from jaxgran.particles.progress import (
    compiling,
    described_program,
    drop_programs_near_limit,
    progress_bar,
)
from jaxgran.particles.snapshot import Units, apply_save

CHECKPOINT_SECONDS = 60.0
"""Time between checkpoints; one more is written when a run is interrupted."""

MAX_ROWS_PER_PARTICLE = 100
"""Largest length of an array that is lengthened, in rows for each particle."""

FULL = status.LIST_FULL.bit | status.CONTACTS_FULL.bit
"""Faults of arrays that are too short."""

Stages = Sequence[tuple[AbstractProcess, Any]]
"""Processes that move a state in turn, each until a time."""

T = TypeVar("T")


class Recorder(eqx.Module):
    """What is recorded of a state.

    Attributes:
        dynamics: of the particles.
        units: of the particles that `save` takes.
        save: function of the user of the particles of a replica, or None.
    """

    dynamics: AbstractDynamics
    units: Units
    save: Callable[..., Any] | None = eqx.field(static=True)

    def __call__(self, state: Any) -> Records:
        """Return the records of a state, nan where it has failed."""
        dynamics = self.dynamics
        saved = None
        failed = jnp.broadcast_to(state.status != status.OK, dynamics.shape[:1])
        if self.save is not None:
            arrays = dynamics.to_lab_frame(state)
            particles = self.units.to_particles(dynamics.shape[0], *arrays)
            saved = apply_save(self.save, particles)
            saved = jax.tree.map(partial(nan_where, failed), saved)
        # Replicas are the last axis of all others.
        one_or_nan = jnp.where(failed, jnp.nan, 1.0)  # a factor: derivatives are nan, too

        def with_nan(x: Array) -> Array:
            return x * jnp.broadcast_to(one_or_nan.astype(x.dtype), x.shape)

        records = jax.tree.map(with_nan, dynamics.observe(state))
        return records._replace(saved=saved)


def initial_state(
    dynamics: AbstractDynamics, start: Any, key: Any, fault: Any, directions: Any
) -> Any:
    """Return the state at t = 0, with the faults of its start."""
    state = dynamics.initial(start, key, directions)
    return state._replace(status=state.status | fault)


def _move(process: AbstractProcess, state: Any, until: Array) -> Any:
    return jax.lax.while_loop(
        lambda state: process.unfinished(state, until),
        lambda state: process.advance(state, until),
        state,
    )


@eqx.filter_jit
def start_traced(dynamics: AbstractDynamics, key: PRNGKeyArray) -> tuple[Any, Any]:
    """Return a random start and its faults inside JAX transformations."""

    def each(function: Callable[[Any, Any], T], shared: Any, group: Any) -> T:
        """Call a function for the only group, whose arrays have no axis of groups."""
        return function(shared, group)

    def reach(stages: Stages, state: Any) -> Any:
        """Move a state by the first process, whose arrays suffice for all stages."""
        process, _ = stages[0]
        ends = jnp.stack([jnp.asarray(until) for _, until in stages])
        reached, _ = jax.lax.scan(
            lambda state, until: (_move(process, state, until), None), state, ends
        )
        return reached

    return dynamics.random_start(key, each, reach)


@eqx.filter_jit
def run_traced(
    recorder: Recorder,
    times: Float[Array, "times"],
    start: Any,
    key: PRNGKeyArray,
    directions: Any,
    fault: Any = status.OK,
) -> Result:
    """Return the result of a run inside JAX transformations.

    Args:
        recorder: with the dynamics of all replicas in one array.
        times: of the records.
        start: positions and velocities; None for random ones.
        key: of the random numbers.
        directions: of tangents in the material; None for no tangents.
        fault: of the start.
    """
    dynamics = recorder.dynamics
    if start is None:
        start, fault = start_traced(dynamics, key)

    def record_at(state: Any, until: Array) -> tuple[Any, Records]:
        state = _move(dynamics, state, until)
        return state, recorder(state)

    state = initial_state(dynamics, start, key, fault, directions)
    state, records = jax.lax.scan(record_at, state, times)
    fault = jnp.bitwise_or.reduce(state.status, axis=None)
    return Result(records, dynamics.to_lab_frame(state), fault)


# `over_groups` keeps one compiled program for each function. So these are functions of the module:
# a lambda or a partial, made anew in each run, would be compiled in each run.


def _with_new_velocities(dynamics: AbstractDynamics, group: tuple[Any, Any]) -> Any:
    return dynamics.with_new_velocities(*group)


def _begin(shared: tuple[AbstractDynamics, Any], group: tuple[Any, Any, Any]) -> Any:
    dynamics, directions = shared
    return initial_state(dynamics, *group, directions)


def _observe(recorder: Recorder, state: Any) -> Records:
    return recorder(state)


def _to_lab_frame(dynamics: AbstractDynamics, state: Any) -> Any:
    return dynamics.to_lab_frame(state)


def _advance(shared: tuple[AbstractProcess, Any], state: Any) -> tuple[Any, Array]:
    process, until = shared
    state = process.advance(state, until)
    return state, process.unfinished(state, until)


_LENGTHENED: dict[Capacity, Capacity] = {}
"""Lengthened arrays by the original ones. Later runs begin with them, and neither fail on the way
to them nor compile again. Results do not depend on it."""


class HostLoop:
    """A loop of Python around compiled code, for all groups of replicas.

    Args:
        dynamics: of a group.
        groups: of the replicas.
        progress: whether to show progress on a terminal.
    """

    def __init__(self, dynamics: AbstractDynamics, groups: Groups, progress: bool):
        self.dynamics = dynamics
        self.groups = groups
        self.progress = progress

    def each(self, function: Callable[[Any, Any], T], shared: Any, group: Any) -> T:
        """Call a function for each group in compiled code that runs for a short time.

        Args:
            function: of the module, see `over_groups`.
            shared: its first input, the same for all groups.
            group: its second input, with a first axis of groups.
        """
        return over_groups(function, self.groups.devices, short=True)(shared, group)

    def time(self, state: Any) -> float:
        """Return the time that all groups have reached."""
        return float(np.min(np.asarray(state.time)))

    def reach(self, stages: Stages, state: Any) -> Any:
        """Move states by some processes in turn, each until a time."""
        end = float(np.asarray(stages[-1][1]))
        with progress_bar(end, 0.0, self.progress and end > 0, "equilibrating") as bar:
            for process, until in stages:
                busy = True
                while busy:
                    state, busy = self.call(process, state, until)
                    bar.update(self.time(state) - bar.n)
        return state

    def call(self, process: AbstractProcess, state: Any, until: Any) -> tuple[Any, bool]:
        """Call compiled code once, and lengthen arrays where necessary.

        Returns:
            The states, and whether any of them has not reached the time.
        """
        lengthened = _with_lengthened_arrays(process)
        until = np.asarray(until, state.time.dtype)
        if process.calls_host:
            moved = _advance_one_by_one(lengthened, until, state)
        else:
            # Only the equilibration uses a process of another kind or other lengths: it runs for a
            # short time.
            kind = type(process), process.capacity
            short = kind != (type(self.dynamics), self.dynamics.capacity)
            program = over_groups(_advance, self.groups.devices, short)
            described = described_program(lengthened, state)
            drop_programs_near_limit(described)
            with compiling(described, self.progress):
                moved = program((lengthened, until), state)
        state, busy = block_until_ready(moved)
        checkpoint.stop_if_terminated()
        fault = np.asarray(state.status)
        is_full = (fault & FULL) > 0
        if np.any(is_full) and _lengthen(process, state):
            repeated = np.where(is_full, status.OK, fault)
            return state._replace(status=jnp.asarray(repeated)), True
        return state, bool(np.any(busy))


def _advance_one_by_one(
    process: AbstractProcess, until: np.ndarray, state: Any
) -> tuple[Any, Array]:
    """Advance the groups of a process that calls the host, one after the other."""
    groups = [jax.tree.map(lambda x, k=k: x[k], state) for k in range(len(state.time))]
    moved = [_advance((process, until), group) for group in groups]
    return jax.tree.map(lambda *x: jnp.stack(x), *moved)


def _with_lengthened_arrays(process: P) -> P:
    """Return a process with arrays of the largest length that any run of it has needed."""
    if process.capacity is None:
        return process
    return process.with_capacity(_LENGTHENED.get(process.capacity, process.capacity))


def _lengthen(process: AbstractProcess, state: Any) -> bool:
    """Lengthen the arrays of all later calls of a process; return whether that is possible.

    Args:
        process: with the original lengths.
        state: of all groups, for which arrays were too short.
    """
    capacity = process.capacity
    if capacity is None:
        return False
    needed = np.max(np.asarray(state.needed), axis=0).tolist()
    replicas, num_particles, _ = process.shape
    if max(needed) > MAX_ROWS_PER_PARTICLE * replicas * num_particles:
        return False
    _LENGTHENED[capacity] = _LENGTHENED.get(capacity, capacity).grown(needed)
    return True


class _Reached(NamedTuple):
    """How far a run on the host has come, which a checkpoint contains.

    Attributes:
        num_done: number of times that are recorded.
        state: of all groups.
        records: at all times; 0 at those that are not reached.
    """

    num_done: int
    state: Any
    records: Any


def run_on_host(
    recorder: Recorder,
    times: Float[Array, "times"],
    start: Any,
    key: PRNGKeyArray,
    directions: Any,
    groups: Groups,
    run: Run,
    seconds: Float[Array, "times"],
) -> Result:
    """Return the result of a run of known numbers.

    Args:
        recorder: with the dynamics of one group of replicas.
        times, start, directions: see `run_traced`; the start is of all replicas.
        key: of the random numbers; group k of several has ``fold_in(key, k)``.
        groups: of the replicas.
        run: options of the run.
        seconds: the times in SI.
    """
    dynamics = recorder.dynamics
    if dynamics.calls_host:
        groups = Groups(groups.number)
    loop = HostLoop(dynamics, groups, run.progress)
    keys = groups.keys(key)
    path = None if run.checkpoint is None else Path(run.checkpoint)
    resumed = path is not None and path.exists()
    write = _writer(recorder, loop, run, resumed, seconds)  # an error comes before the run
    start = groups.split(start)
    described: dict[str, str] = {}
    if path is not None:
        described = checkpoint.describe_run(
            **dynamics.described(),
            times=times,
            start=start,
            key=keys,
            directions=directions,
            units=recorder.units,
            save=recorder.save,
        )
    if start is None and resumed:  # only its shape counts
        start = _blank_start(dynamics, groups, times.dtype)
    state = _first_state(loop, start, keys, directions, run.starts)
    observe = partial(over_groups(_observe, groups.devices), recorder)

    def empty(x: Array) -> np.ndarray:
        return np.zeros((len(times), *x.shape), x.dtype)

    reached = _Reached(0, state, jax.tree.map(empty, observe(state)))
    if path is not None and resumed:
        num_done, loaded, records = checkpoint.load(path, described, tuple(reached))
        reached = _Reached(num_done, jax.tree.map(jnp.asarray, loaded), records)

    def save(reached: _Reached) -> None:
        if path is not None:
            checkpoint.save(path, described, tuple(reached))

    reached = _record_all(loop, observe, times, reached, save, write)
    particles = loop.each(_to_lab_frame, dynamics, reached.state)
    faults = np.asarray(reached.state.status)
    return Result(
        records=groups.join_records(reached.records),
        particles=groups.join(particles),
        status=jnp.asarray(np.bitwise_or.reduce(faults, axis=None)),
    )


def _blank_start(dynamics: AbstractDynamics, groups: Groups, dtype: Any) -> tuple[Array, Array]:
    replicas, num_particles, dimension = dynamics.shape
    blank = jnp.zeros((len(groups.rows), replicas * num_particles, dimension), dtype)
    return blank, blank


def _first_state(
    loop: HostLoop, start: Any, keys: Array, directions: Any, starts: dict[str, Any] | None
) -> Any:
    """Return the state of all groups at t = 0, of a random start where none is given."""
    fault: Any = np.zeros(len(loop.groups.rows), np.int32)
    if start is None:
        start, fault = _random_start(loop, keys, starts)
    return loop.each(_begin, (loop.dynamics, directions), (start, keys, fault))


def _random_start(loop: HostLoop, keys: Array, starts: dict[str, Any] | None) -> tuple[Any, Any]:
    """Return a random start and its faults: a new one, or a known one with new velocities."""
    dynamics = loop.dynamics
    if starts is None:
        return dynamics.random_start(keys, loop.each, loop.reach)
    described = checkpoint.describe_run(equilibrium=dynamics.equilibrium, groups=len(keys))
    name = str(described)
    if name not in starts:
        starts[name] = dynamics.random_start(keys, loop.each, loop.reach)
        return starts[name]
    start, fault = starts[name]
    return loop.each(_with_new_velocities, dynamics, (start, keys)), fault


def _record_all(
    loop: HostLoop,
    observe: Callable[[Any], Records],
    times: Float[Array, "times"],
    reached: _Reached,
    save: Callable[[_Reached], None],
    write: Callable[[int, Any], None],
) -> _Reached:
    """Move all groups through the times that are left.

    Args:
        loop: around compiled code.
        observe: returns the records of a state.
        times: of the records.
        reached: where the run begins; its records are filled.
        save: writes a checkpoint.
        write: writes the particles at time number k.
    """
    num_done, state, records = reached
    last_save = time.monotonic()

    def temperature() -> str:
        return f"T/T_0 = {float(np.mean(observe(state).values['temperature'])):.3g}"

    with progress_bar(float(times[-1]), loop.time(state), loop.progress) as bar:
        try:
            while num_done < len(times):
                busy = True
                while busy:
                    # An interruption saves the state before the current call.
                    state, busy = loop.call(loop.dynamics, state, times[num_done])
                    bar.update(loop.time(state) - bar.n)
                    if not bar.disable:
                        bar.set_postfix_str(temperature(), refresh=False)
                    if time.monotonic() - last_save > CHECKPOINT_SECONDS:
                        save(_Reached(num_done, state, records))
                        last_save = time.monotonic()
                observed = jax.tree.leaves(observe(state))
                for values, x in zip(jax.tree.leaves(records), observed, strict=True):
                    values[num_done] = x
                write(num_done, state)
                num_done += 1
            save(_Reached(num_done, state, records))
        except KeyboardInterrupt:
            save(_Reached(num_done, state, records))
            raise
    return _Reached(num_done, state, records)


def _writer(
    recorder: Recorder, loop: HostLoop, run: Run, resumed: bool, seconds: Float[Array, "times"]
) -> Callable[[int, Any], None]:
    """Return a function that writes the particles at time number k to the trajectory."""
    if run.trajectory is None:
        return lambda k, state: None
    dynamics = recorder.dynamics
    units = recorder.units
    groups = loop.groups
    replicas = groups.number * dynamics.shape[0]
    trajectory = Trajectory(run.trajectory, replicas, resumed)
    sphere = Sphere(float(units.length), float(units.mass))

    def write(k: int, state: Any) -> None:
        arrays = loop.each(_to_lab_frame, dynamics, state)
        particles = units.to_particles(replicas, *groups.join(arrays))
        trajectory.write(k, float(seconds[k]), particles, sphere)

    return write
