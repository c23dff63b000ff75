"""The host driver of particle runs: progress, checkpoints, interruption, arrays that grow.

For runs whose numbers are all known; the same run as a pure function is in `pure`.

How many cores of a CPU a compiled program of a run takes.

Waiting for compiled code in a way that the user can interrupt.

Compiled programs of the host driver, which are kept.

A run of spheres in boxes: what its two layers, `pure` and `driver`, have in common.

A gas starts from random positions and Maxwellian velocities, melts elastically, and then cools from
exactly T_0 without momentum; or it starts from what a user gives.

Runs of spheres as a pure function of arrays: for `jax.jit`, `jax.vmap` and derivatives.

Capacities are fixed beforehand; a run that exceeds them ends in nan and a status. There is no I/O.

Replicas as runs of their own, side by side on the CPU devices of a process, or in turn on one.

XLA works through sorts, sums and scatters on one core. Where a process has several CPU devices
(`jax.config.update("jax_num_cpu_devices", 2)`), each replica of a run from the host is a run with
one replica and a key of its own, on one of them: it has its own step, neighbour list and arrays,
and its numbers are the same whoever runs beside it.

On one device small replicas of spheres stand in one array, which saves the overhead of many short
operations. Then they share what is one number of a state: the length of blocks or windows, which
the hottest (fastest) spheres of all decide, refined steps, the skin, and with it when a neighbour
list is made. Each is as accurate as alone, but not the same bit for bit, and so, after some
collisions, another sample of the same gas. Replicas of `MANY` spheres and more run one after the
other on one CPU device, too, where one array saves nothing any more. Replicas of DSMC share nothing
but the array: each has its own steps and random numbers.
"""

import queue
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, concrete
from jaxgran.data import checkpoint
from jaxgran.data.checkpoint import describe_run
from jaxgran.data.curve import Particles, Run
from jaxgran.data.particles import Sphere, Trajectory, file_of_replica
from jaxgran.gradients.rule import Inputs, Outputs
from jaxgran.particles import neighbours, snapshot
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import MAX_IDLE, AbstractDynamics, run_segments
from jaxgran.particles.setup import (
    host_positions,
    maxwellian_velocities,
    normalise_velocities,
    relaxed_positions,
)
from jaxgran.particles.state import State, centred, empty_records, fill_nan_from, with_own_buffers


def cpu_compiler_options() -> dict[str, str | bool] | None:
    """Options of the compiler for a program that the host driver calls.

    Where a process has several CPU devices, runs go on side by side, one on each. XLA would divide
    the operations of every one among threads of all cores, which then wait for each other: two
    replicas of DSMC take 15 to 20 % longer so. A program of each device takes one core instead. For
    one device there are no options: a single run takes as long with them as without, within 6 %.
    """
    if jax.default_backend() != "cpu" or jax.local_device_count() == 1:
        return None
    return {"xla_cpu_multi_thread_eigen": False}


Waited = TypeVar("Waited")

_THREAD = threading.local()


@contextmanager
def stopped_by(stop: threading.Event) -> Iterator[None]:
    """In this thread, which an interruption from the keyboard does not reach, an event stands for
    it: `waited_for` raises KeyboardInterrupt once it is set."""
    _THREAD.stop = stop
    try:
        yield
    finally:
        _THREAD.stop = None


def block_until_ready(arrays: Waited) -> Waited:
    """The same arrays, once they are computed; an interruption ends the waiting at once.

    Looking again and again whether they are ready would take 3 to 8 % of a run's time.

    Raises:
        KeyboardInterrupt: in a thread within `stopped_by`, too, once its event is set.
    """
    arrays = in_thread(lambda: jax.block_until_ready(arrays))
    if (stop := getattr(_THREAD, "stop", None)) is not None and stop.is_set():
        raise KeyboardInterrupt
    return arrays


def in_thread(function: Callable[[], Waited]) -> Waited:
    """The result of a function that is called in a thread of its own.

    An interruption from the keyboard ends the waiting at once; the thread, which Python cannot end,
    then goes on in the background. No JAX transformation and no JAX configuration of the calling
    thread is under way in that thread.
    """
    results: queue.SimpleQueue[tuple[bool, object]] = queue.SimpleQueue()

    def call() -> None:
        try:
            results.put((True, function()))
        except BaseException as error:
            results.put((False, error))

    threading.Thread(target=call, daemon=True).start()
    succeeded, result = results.get()
    if not succeeded:
        assert isinstance(result, BaseException)
        raise result
    return result  # type: ignore[return-value]


def outside_transformations(function: Callable[[], Waited]) -> Waited:
    """Call a function in a thread of its own, where no JAX transformation is under way."""
    x64, device = jax.config.read("jax_enable_x64"), chosen_device()

    def call() -> Waited:
        with jax.enable_x64(x64), jax.default_device(device):
            return function()

    return in_thread(call)


def chosen_device() -> Any:
    """The device that `jax.default_device` has set in this thread, or None."""
    return jax.config.jax_default_device  # type: ignore[attr-defined]


SEGMENTS_PER_CALL = 8
"""Neighbour lists used in one call of compiled code; progress is shown between calls."""

COMPILING = "compiling ..."


@contextmanager
def compiling(progress: bool) -> Iterator[None]:
    """Say "compiling ..." on a terminal as long as the block lasts; the progress bar follows."""
    shown = progress and sys.stderr.isatty()
    if shown:
        print(f"\r{COMPILING}", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if shown:
            print(f"\r{' ' * len(COMPILING)}\r", end="", file=sys.stderr, flush=True)


_COMPILED: set[Hashable] = set()


def needs_compilation(program: Hashable) -> bool:
    """Whether this process is told of a program for the first time, and so has it to compile."""
    new = program not in _COMPILED
    _COMPILED.add(program)
    return new


MAX_PROGRAMS = 32
"""Compiled programs that are kept; beyond that the one unused for longest is released."""

_PROGRAMS: OrderedDict[Any, jax.stages.Compiled] = OrderedDict()
"""Programs of `stretches` by what they were compiled for. Unlike those that `jax.jit` keeps they
are bounded in number, and shared by plain runs and those inside a rule of differentiation."""


def compiled_segments(
    dynamics: AbstractDynamics,
    state: State,
    end: np.ndarray,
    engine: str,
    progress: bool = False,
    donate: bool = False,
) -> tuple[State, Array, Array]:
    """`STRETCHES` stretches, compiled for the types and the static fields of these arguments.

    With `donate` the new state is written over the given one, which must be `owned` and is deleted.
    """
    kept, rest = jax.tree.flatten((dynamics, end))
    moving, of_state = jax.tree.flatten(state)

    def some(moving: list[Array], kept: list[Array]) -> tuple[State, Array, Array]:
        dynamics, end = rest.unflatten(kept)
        state = of_state.unflatten(moving)
        return run_segments(dynamics, state, end, engine, least=1, most=SEGMENTS_PER_CALL)

    leaves = moving, kept
    if any_traced(leaves):  # constants within a transformation of something else
        return jax.jit(some)(*leaves)
    types = tuple((x.shape, x.dtype, getattr(x, "sharding", None)) for x in (*moving, *kept))
    key = engine, SEGMENTS_PER_CALL, rest, of_state, types, donate
    if (program := _PROGRAMS.pop(key, None)) is None:  # in one step: there are threads
        jitted = jax.jit(some, donate_argnums=0 if donate else ())
        with compiling(progress):
            options = cpu_compiler_options()
            program = outside_transformations(lambda: jitted.lower(*leaves).compile(options))
    _PROGRAMS[key] = program
    if len(_PROGRAMS) > MAX_PROGRAMS:
        _PROGRAMS.popitem(last=False)
    return program(*leaves)


EQUILIBRATION_COLLISIONS = 10.0
"""Mean free times of elastic motion before t = 0."""

DRIVE_TIME = 10.0
"""Further mean free times in a steady state, where a gas begins in one."""

SETTLING_TIME = 2.0
"""Mean free times of melting after which the capacity of the run suffices."""

MIN_BOX = 2.1
"""Box side in diameters below which a sphere could touch another one and its image at once."""


class Simulation(NamedTuple):
    """A run of spheres in boxes.

    Attributes:
        dynamics: how they move; with the capacity of the run.
        melt_capacity: of the first mean free times of the melt.
        inputs: times, start and key, in reduced units.
        directions: in the material, along which tangents are followed; None for no tangents.
        num_particles: in each box.
        dimension: d.
        skin: of the first neighbour list.
        engine: who finds the pairs, see `neighbours.engine`.
        save: a user's function of the particles of a replica; None for none.
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
    def needs_equilibration(self) -> bool:
        """Whether the start is random."""
        return self.inputs.start is None

    @property
    def equilibration_time(self) -> Array:
        """Duration of the melt."""
        return EQUILIBRATION_COLLISIONS / self.dynamics.scene.collision_frequency

    @property
    def prepared_time(self) -> Array:
        """Time at the end of the preparation, which begins at that of the melt."""
        return (EQUILIBRATION_COLLISIONS + DRIVE_TIME) / self.dynamics.scene.collision_frequency

    @property
    def key(self) -> PRNGKeyArray:
        """Of the random numbers."""
        return jax.random.key(0) if self.inputs.key is None else self.inputs.key

    @property
    def drift(self) -> Array:
        """Velocity of the centre of mass of each particle's replica, in which the run is at rest.

        Shape (n, d), or 0 for a random start, and where walls or drag are at rest.
        """
        if self.inputs.start is None or not self.dynamics.inertial:
            return jnp.zeros(())
        velocity = self.inputs.start[1]
        return velocity - centred(velocity, self.dynamics.replicas).reshape(velocity.shape)

    def outputs(self, state: State, records: dict[str, Array], fault: ArrayLike) -> Outputs:
        """The results of a run, in the frame in which the start was given."""
        position, velocity, spin = self.to_lab_frame(state, self.inputs.times[-1])
        fault = jnp.asarray(fault, jnp.int32)
        return Outputs(position, velocity, records, fault, spin)

    def to_lab_frame(self, state: State, time: Array) -> tuple[Array, Array, Array | None]:
        """Positions in the box, velocities and spins, in the frame in which the start was given."""
        drift = self.drift
        velocity, spin = self.dynamics.to_lab_frame(state, state.velocity + drift)
        inside = neighbours.wrap(self.dynamics.scene.side, state.position + drift * time)
        return inside, velocity, spin

    def observe(self, state: State) -> dict[str, Array]:
        """The records of a state, and what a user's function makes of it."""
        records = self.dynamics.observe(state)
        if self.save is None:
            return records
        return records | snapshot.saved(self.save, self.particles(state))

    def particles(self, state: State) -> Particles:
        """The particles of a state in SI."""
        to_lab_frame = self.to_lab_frame(state, state.time)
        return snapshot.particles(self.inputs.units, self.dynamics.replicas, *to_lab_frame)

    def writer(self, run: Run) -> Callable[[int, State], None]:
        """Writes the particles at a time, by its number, to the trajectory, if there is one."""
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

    def first_state(self) -> State:
        """The state at the beginning of the melt, or of the run of a given start."""
        if self.inputs.start is not None:
            position, velocity = self.inputs.start
            return self.dynamics.begin(position, velocity - self.drift, self.skin)
        places, _ = jax.random.split(self.key)
        return self._at_random(host_positions(places, *self._box))

    def compiled_first_state(self, fault: Array) -> tuple[State, Array]:
        """The same without a call to the host, and the status, from that before."""
        if self.inputs.start is not None:
            return self.first_state(), fault
        places, _ = jax.random.split(self.key)
        side, *size, room = self._box
        lists = self.equilibration_capacity.pairs, self.equilibration_capacity.lookahead
        sizes = size[0], size[1], size[2]
        found, fault = relaxed_positions(places, side, sizes, self.skin, lists, room, fault)
        return self._at_random(found), fault

    @property
    def _box(self) -> tuple[Array, int, int, int, Array | None]:
        """Side, replicas, particles in each, dimension and room."""
        dynamics = self.dynamics
        size = dynamics.replicas, self.num_particles, self.dimension
        return dynamics.scene.side, *size, dynamics.room

    def _at_random(self, position: Array) -> State:
        """The state of random velocities at given positions."""
        _, speeds = jax.random.split(self.key)
        position = position if self.dynamics.room is None else position + 0.5
        velocity = maxwellian_velocities(
            speeds, self.dynamics.replicas, self.num_particles, self.dimension
        )
        return self.dynamics.begin(position, velocity, self.skin)

    def cooling_state(self, melted: State) -> State:
        """The state at t = 0, from that at the end of the melt; with tangents if they are wanted.

        The energy in contacts is counted by the first call of `AbstractDynamics.advance`.
        """
        velocity = melted.velocity
        if self.needs_equilibration:
            velocity = normalise_velocities(velocity, self.dynamics.replicas)
        state = self.dynamics.begin(melted.position, velocity, melted.skin)
        state = self.dynamics.sample_spins(state, self.key, melted)
        if self.directions is None:
            return state
        return self.dynamics.with_tangents(state, self.directions)


CHECKPOINT_SECONDS = 60.0
"""A checkpoint is written this often, and when the run is interrupted."""

MAX_PAIRS_EACH = 100
"""Rows per particle beyond which an array does not grow any more."""


class RunFailure(Exception):
    """A run that cannot go on, with its status, and its last good state where that is not the one
    from before the call."""

    def __init__(self, fault: int, state: Any = None):
        super().__init__(status.explain(fault))
        self.fault, self.state = fault, state


@runtime_checkable
class _Timed(Protocol):
    @property
    def time(self) -> Any: ...


S = TypeVar("S", bound=_Timed)


def run_through_times(
    state: S,
    times: np.ndarray,
    advance: Callable[[S, float], S],
    observe: Callable[[S], dict[str, jax.Array]],
    *,
    write: Callable[[int, S], None] = lambda k, state: None,
    shown: Callable[[S], dict[str, jax.Array]] | None = None,
    scene: dict[str, str] | None = None,
    progress: bool = True,
    label: str | None = None,
    path: str | Path | None = None,
    fault: int = status.OK,
) -> tuple[S, dict[str, np.ndarray], int]:
    """Take a state through all times and observe it at each.

    Args:
        state: a pytree with a field `time`; where the run starts.
        times: increasing, not before the state's own.
        advance: takes a state towards a time, at most to it; raises `Failure` if it cannot.
        observe: what to record, a dictionary of arrays.
        write: called with the number of a time and the state there.
        shown: of its results "temperature" is shown in the bar; `observe` by default.
        scene: description of everything that fixes the result.
        progress, label: show a bar with T/T_0 and the time left, after some seconds, on a terminal.
        path: of the checkpoint, from which the run is resumed if it exists; None for none.
        fault: the status before; unless it is ok nothing is done.

    Returns:
        The last state; the records with a first axis of times, nan from a failure on; the status.
    """
    done, state, records = _resumed(path, scene, state, empty_records(observe(state), len(times)))
    saved, idle = time.monotonic(), 0

    def save():
        if path is not None:
            checkpoint.save(path, scene or {}, (done, state, records))

    with _progress_bar(float(times[-1]), float(state.time), progress, label) as bar:
        try:
            _raise_if(fault)
            while done < len(times):
                while (now := float(state.time)) < times[done]:
                    state = advance(state, float(times[done]))
                    idle = _idle(idle, now, state)
                    _show(bar, state, shown or observe)
                    if time.monotonic() - saved > CHECKPOINT_SECONDS:
                        save()
                        saved = time.monotonic()
                _record(records, done, observe(state))
                write(done, state)
                done += 1
            save()
        except KeyboardInterrupt:
            save()
            raise
        except RunFailure as failure:
            fault, state = failure.fault, failure.state or state
            fill_nan_from(records, done)
    return state, records, fault


def _raise_if(fault: int) -> None:
    if fault != status.OK:
        raise RunFailure(fault)


def _record(records: dict[str, np.ndarray], done: int, observed: dict[str, jax.Array]) -> None:
    for name, value in observed.items():
        records[name][done] = value


def _idle(idle: int, before: float, state: _Timed) -> int:
    """How often in a row the time has not advanced; Failure if too often."""
    idle = idle + 1 if float(state.time) <= before else 0
    if idle >= MAX_IDLE:
        raise RunFailure(status.STALLED.bit)
    return idle


def _resumed(
    path: str | Path | None, scene: dict[str, str] | None, state: S, records: dict[str, np.ndarray]
) -> tuple[int, S, dict[str, np.ndarray]]:
    """The number of times done, the state and the records: of a checkpoint, if there is one."""
    if path is None or not Path(path).exists():
        return 0, state, records
    done, loaded, records = checkpoint.load(path, scene or {}, (0, state, records))
    # As JAX arrays of the same types: the compiled functions must not see a difference.
    state = jax.tree.map(lambda new, old: concrete(new, old.dtype), loaded, state)
    return int(done), state, records


def _progress_bar(total: float, initial: float, progress: bool, label: str | None) -> tqdm:
    return tqdm(
        total=total,
        initial=initial,
        disable=None if progress else True,
        delay=3,
        desc=label,
        bar_format="{l_bar}{bar}| {elapsed} elapsed, {remaining} left{postfix}",
    )


def _show(bar: tqdm, state: Any, observe: Callable[[Any], dict[str, jax.Array]]) -> None:
    bar.update(float(state.time) - bar.n)
    if not bar.disable:
        ratio = float(np.mean(observe(state)["temperature"]))
        bar.set_postfix_str(f"T/T_0 = {ratio:.3g}", refresh=False)


_GROWN: dict[Capacity, Capacity] = {}
"""What capacities came to be enlarged to: the next run begins with the larger ones, and neither
fails on the way to them nor compiles again. Results do not depend on it."""


def simulate_on_host(sim: Simulation, run: Run, settings: dict[str, Any]) -> Outputs:
    """Melt and cool, enlarging arrays where they are too short.

    Args:
        sim: the run, with known numbers.
        run: its options.
        settings: what else fixes the result, by name, for the checkpoint's description.
    """
    if sim.directions is None:
        return _simulate_on_host(sim, run, settings)
    # In a rule of differentiation operations on known numbers would be staged.
    with jax.ensure_compile_time_eval():
        return _simulate_on_host(sim, run, settings)


def _simulate_on_host(sim: Simulation, run: Run, settings: dict[str, Any]) -> Outputs:
    write = sim.writer(run)  # a file that cannot be is told before the melt
    dynamics, fault, state = sim.dynamics, status.OK, sim.first_state()
    engine = neighbours.choose_engine(sim.engine, dynamics.capacity.lookahead)
    # An interruption saves the state from before the call under way, which then is not donated.
    donate = run.checkpoint is None
    if sim.needs_equilibration and not (
        run.checkpoint is not None and Path(run.checkpoint).exists()
    ):
        state, fault = _equilibrate(sim, state, engine, run.progress)
    state = with_own_buffers(sim.cooling_state(state))

    def advance(state: State, end: float) -> State:
        return _advance_growing(
            state, end, dynamics, dynamics.capacity, engine, run.progress, donate
        )

    try:
        if fault == status.OK:  # counts the energy in contacts
            state = advance(state, 0.0)
    except RunFailure as failure:
        fault, state = failure.fault, failure.state
    times = np.asarray(sim.inputs.times)
    given = sim.inputs._asdict() | settings | {"directions": sim.directions, "save": sim.save}
    scene = {} if run.checkpoint is None else describe_run(**given)
    state, records, fault = run_through_times(
        state,
        times,
        advance,
        sim.observe,
        shown=dynamics.observe,
        scene=scene,
        progress=run.progress,
        path=run.checkpoint,
        write=write,
        fault=fault,
    )
    arrays = {name: jnp.asarray(value) for name, value in records.items()}
    return sim.outputs(state, arrays, fault)


def _equilibrate(sim: Simulation, state: State, engine: str, progress: bool) -> tuple[State, int]:
    """The state after elastic motion, and what prepares it else, and the status."""
    elastic = sim.dynamics.elastic()
    settled = SETTLING_TIME / float(elastic.scene.collision_frequency)

    def advance(state: State, end: float) -> State:
        crowded = float(state.time) < settled
        capacity = sim.equilibration_capacity if crowded else elastic.capacity
        return _advance_growing(state, end, elastic, capacity, engine, progress)

    state, end = with_own_buffers(state), np.asarray([sim.equilibration_time])
    state, _, fault = run_through_times(
        state, end, advance, elastic.observe, progress=progress, label="melt"
    )
    steady = sim.dynamics.preparing
    if steady is None or fault != status.OK:
        return state, fault
    kept = {"capacity": steady.capacity, "engine": engine, "progress": progress}
    prepare = partial(_advance_growing, dynamics=steady, **kept)
    state = with_own_buffers(steady.with_kicks(state, sim.key))
    end = np.asarray([sim.prepared_time])
    state, _, fault = run_through_times(
        state, end, prepare, steady.observe, progress=progress, label="melt"
    )
    return state, fault


def _advance_growing(
    state: State,
    end: float,
    dynamics: AbstractDynamics,
    capacity: Capacity,
    engine: str,
    progress: bool,
    donate: bool = True,
) -> State:
    """Some stretches towards an end, in arrays that grow from a given capacity.

    With `donate` the state given may be deleted: after a failure the last good one takes its place.

    Raises:
        Failure: if something else goes wrong.
    """
    while True:
        room = _GROWN.get(capacity, capacity)
        roomy = dynamics if dynamics.capacity == room else dynamics.with_capacity(room)
        state, fault, needed = _run_segments(roomy, state, end, engine, progress, donate)
        if fault == status.OK:
            return state
        full = fault & (status.LIST_FULL.bit | status.CONTACTS_FULL.bit)
        if not full or max(needed) > MAX_PAIRS_EACH * len(state.position):
            raise RunFailure(fault, state)
        # That stretch is made again as a whole: a list made on the way has another order.
        _GROWN[capacity] = room.grown(needed)


def _run_segments(
    dynamics: AbstractDynamics,
    state: State,
    end: float,
    engine: str,
    progress: bool,
    donate: bool,
) -> tuple[State, int, list[int]]:
    """Several stretches in one compiled call, or one if the host finds the pairs.

    That one begins again from the state given if it fails, which then is never donated.
    """
    if engine == "sweep":
        until = np.asarray(end, state.time.dtype)
        state, fault, needed = block_until_ready(
            compiled_segments(dynamics, state, until, engine, progress, donate)
        )
        return state, int(fault), np.asarray(needed).tolist()
    now = block_until_ready(dynamics.run_segment(state, end, engine))
    fault = int(now.status)
    return (now.state if fault == status.OK else state), fault, np.asarray(now.needed).tolist()


def simulate_traced(sim: Simulation) -> Outputs:
    """Melt and cool; the records at the times of the inputs."""
    dynamics, inputs = sim.dynamics, sim.inputs
    engine = neighbours.choose_engine(sim.engine, dynamics.capacity.lookahead, traced=True)
    side = dynamics.scene.side
    # In a smaller box a new neighbour list is at once stale, and stretches would not end.
    fault = status.flag(status.BOX_TOO_SMALL, side < MIN_BOX)
    state, fault = sim.compiled_first_state(fault)
    if sim.needs_equilibration:
        melting = dynamics.elastic().with_capacity(sim.equilibration_capacity)
        state, fault, _ = run_segments(
            melting, state, sim.equilibration_time, engine, 0, None, fault
        )
        if (preparing := dynamics.preparing) is not None:
            state, until = preparing.with_kicks(state, sim.key), sim.prepared_time
            state, fault, _ = run_segments(preparing, state, until, engine, 0, None, fault)
    else:
        fault |= dynamics.check_start(state)
    # One stretch to t = 0 counts the energy in contacts.
    state = sim.cooling_state(state)
    state, fault, _ = run_segments(dynamics, state, jnp.zeros_like(state.time), engine, 1, 1, fault)

    def to(carry, end):
        state, fault, _ = run_segments(dynamics, carry[0], end, engine, 0, None, carry[1])
        records, bad = sim.observe(state), fault != status.OK
        return (state, fault), jax.tree.map(partial(_nan_if, bad), records)

    (state, fault), records = jax.lax.scan(to, (state, fault), inputs.times)
    return sim.outputs(state, records, fault)


def _nan_if(bad: Array, x: Array) -> Array:
    """Nan where a run has failed; numbers that have no nan stay as they are."""
    return jnp.where(bad, jnp.nan, x) if jnp.issubdtype(x.dtype, jnp.inexact) else x


Result = TypeVar("Result")

Devices = tuple[Any, ...]

MIN_SPHERES_PER_RUN = 8192
"""Spheres of a replica from which on replicas run in turn. Four of 1000, 2000 and 4096 take 1.4,
1.1 and .9 (hard), 1.4, 1.3 and 1.1 (soft) times as long so as in one array, on one core."""


def replica_devices(replicas: int, spheres: int = 0) -> Devices:
    """The CPU devices for several replicas; () where they stand in one array.

    That is so for less than `MANY` spheres (0 for DSMC) with one device, on an accelerator, and
    where the user has chosen a device by `jax.default_device`.
    """
    if replicas == 1 or jax.default_backend() != "cpu" or chosen_device() is not None:
        return ()
    found = tuple(jax.local_devices()[:replicas])
    return found if len(found) > 1 or spheres >= MIN_SPHERES_PER_RUN else ()


def run_replicas(
    one: Callable[[int, Run], Result], replicas: int, run: Run, on: Devices
) -> list[Result]:
    """The results of all replicas, replica k on device k modulo their number.

    An interruption from the keyboard ends all of them, each of which then saves its checkpoint, and
    so does an error of one.

    Args:
        one: a run of replica k alone, called in a thread where no JAX transformation is under way.
        replicas: their number.
        run: the options; replica k has the key ``fold_in(key, k)`` and files of its own.
        on: devices.

    Raises:
        ValueError: for the checkpoint of replicas that stood in one array.
    """
    if run.checkpoint is not None and Path(run.checkpoint).exists():
        raise ValueError(
            f"{run.checkpoint} was written by replicas in one array, as on one CPU device: resume "
            f"it so, or name another file; on {len(on)} CPU device(s) each replica here has its own"
        )
    x64, stop = jax.config.read("jax_enable_x64"), threading.Event()

    def some(first: int) -> list[Result]:
        with jax.enable_x64(x64), jax.default_device(on[first]), stopped_by(stop):
            try:
                return [
                    one(k, _replica_options(run, k, len(on)))
                    for k in range(first, replicas, len(on))
                ]
            except BaseException:
                stop.set()
                raise

    with ThreadPoolExecutor(len(on)) as pool:
        futures = [pool.submit(some, first) for first in range(len(on))]
        try:
            wait(futures)
        except BaseException:
            stop.set()
            raise
    errors = [error for future in futures if (error := future.exception()) is not None]
    for error in sorted(errors, key=lambda error: isinstance(error, KeyboardInterrupt)):
        raise error  # what a replica met, rather than that others were stopped then
    results = [future.result() for future in futures]
    return [results[k % len(on)][k // len(on)] for k in range(replicas)]


def replica_inputs(inputs: Inputs, k: int, num_particles: int, run: Run) -> Inputs:
    """The inputs of replica k alone, with the key of its run."""
    rows = slice(k * num_particles, (k + 1) * num_particles)
    return inputs._replace(start=jax.tree.map(lambda x: x[rows], inputs.start), key=run.key)


def join_outputs(runs: list[Outputs]) -> Outputs:
    """The results of runs with one replica each as those of one run."""

    position, velocity, spin = (
        jax.tree.map(partial(_along, 0), *(getattr(out, name) for out in runs))
        for name in ("position", "velocity", "spin")
    )
    records = join_records([out.records for out in runs])
    fault = np.bitwise_or.reduce([np.asarray(out.status) for out in runs])
    return Outputs(position, velocity, records, concrete(fault), spin)


def join_records(runs: list[dict[str, Array]]) -> dict[str, Array]:
    """The records of runs with one replica each, of shape (times, replicas, ...), as those of one
    run; derivatives along directions have replicas last."""
    return {
        name: _along(-1 if name.endswith(".along") else 1, *(records[name] for records in runs))
        for name in runs[0]
    }


def _along(axis: int, *parts: Array) -> Array:
    return concrete(np.concatenate([np.asarray(part) for part in parts], axis))


def _replica_options(run: Run, k: int, together: int) -> Run:
    """The options of a replica; the first of those that run together shows the progress."""
    key = jax.random.key(0) if run.key is None else run.key
    checkpoint = None if run.checkpoint is None else Path(f"{run.checkpoint}.{k}")
    trajectory = None if run.trajectory is None else file_of_replica(run.trajectory, k)
    return run._replace(
        key=jax.random.fold_in(key, k),
        progress=run.progress and k % together == 0,
        checkpoint=checkpoint,
        trajectory=trajectory,
    )
