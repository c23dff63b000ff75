"""The host driver of particle runs: progress, checkpoints, interruption, arrays that grow.

For runs whose numbers are all known; the same run as a pure function is in `pure`.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxgran.checks import status
from jaxgran.checks.tracing import concrete
from jaxgran.data import checkpoint
from jaxgran.data.description import described
from jaxgran.data.run import Run
from jaxgran.particles import neighbours, programs
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import MOST_IDLE, AbstractDynamics
from jaxgran.particles.interruption import waited_for
from jaxgran.particles.simulation import SETTLED, Simulation
from jaxgran.particles.state import State, empty_records, owned, spoil
from jaxgran.tangents.rule import Outputs

CHECKPOINT_SECONDS = 60.0
"""A checkpoint is written this often, and when the run is interrupted."""

MOST_PAIRS = 100
"""Rows per particle beyond which an array does not grow any more."""


class Failure(Exception):
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


def follow(
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
        except Failure as failure:
            fault, state = failure.fault, failure.state or state
            spoil(records, done)
    return state, records, fault


def _raise_if(fault: int) -> None:
    if fault != status.OK:
        raise Failure(fault)


def _record(records: dict[str, np.ndarray], done: int, observed: dict[str, jax.Array]) -> None:
    for name, value in observed.items():
        records[name][done] = value


def _idle(idle: int, before: float, state: _Timed) -> int:
    """How often in a row the time has not advanced; Failure if too often."""
    idle = idle + 1 if float(state.time) <= before else 0
    if idle >= MOST_IDLE:
        raise Failure(status.STALLED.bit)
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


def drive(sim: Simulation, run: Run, settings: dict[str, Any]) -> Outputs:
    """Melt and cool, enlarging arrays where they are too short.

    Args:
        sim: the run, with known numbers.
        run: its options.
        settings: what else fixes the result, by name, for the checkpoint's description.
    """
    if sim.directions is None:
        return _drive(sim, run, settings)
    # In a rule of differentiation operations on known numbers would be staged.
    with jax.ensure_compile_time_eval():
        return _drive(sim, run, settings)


def _drive(sim: Simulation, run: Run, settings: dict[str, Any]) -> Outputs:
    write = sim.writer(run)  # a file that cannot be is told before the melt
    dynamics, fault, state = sim.dynamics, status.OK, sim.first_state()
    engine = neighbours.engine(sim.engine, dynamics.capacity.lookahead)
    # An interruption saves the state from before the call under way, which then is not donated.
    donate = run.checkpoint is None
    if sim.melts and not (run.checkpoint is not None and Path(run.checkpoint).exists()):
        state, fault = _melt(sim, state, engine, run.progress)
    state = owned(sim.cooling_state(state))

    def advance(state: State, end: float) -> State:
        return _advance(state, end, dynamics, dynamics.capacity, engine, run.progress, donate)

    try:
        if fault == status.OK:  # counts the energy in contacts
            state = advance(state, 0.0)
    except Failure as failure:
        fault, state = failure.fault, failure.state
    times = np.asarray(sim.inputs.times)
    given = sim.inputs._asdict() | settings | {"directions": sim.directions, "save": sim.save}
    scene = {} if run.checkpoint is None else described(**given)
    state, records, fault = follow(
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


def _melt(sim: Simulation, state: State, engine: str, progress: bool) -> tuple[State, int]:
    """The state after elastic motion, and what prepares it else, and the status."""
    elastic = sim.dynamics.elastic()
    settled = SETTLED / float(elastic.scene.collision_frequency)

    def advance(state: State, end: float) -> State:
        crowded = float(state.time) < settled
        capacity = sim.melt_capacity if crowded else elastic.capacity
        return _advance(state, end, elastic, capacity, engine, progress)

    state, end = owned(state), np.asarray([sim.melt_time])
    state, _, fault = follow(state, end, advance, elastic.observe, progress=progress, label="melt")
    steady = sim.dynamics.preparing
    if steady is None or fault != status.OK:
        return state, fault
    kept = {"capacity": steady.capacity, "engine": engine, "progress": progress}
    prepare = partial(_advance, dynamics=steady, **kept)
    state = owned(steady.with_kicks(state, sim.key))
    end = np.asarray([sim.prepared_time])
    state, _, fault = follow(state, end, prepare, steady.observe, progress=progress, label="melt")
    return state, fault


def _advance(
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
        state, fault, needed = _some_stretches(roomy, state, end, engine, progress, donate)
        if fault == status.OK:
            return state
        full = fault & (status.LIST_FULL.bit | status.CONTACTS_FULL.bit)
        if not full or max(needed) > MOST_PAIRS * len(state.position):
            raise Failure(fault, state)
        # That stretch is made again as a whole: a list made on the way has another order.
        _GROWN[capacity] = room.grown(needed)


def _some_stretches(
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
        state, fault, needed = waited_for(
            programs.some_stretches(dynamics, state, until, engine, progress, donate)
        )
        return state, int(fault), np.asarray(needed).tolist()
    now = waited_for(dynamics.stretch(state, end, engine))
    fault = int(now.status)
    return (now.state if fault == status.OK else state), fault, np.asarray(now.needed).tolist()
