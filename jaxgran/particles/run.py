"""A run of particles through the times of its records, for any `AbstractDynamics`.

Compiled code moves a state by a bounded amount of work (`AbstractProcess.advance`). There are two
loops around it. `run_traced` is a pure function of arrays for `jax.jit`, `jax.vmap` and
derivatives; arrays that are too short end it in nan and a status. `run_on_host` needs known
numbers. It shows progress, writes checkpoints and trajectories, can be interrupted, and lengthens
arrays that are too short.

A run on the host consists of groups of replicas, the first axis of its state: one group of all
replicas, which share arrays, or a group for each replica (`grouped`). Groups run one after the
other on a device, and side by side on several CPU devices
(`jax.config.update("jax_num_cpu_devices", 2)`), because XLA works through sorts, sums and scatters
on one core. Each group has a key, a step, a neighbour list and arrays of its own: its numbers are
independent of the number of devices.

Small replicas of spheres on one device share one array, which saves the overhead of many short
operations. They share every quantity that the state holds once: the length of blocks or windows,
which the fastest spheres of all replicas decide, refined steps, and the skin, and thereby the times
of new neighbour lists. Each replica is as accurate as alone, but not the same bit for bit, and so,
after some collisions, another sample of the same gas. Replicas of `MIN_SPHERES_PER_RUN` spheres and
more run one after the other even on one CPU device: one array does not save time any more. Replicas
of DSMC share nothing but the array: each has its own steps and random numbers.
"""

import sys
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils import status
from jaxgran._utils.tracing import fast_compilation, nan_where, near_map_limit
from jaxgran.data import checkpoint
from jaxgran.data.run_options import Run
from jaxgran.data.trajectory import Sphere, Trajectory
from jaxgran.gradients.rule import Records, Result
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import AbstractDynamics, AbstractProcess
from jaxgran.particles.snapshot import Units, apply_save

CHECKPOINT_SECONDS = 60.0
"""Time between checkpoints; one more is written when a run is interrupted."""

MAX_ROWS_PER_PARTICLE = 100
"""Largest length of an array that is lengthened, in rows for each particle."""

MIN_SPHERES_PER_RUN = 8192
"""Smallest number of spheres in a replica with which replicas run one after the other.

Run time of four replicas one after the other, over the run time of the same four in one array, on
one core:

    spheres     1000   2000   4096
    hard         1.4    1.1    0.9
    soft         1.4    1.3    1.1
"""

FULL = status.LIST_FULL.bit | status.CONTACTS_FULL.bit
"""Faults of arrays that are too short."""

GROUPS = "groups"
"""Name of the axis of groups of replicas, which devices share."""

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


def begun(dynamics: AbstractDynamics, start: Any, key: Any, fault: Any, directions: Any) -> Any:
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

    def reach(stages: Stages, state: Any) -> Any:
        """Move a state by the first process, whose arrays suffice for all stages."""
        process, _ = stages[0]
        ends = jnp.stack([jnp.asarray(until) for _, until in stages])
        reached, _ = jax.lax.scan(
            lambda state, until: (_move(process, state, until), None), state, ends
        )
        return reached

    return dynamics.random_start(key, lambda call, *inputs: call(*inputs), reach)


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

    state = begun(dynamics, start, key, fault, directions)
    state, records = jax.lax.scan(record_at, state, times)
    fault = jnp.bitwise_or.reduce(state.status, axis=None)
    return Result(records, dynamics.to_lab_frame(state), fault)


class Groups(NamedTuple):
    """Groups of replicas of a run on the host.

    Attributes:
        number: number of groups.
        devices: CPU devices that share the groups; () for the default device alone.
    """

    number: int
    devices: tuple[Any, ...] = ()

    @property
    def rows(self) -> np.ndarray:
        """Groups that are run: the last one is repeated until devices have the same number."""
        shared = max(len(self.devices), 1)
        return np.minimum(np.arange(-(-self.number // shared) * shared), self.number - 1)

    def keys(self, key: PRNGKeyArray) -> Array:
        """Return a key for each group.

        A single group has `key`; group k of several has ``fold_in(key, k)``.
        """
        if self.number == 1:
            return key[None]
        return jax.vmap(partial(jax.random.fold_in, key))(self.rows)

    def split(self, arrays: Any) -> Any:
        """Return arrays of all replicas with a first axis of groups; None remains None."""
        rows = self.rows
        return jax.tree.map(lambda x: x.reshape(self.number, -1, x.shape[-1])[rows], arrays)


def grouped(replicas: int, spheres: int) -> Groups:
    """Return the groups of replicas: one of all of them, or one of each on CPU devices.

    There is one group on one device where each replica has less than `MIN_SPHERES_PER_RUN` spheres,
    on an accelerator, and if the user has chosen a device by `jax.default_device`.

    Args:
        replicas: number of replicas.
        spheres: number in each replica, 0 for DSMC.
    """
    chosen = jax.config.jax_default_device  # type: ignore[attr-defined]
    if replicas == 1 or jax.default_backend() != "cpu" or chosen is not None:
        return Groups(1)
    devices = tuple(jax.local_devices()[:replicas])
    if len(devices) > 1:
        return Groups(replicas, devices)
    return Groups(replicas if spheres >= MIN_SPHERES_PER_RUN else 1)


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
        records=_without_groups(reached.records, groups),
        particles=jax.tree.map(lambda x: _joined(np.asarray(x), 0, groups), particles),
        status=jnp.asarray(np.bitwise_or.reduce(faults, axis=None)),
    )


def _blank_start(dynamics: AbstractDynamics, groups: Groups, dtype: Any) -> tuple[Array, Array]:
    replicas, num_particles, dimension = dynamics.shape
    blank = jnp.zeros((len(groups.rows), replicas * num_particles, dimension), dtype)
    return blank, blank


def _first_state(
    loop: "HostLoop", start: Any, keys: Array, directions: Any, known: dict[str, Any] | None
) -> Any:
    """Return the state of all groups at t = 0, of a random start where none is given."""
    fault: Any = np.zeros(len(loop.groups.rows), np.int32)
    if start is None:
        start, fault = _random_start(loop, keys, known)
    return loop.each(_begin, (loop.dynamics, directions), (start, keys, fault))


def _random_start(loop: "HostLoop", keys: Array, known: dict[str, Any] | None) -> tuple[Any, Any]:
    """Return a random start and its faults: a new one, or a known one with new velocities."""
    dynamics = loop.dynamics
    if known is None:
        return dynamics.random_start(keys, loop.each, loop.reach)
    described = checkpoint.describe_run(equilibrium=dynamics.equilibrium, groups=len(keys))
    name = str(described)
    if name not in known:
        known[name] = dynamics.random_start(keys, loop.each, loop.reach)
        return known[name]
    start, fault = known[name]
    return loop.each(_with_new_velocities, dynamics, (start, keys)), fault


def _record_all(
    loop: "HostLoop",
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
                for values, x in zip(*map(jax.tree.leaves, (records, observe(state))), strict=True):
                    values[num_done] = x
                write(num_done, state)
                num_done += 1
            save(_Reached(num_done, state, records))
        except KeyboardInterrupt:
            save(_Reached(num_done, state, records))
            raise
    return _Reached(num_done, state, records)


def _with_new_velocities(dynamics: AbstractDynamics, group: tuple[Any, Any]) -> Any:
    return dynamics.with_new_velocities(*group)


def _begin(shared: tuple[AbstractDynamics, Any], group: tuple[Any, Any, Any]) -> Any:
    dynamics, directions = shared
    return begun(dynamics, *group, directions)


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
        """Call a short function for each group: with an input of all and one of this group."""
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
        capacity: Capacity | None = process.capacity
        longer = capacity and _LENGTHENED.get(capacity, capacity)
        lengthened = process if longer is None else process.with_capacity(longer)
        until = np.asarray(until, state.time.dtype)
        if process.calls_host:
            shared = lengthened, until
            each = [
                _advance(shared, jax.tree.map(lambda x, k=k: x[k], state))
                for k in range(len(state.time))
            ]
            moved = jax.tree.map(lambda *x: jnp.stack(x), *each)
        else:
            # No other part of the run has such a program: it runs for a short time.
            kind = type(process), capacity
            short = kind != (type(self.dynamics), self.dynamics.capacity)
            program = over_groups(_advance, self.groups.devices, short)
            with compiling(described_program(lengthened, state), self.progress):
                moved = program((lengthened, until), state)
        state, busy = block_until_ready(moved)
        checkpoint.stop_if_terminated()
        fault = np.asarray(state.status)
        is_full = (fault & FULL) > 0
        if capacity is not None and longer is not None and np.any(is_full):
            needed = np.max(np.asarray(state.needed), axis=0).tolist()
            replicas, num_particles, _ = process.shape
            if max(needed) <= MAX_ROWS_PER_PARTICLE * replicas * num_particles:
                _LENGTHENED[capacity] = longer.grown(needed)
                repeated = np.where(is_full, status.OK, fault)
                return state._replace(status=jnp.asarray(repeated)), True
        return state, bool(np.any(busy))


@cache
def over_groups(
    function: Callable[[Any, Any], T],
    devices: tuple[Any, ...],
    short: bool = False,
) -> Callable[[Any, Any], T]:
    """Return a compiled function that calls a function for each group of replicas.

    Args:
        function: of an input that all groups share, and of the input of one group.
        devices: that share the groups; () for the default device.
        short: whether the program runs for a short time. It is then compiled in three fifths of the
            time, and runs 5 to 40 % slower.
    """

    def call(shared: Any, groups: Any) -> T:
        return jax.lax.map(partial(function, shared), groups)

    options = fast_compilation(jax.default_backend()) if short else {}
    if devices:
        # With check_vma, shard_map would require all loops to declare the axis of groups.
        specs = PartitionSpec(), PartitionSpec(GROUPS)
        mesh = Mesh(np.array(devices), (GROUPS,))
        call = jax.shard_map(call, mesh=mesh, in_specs=specs, out_specs=specs[1], check_vma=False)
        # XLA would divide the operations of each group among threads of all cores, which then wait
        # for each other: two replicas of DSMC would take 15 to 20 % longer.
        options = options | {"xla_cpu_multi_thread_eigen": False}
    return jax.jit(call, compiler_options=options)


def _joined(x: np.ndarray, axis: int, groups: Groups) -> Array:
    """Return an array in which an axis of groups is joined with the next axis, of replicas."""
    kept = np.take(x, np.arange(groups.number), axis)
    joined = kept.shape[axis] * kept.shape[axis + 1]  # there may be no directions: not -1
    shape = *x.shape[:axis], joined, *x.shape[axis + 2 :]
    return jnp.asarray(kept.reshape(shape))


def _without_groups(records: Any, groups: Groups) -> Records:
    """Return the records of all replicas; their axes are times and groups."""
    others = records._replace(tangents={})
    joined = jax.tree.map(lambda x: _joined(x, 1, groups), others)
    # Directions come before replicas.
    tangents = jax.tree.map(lambda x: _joined(np.moveaxis(x, 1, 2), 2, groups), records.tangents)
    return joined._replace(tangents=tangents)


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
        joined = jax.tree.map(lambda x: _joined(np.asarray(x), 0, groups), arrays)
        particles = units.to_particles(replicas, *joined)
        trajectory.write(k, float(seconds[k]), particles, sphere)

    return write


def progress_bar(end: float, now: float, progress: bool, label: str | None = None) -> tqdm:
    """Return a bar of the time of a run, which appears on a terminal after some seconds."""
    return tqdm(
        total=end,
        initial=now,
        disable=None if progress else True,
        delay=3,
        desc=label,
        bar_format="{l_bar}{bar}| {elapsed} elapsed, {remaining} left{postfix}",
    )


_COMPILED: set[Hashable] = set()


def described_program(process: AbstractProcess, state: Any) -> Hashable:
    """Return a key of the compiled program: structure, shapes and dtype of its arguments."""
    leaves, structure = jax.tree.flatten((process, state))
    return structure, *(x.shape for x in leaves), leaves[-1].dtype


@contextmanager
def compiling(program: Hashable, progress: bool) -> Iterator[None]:
    """Show "compiling ..." on a terminal during the first call of a program in this process.

    Without `progress` nothing is shown. The progress bar follows. Near the limit of memory maps all
    programs of this process are dropped before.
    """
    text = "compiling ..."
    is_new = program not in _COMPILED
    if is_new and near_map_limit():
        jax.clear_caches()
        _COMPILED.clear()
    _COMPILED.add(program)
    shown = is_new and progress and sys.stderr.isatty()
    if shown:
        print(f"\r{text}", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if shown:
            print(f"\r{' ' * len(text)}\r", end="", file=sys.stderr, flush=True)


def block_until_ready(arrays: T) -> T:
    """Return arrays once they are computed; an interruption ends the waiting at once.

    Polling whether they are ready would take 3 to 8 % of a run's time.
    """
    return in_thread(lambda: jax.block_until_ready(arrays))


def in_thread(function: Callable[[], T]) -> T:
    """Return the result of a function that is called in a new thread.

    An interruption from the keyboard ends the waiting at once; the thread, which Python cannot end,
    then goes on in the background. JAX transformations and JAX configuration of the calling thread
    do not apply in the new one.
    """
    future: Future[T] = Future()

    def call() -> None:
        try:
            future.set_result(function())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=call, daemon=True).start()
    return future.result()
