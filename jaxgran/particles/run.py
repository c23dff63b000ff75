"""Particle runs of soft or hard spheres: inside JAX transformations, or from the host.

A gas starts from random positions and Maxwellian velocities. It is equilibrated by elastic motion,
and at t = 0 it has no momentum and the temperature T_0. Or it starts from particles of the user.

`simulate_traced` is a pure function of arrays for `jax.jit`, `jax.vmap` and derivatives. Its
capacities are fixed; a run that exceeds them ends in nan and a status. `simulate_on_host` needs
known numbers. It shows progress, writes checkpoints and trajectories, can be interrupted, and
enlarges arrays that are too short.

Replicas run separately where the process has several CPU devices
(`jax.config.update("jax_num_cpu_devices", 2)`), because XLA works through sorts, sums and scatters
on one core: `run_replicas`. Each has a key, a step, a neighbour list and arrays of its own, and its
numbers are independent of the number of devices.

On one device small replicas of spheres share one array, which saves the overhead of many short
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
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils import status
from jaxgran._utils.tracing import concrete_array, fast_compilation
from jaxgran.data import checkpoint
from jaxgran.data.checkpoint import describe_run
from jaxgran.data.curve import Particles, Run
from jaxgran.data.particles import Sphere, Trajectory, file_of_replica
from jaxgran.gradients.rule import Records, Result
from jaxgran.particles import neighbours, snapshot
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import MAX_STALLED, AbstractDynamics, run_segments
from jaxgran.particles.setup import (
    host_positions,
    maxwellian_velocities,
    normalise_velocities,
    relaxed_positions,
)
from jaxgran.particles.state import State, centred, copy_buffers
from jaxgran.scene.geometry import MIN_BOX

EQUILIBRATION_COLLISIONS = 10.0
"""Duration of the equilibration, in mean free times."""

SETTLING_COLLISIONS = 2.0
"""Mean free times of equilibration after which the capacity of the run is sufficient."""

CHECKPOINT_SECONDS = 60.0
"""Time between checkpoints; one more is written when a run is interrupted."""

MAX_ROWS_PER_PARTICLE = 100
"""Rows per particle beyond which an array is not enlarged."""

SEGMENTS_PER_CALL = 8
"""Largest number of segments in one call of compiled code; progress is shown between calls."""

MIN_SPHERES_PER_RUN = 8192
"""Least number of spheres in a replica with which replicas run one after the other. On one core
four replicas of 1000, 2000 and 4096 take then 1.4, 1.1 and 0.9 (hard), 1.4, 1.3 and 1.1 (soft)
times as long as in one array."""

Devices = tuple[Any, ...]

T = TypeVar("T")


class Inputs(NamedTuple):
    """Arguments that determine a run, in reduced units.

    Attributes:
        scene: the gas; it has a collision_frequency.
        times: t at which to record.
        start: positions and velocities given by the user; None for random ones.
        key: of the random numbers; None for the default.
        units: of the saved particle data, whose derivatives are not known.
    """

    scene: Any
    times: Float[Array, "times"]
    start: tuple[Array, Array] | None
    key: PRNGKeyArray | None
    units: Any = None


class Simulation(NamedTuple):
    """A run of spheres in boxes.

    Attributes:
        dynamics: dynamics of the spheres, with the capacity of the run.
        equilibration_capacity: capacity in the first mean free times of the equilibration.
        inputs: times, start and key, in reduced units.
        directions: directions of the tangents in the material; None for no tangents.
        num_particles: number of particles in each box.
        dimension: dimension d.
        skin: skin of the first neighbour list.
        engine: method of finding the pairs, see `neighbours.ENGINES`.
        save: function of the user of the particles of a replica, or None.
    """

    dynamics: AbstractDynamics
    equilibration_capacity: Capacity
    inputs: Inputs
    directions: Any
    num_particles: int
    dimension: int
    skin: ArrayLike
    engine: str
    save: Callable[[Particles], Any] | None = None

    @property
    def equilibration_time(self) -> Array:
        """Duration of the equilibration."""
        return EQUILIBRATION_COLLISIONS / self.dynamics.scene.collision_frequency

    @property
    def key(self) -> PRNGKeyArray:
        """Key of the random numbers."""
        return jax.random.key(0) if self.inputs.key is None else self.inputs.key

    @property
    def drift(self) -> Array:
        """Velocity of the frame of the run: that of the centre of mass of each given replica.

        Its shape is (n, d). It is the number 0 for a random start, and where walls or drag are at
        rest.
        """
        if self.inputs.start is None or not self.dynamics.scene.galilean_invariant:
            return jnp.zeros(())
        velocity = self.inputs.start[1]
        return velocity - centred(velocity, self.dynamics.replicas).reshape(velocity.shape)

    def result(self, state: State, records: Records, fault: ArrayLike) -> Result:
        """Return the results of a run, in the frame in which the start was given."""
        last = self.to_lab_frame(state, self.inputs.times[-1])
        return Result(records, last, jnp.asarray(fault, jnp.int32))

    def to_lab_frame(self, state: State, time: Array) -> tuple[Array, Array, Array | None]:
        """Return wrapped positions, velocities and spins in the frame of the given start."""
        drift = self.drift
        velocity, spin = self.dynamics.to_lab_frame(state, state.velocity + drift)
        inside = neighbours.wrap(self.dynamics.scene.side, state.position + drift * time)
        return inside, velocity, spin

    def observe(self, state: State) -> Records:
        """Return the records of a state, with those of the user's function."""
        records = self.dynamics.observe(state)
        if self.save is None:
            return records
        return records._replace(saved=snapshot.saved(self.save, self.particles(state)))

    def particles(self, state: State) -> Particles:
        """Return the particles of a state in SI."""
        arrays = self.to_lab_frame(state, state.time)
        return snapshot.particles(self.inputs.units, self.dynamics.replicas, *arrays)

    def writer(self, run: Run) -> Callable[[int, State], None]:
        """Return a function that writes the particles at time number k to the trajectory."""
        if run.trajectory is None:
            return lambda k, state: None
        resumed = run.checkpoint is not None and Path(run.checkpoint).exists()
        trajectory = Trajectory(run.trajectory, self.dynamics.replicas, resumed)
        units = self.inputs.units
        sphere = Sphere(float(units.length), float(units.mass))
        unit_time = float(units.length / units.velocity)

        def write(k: int, state: State) -> None:
            time = float(self.inputs.times[k]) * unit_time
            trajectory.write(k, time, self.particles(state), sphere)

        return write

    def first_state(self, traced: bool, fault: Any = status.OK) -> tuple[State, Any]:
        """Return the state before the equilibration, or that of a given start, and the status.

        Args:
            traced: whether a random start must not call the host.
            fault: status before.
        """
        dynamics = self.dynamics
        if self.inputs.start is not None:
            position, velocity = self.inputs.start
            return dynamics.begin(position, velocity - self.drift, self.skin), fault
        position_key, velocity_key = jax.random.split(self.key)
        size, region = (dynamics.replicas, self.num_particles, self.dimension), dynamics.region
        side, sizes = dynamics.scene.side, self.equilibration_capacity[:2]
        if traced:
            position, fault = relaxed_positions(
                position_key, side, size, self.skin, sizes, region, fault
            )
        else:
            position = host_positions(position_key, side, *size, region)
        position = position if region is None else position + 0.5
        velocity = maxwellian_velocities(velocity_key, *size)
        return dynamics.begin(position, velocity, self.skin), fault

    def cooling_state(self, equilibrated: State) -> State:
        """Return the state at t = 0 after equilibration, with tangents if there are directions.

        The first call of `AbstractDynamics.advance` counts the energy in contacts.
        """
        velocity = equilibrated.velocity
        if self.inputs.start is None:
            velocity = normalise_velocities(velocity, self.dynamics.replicas)
        state = self.dynamics.begin(equilibrated.position, velocity, equilibrated.skin)
        state = self.dynamics.sample_spins(state, self.key)
        if self.directions is None:
            return state
        return self.dynamics.with_tangents(state, self.directions)


@eqx.filter_jit
def simulate_traced(sim: Simulation) -> Result:
    """Equilibrate and cool inside JAX transformations, with records at the times of the inputs."""
    dynamics, inputs = sim.dynamics, sim.inputs
    engine = neighbours.choose_engine(sim.engine, dynamics.capacity.lookahead, traced=True)
    side = dynamics.scene.side
    # In a smaller box a new neighbour list is stale at once, and the loop would not end.
    fault = status.flag(status.BOX_TOO_SMALL, side < MIN_BOX)
    state, fault = sim.first_state(True, fault)
    if sim.inputs.start is None:
        elastic = dynamics.elastic().with_capacity(sim.equilibration_capacity)
        state, fault, _ = run_segments(
            elastic, state, sim.equilibration_time, engine, 0, None, fault
        )
    else:
        fault |= dynamics.check_start(state)

    def record_at(carry, target):
        (state, fault), (end, least) = carry, target
        state, fault, _ = run_segments(dynamics, state, end, engine, least, None, fault)
        records, failed = sim.observe(state), fault != status.OK
        return (state, fault), jax.tree.map(partial(snapshot.nan_where, failed), records)

    # One segment until t = 0 counts the energy in contacts. With it in the loop over the times a
    # program has the segments once.
    ends = jnp.concatenate([jnp.zeros_like(state.time)[None], inputs.times])
    least = jnp.zeros(len(ends), jnp.int32).at[0].set(1)
    carry = sim.cooling_state(state), fault
    (state, fault), records = jax.lax.scan(record_at, carry, (ends, least))
    records = jax.tree.map(lambda x: x[1:], records)
    return sim.result(state, records, fault)


def simulate_on_host(sim: Simulation, run: Run, settings: dict[str, Any]) -> Result:
    """Equilibrate and cool from the host, and enlarge arrays where they are too short.

    Args:
        sim: the run, with known numbers.
        run: its options.
        settings: further settings that determine the result, by name, for the checkpoint.
    """
    write = sim.writer(run)  # raises an error before the equilibration if there cannot be a file
    dynamics, progress = sim.dynamics, run.progress
    state, fault = sim.first_state(False)
    engine = neighbours.choose_engine(sim.engine, dynamics.capacity.lookahead)
    resumed = run.checkpoint is not None and Path(run.checkpoint).exists()
    if sim.inputs.start is None and not resumed:
        state, fault = _equilibrate(sim, copy_buffers(state), engine, progress)
    state = copy_buffers(sim.cooling_state(state))

    def advance(state: State, end: float) -> State:
        return _advance(state, end, dynamics, engine, progress)

    try:
        if fault == status.OK:  # counts the energy in contacts
            state = advance(state, 0.0)
    except RunFailure as failure:
        fault, state = failure.fault, failure.state
    given = sim.inputs._asdict() | settings | {"directions": sim.directions, "save": sim.save}
    state, records, fault = run_through_times(
        state,
        np.asarray(sim.inputs.times),
        advance,
        sim.observe,
        shown=dynamics.observe,
        scene={} if run.checkpoint is None else describe_run(**given),
        progress=progress,
        path=run.checkpoint,
        write=write,
        fault=fault,
    )
    return sim.result(state, jax.tree.map(jnp.asarray, records), fault)


def _equilibrate(sim: Simulation, state: State, engine: str, progress: bool) -> tuple[State, int]:
    """Return the state after equilibration, and the status."""
    elastic = sim.dynamics.elastic()
    settled = SETTLING_COLLISIONS / float(elastic.scene.collision_frequency)

    def advance(state: State, end: float) -> State:
        crowded = float(state.time) < settled
        dynamics = elastic.with_capacity(sim.equilibration_capacity) if crowded else elastic
        short = dynamics.capacity != elastic.capacity  # no other part of the run has this program
        return _advance(state, end, dynamics, engine, progress, short)

    end = np.asarray([sim.equilibration_time])
    state, _, fault = run_through_times(
        state, end, advance, elastic.observe, progress=progress, label="equilibrating"
    )
    return state, fault


_GROWN: dict[Capacity, Capacity] = {}
"""Enlarged capacities by the original ones. Later runs begin with the enlarged ones, and neither
fail on the way to them nor compile again. Results do not depend on it."""


def _advance(
    state: State,
    end: float,
    dynamics: AbstractDynamics,
    engine: str,
    progress: bool,
    short: bool = False,
) -> State:
    """Run some segments towards an end; enlarge arrays where necessary.

    One compiled call runs several segments, or one segment if the host finds the pairs. The given
    state may be deleted; a failure holds the last good one.

    Raises:
        RunFailure: for any other failure.
    """
    until, capacity = np.asarray(end, state.time.dtype), dynamics.capacity
    static = "engine", "min_segments", "max_segments"
    while True:
        sized = dynamics.with_capacity(enlarged := _GROWN.get(capacity, capacity))
        if engine == "sweep":
            program = state.position.shape, until.dtype, jax.tree.structure((sized, state))
            with compiling(program, progress):
                result = compiled_for_host(run_segments, static, short)(
                    sized, state, until, engine, min_segments=1, max_segments=SEGMENTS_PER_CALL
                )
            state, fault, needed = block_until_ready(result)
        else:
            now = block_until_ready(sized.run_segment(state, end, engine))
            fault, needed = now.status, now.needed
            state = now.state if int(fault) == status.OK else state
        fault, needed = int(fault), np.asarray(needed).tolist()
        if fault == status.OK:
            return state
        full = fault & (status.LIST_FULL.bit | status.CONTACTS_FULL.bit)
        if not full or max(needed) > MAX_ROWS_PER_PARTICLE * len(state.position):
            raise RunFailure(fault, state)
        # The whole segment is repeated, because a list made within it has another order.
        _GROWN[capacity] = enlarged.grown(needed)


class RunFailure(Exception):
    """Failure of a run, with its status and the last good state.

    The state is None if it is the one before the call.
    """

    def __init__(self, fault: int, state: Any = None):
        super().__init__(status.explain(fault))
        self.fault, self.state = fault, state


def run_through_times(
    state: Any,
    times: np.ndarray,
    advance: Callable[[Any, float], Any],
    observe: Callable[[Any], Records],
    *,
    write: Callable[[int, Any], None] = lambda k, state: None,
    shown: Callable[[Any], Records] | None = None,
    scene: dict[str, str] | None = None,
    progress: bool = True,
    label: str | None = None,
    path: str | Path | None = None,
    fault: int = status.OK,
) -> tuple[Any, Records, int]:
    """Advance a state through all times and record it at each.

    Args:
        state: pytree with a field `time`, at the beginning of the run.
        times: increasing times, not before that of the state.
        advance: function that advances a state towards a time, but not beyond it. It may delete the
            given state, and raises `RunFailure` if it cannot.
        observe: function that returns the records, a dictionary of arrays.
        write: function of the number of a time and the state there.
        shown: function whose result "temperature" the progress bar shows; `observe` by default.
        scene: description of everything that determines the result.
        progress: whether to show a bar with T/T_0 and the time left, after some seconds, on a
            terminal.
        label: label of the bar.
        path: checkpoint, from which the run is resumed if it exists; None for none.
        fault: status before; unless it is ok the state is not advanced.

    Returns:
        The last state; the records, whose first axis is that of the times, with nan (integers: 0)
        from a failure on; and the status.
    """
    records = jax.tree.map(
        lambda x: np.zeros((len(times), *np.shape(x)), np.asarray(x).dtype), observe(state)
    )
    num_done, last_save, num_stalled = 0, time.monotonic(), 0
    if path is not None and Path(path).exists():
        done, loaded, records = checkpoint.load(path, scene or {}, (0, state, records))
        num_done = int(done)
        # JAX arrays of the same types do not make compiled functions compile again.
        state = jax.tree.map(lambda new, old: concrete_array(new, old.dtype), loaded, state)

    def save():
        if path is not None:
            checkpoint.save(path, scene or {}, (num_done, state, records))

    bar = tqdm(
        total=float(times[-1]),
        initial=float(state.time),
        disable=None if progress else True,
        delay=3,
        desc=label,
        bar_format="{l_bar}{bar}| {elapsed} elapsed, {remaining} left{postfix}",
    )
    with bar:
        try:
            if fault != status.OK:
                raise RunFailure(fault)
            while num_done < len(times):
                while (now := float(state.time)) < times[num_done]:
                    # An interruption saves the state before the current call.
                    given = state if path is None else copy_buffers(state)
                    state = advance(given, float(times[num_done]))
                    num_stalled = num_stalled + 1 if float(state.time) <= now else 0
                    if num_stalled >= MAX_STALLED:
                        raise RunFailure(status.STALLED.bit)
                    bar.update(float(state.time) - bar.n)
                    if not bar.disable:
                        ratio = float(np.mean((shown or observe)(state).values["temperature"]))
                        bar.set_postfix_str(f"T/T_0 = {ratio:.3g}", refresh=False)
                    if time.monotonic() - last_save > CHECKPOINT_SECONDS:
                        save()
                        last_save = time.monotonic()
                for values, x in zip(*map(jax.tree.leaves, (records, observe(state))), strict=True):
                    values[num_done] = x
                write(num_done, state)
                num_done += 1
            save()
        except KeyboardInterrupt:
            save()
            raise
        except RunFailure as failure:
            fault, state = failure.fault, failure.state or state
            for values in jax.tree.leaves(records):
                values[num_done:] = np.nan if np.issubdtype(values.dtype, np.inexact) else 0
    return state, records, fault


@cache
def compiled_for_host(
    function: Callable[..., T], static: tuple[str, ...] = (), short: bool = False
) -> Callable[..., T]:
    """Return a compiled function for the host driver, which deletes the given `state`.

    That state must come from `copy_buffers` or from an earlier call. If the program runs for a
    `short` time, it is compiled in three fifths of the time, and runs 5 to 40 % slower.
    """
    options = fast_compilation(jax.default_backend()) if short else {}
    if jax.default_backend() == "cpu" and jax.local_device_count() > 1:
        # Runs go on side by side, one on each device. XLA would divide the operations of each run
        # among threads of all cores, which then wait for each other: two replicas of DSMC would
        # take 15 to 20 % longer. With one device this changes the time of a run by less than 6 %.
        options = options | {"xla_cpu_multi_thread_eigen": False}
    return jax.jit(
        function, static_argnames=static, donate_argnames="state", compiler_options=options
    )


_COMPILED: set[Hashable] = set()


@contextmanager
def compiling(program: Hashable, progress: bool) -> Iterator[bool]:
    """Tell whether the block is the first call for a program in this process.

    If so, and with `progress`, show "compiling ..." on a terminal during it; the progress bar
    follows.
    """
    new, text = program not in _COMPILED, "compiling ..."
    _COMPILED.add(program)
    shown = new and progress and sys.stderr.isatty()
    if shown:
        print(f"\r{text}", end="", file=sys.stderr, flush=True)
    try:
        yield new
    finally:
        if shown:
            print(f"\r{' ' * len(text)}\r", end="", file=sys.stderr, flush=True)


_STOP: ContextVar[threading.Event | None] = ContextVar("stop", default=None)
"""Event that ends the calls of `in_threads`: a key pressed by the user reaches only the main
thread. None in the main thread."""


def block_until_ready(arrays: T) -> T:
    """Return arrays once they are computed; an interruption ends the waiting at once.

    Polling whether they are ready would take 3 to 8 % of a run's time.

    Raises:
        KeyboardInterrupt: also in a thread of `in_threads`, once another one has failed or was
            interrupted.
    """
    arrays = in_thread(lambda: jax.block_until_ready(arrays))
    if (stop := _STOP.get()) is not None and stop.is_set():
        raise KeyboardInterrupt
    return arrays


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


def in_threads(functions: Sequence[Callable[[], T]], devices: Sequence[Any]) -> list[T]:
    """Call functions outside of JAX transformations, each in a thread with a device of its own.

    Programs that they compile are those of runs outside of transformations. An interruption from
    the keyboard, or an error of one, ends all at their next `block_until_ready`.
    """
    x64, stop = jax.config.read("jax_enable_x64"), _STOP.get() or threading.Event()

    def call(function: Callable[[], T], device: Any) -> T:
        _STOP.set(stop)
        try:
            with jax.enable_x64(x64), jax.default_device(device):
                return function()
        except BaseException:
            stop.set()
            raise

    with ThreadPoolExecutor(len(functions)) as pool:
        futures = [pool.submit(call, *each) for each in zip(functions, devices, strict=True)]
        try:
            wait(futures)
        except BaseException:
            stop.set()
            raise
    errors = [error for future in futures if (error := future.exception()) is not None]
    # Where one has failed, the others are interrupted.
    for error in sorted(errors, key=lambda error: isinstance(error, KeyboardInterrupt)):
        raise error
    return [future.result() for future in futures]


def chosen_device() -> Any:
    """Return the device that `jax.default_device` has set in this thread, or None."""
    return jax.config.jax_default_device  # type: ignore[attr-defined]


def replica_devices(replicas: int, spheres: int = 0) -> Devices:
    """Return the CPU devices for separate runs of replicas; () where they share one array.

    They share one array if there is one device and each has less than `MIN_SPHERES_PER_RUN` spheres
    (0 for DSMC), on an accelerator, and if the user has chosen a device by `jax.default_device`.
    """
    if replicas == 1 or jax.default_backend() != "cpu" or chosen_device() is not None:
        return ()
    devices = tuple(jax.local_devices()[:replicas])
    return devices if len(devices) > 1 or spheres >= MIN_SPHERES_PER_RUN else ()


def run_replicas(
    run_one: Callable[[int, Run], T], replicas: int, run: Run, devices: Devices
) -> list[T]:
    """Run all replicas separately, replica k on device k modulo their number; see `in_threads`.

    After an interruption each saves its checkpoint.

    Args:
        run_one: function that runs replica k alone.
        replicas: number of replicas.
        run: options; replica k has the key ``fold_in(key, k)`` and its own files.
        devices: CPU devices.

    Raises:
        ValueError: for the checkpoint of replicas in one array.
    """
    if run.checkpoint is not None and Path(run.checkpoint).exists():
        raise ValueError(
            f"{run.checkpoint} was written by replicas in one array, but on {len(devices)} CPU "
            "device(s) each replica here has its own checkpoint. Resume it on one CPU device, or "
            "name another file"
        )
    key = jax.random.key(0) if run.key is None else run.key

    def run_some(first: int) -> list[T]:
        return [
            run_one(
                k,
                run._replace(
                    key=jax.random.fold_in(key, k),
                    progress=run.progress and first == 0,
                    checkpoint=run.checkpoint and Path(f"{run.checkpoint}.{k}"),
                    trajectory=run.trajectory and file_of_replica(run.trajectory, k),
                ),
            )
            for k in range(first, replicas, len(devices))
        ]

    by_device = in_threads([partial(run_some, first) for first in range(len(devices))], devices)
    return [by_device[k % len(devices)][k // len(devices)] for k in range(replicas)]


def join_results(runs: list[Result]) -> Result:
    """Join the results of runs with one replica each to those of one run.

    Particles are joined along the first axis. Records have the shape (times, replicas, ...); in
    derivatives along directions replicas are the last axis.
    """

    def joined(axis: int, *parts: Array) -> Array:
        return concrete_array(np.concatenate([np.asarray(part) for part in parts], axis))

    records = [each.records for each in runs]
    tangents = jax.tree.map(partial(joined, -1), *(each.tangents for each in records))
    others = (each._replace(tangents={}) for each in records)
    fault = concrete_array(np.bitwise_or.reduce([np.asarray(out.status) for out in runs]))
    return Result(
        records=jax.tree.map(partial(joined, 1), *others)._replace(tangents=tangents),
        particles=jax.tree.map(partial(joined, 0), *(each.particles for each in runs)),
        status=fault,
    )
