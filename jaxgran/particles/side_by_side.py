"""Replicas as runs of their own, side by side on the CPU devices of a process, or in turn on one.

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

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array

from jaxgran.checks.tracing import concrete
from jaxgran.data.run import Run
from jaxgran.data.trajectory import file_of_replica
from jaxgran.particles.interruption import chosen_device, stopped_by
from jaxgran.tangents.rule import Inputs, Outputs

T = TypeVar("T")

Devices = tuple[Any, ...]

MANY = 8192
"""Spheres of a replica from which on replicas run in turn. Four of 1000, 2000 and 4096 take 1.4,
1.1 and .9 (hard), 1.4, 1.3 and 1.1 (soft) times as long so as in one array, on one core."""


def devices(replicas: int, spheres: int = 0) -> Devices:
    """The CPU devices for several replicas; () where they stand in one array.

    That is so for less than `MANY` spheres (0 for DSMC) with one device, on an accelerator, and
    where the user has chosen a device by `jax.default_device`.
    """
    if replicas == 1 or jax.default_backend() != "cpu" or chosen_device() is not None:
        return ()
    found = tuple(jax.local_devices()[:replicas])
    return found if len(found) > 1 or spheres >= MANY else ()


def side_by_side(one: Callable[[int, Run], T], replicas: int, run: Run, on: Devices) -> list[T]:
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

    def some(first: int) -> list[T]:
        with jax.enable_x64(x64), jax.default_device(on[first]), stopped_by(stop):
            try:
                return [one(k, _options(run, k, len(on))) for k in range(first, replicas, len(on))]
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


def inputs_of(inputs: Inputs, k: int, num_particles: int, run: Run) -> Inputs:
    """The inputs of replica k alone, with the key of its run."""
    rows = slice(k * num_particles, (k + 1) * num_particles)
    return inputs._replace(start=jax.tree.map(lambda x: x[rows], inputs.start), key=run.key)


def joined(runs: list[Outputs]) -> Outputs:
    """The results of runs with one replica each as those of one run."""

    position, velocity, spin = (
        jax.tree.map(partial(_along, 0), *(getattr(out, name) for out in runs))
        for name in ("position", "velocity", "spin")
    )
    records = joined_records([out.records for out in runs])
    fault = np.bitwise_or.reduce([np.asarray(out.status) for out in runs])
    return Outputs(position, velocity, records, concrete(fault), spin)


def joined_records(runs: list[dict[str, Array]]) -> dict[str, Array]:
    """The records of runs with one replica each, of shape (times, replicas, ...), as those of one
    run; derivatives along directions have replicas last."""
    return {
        name: _along(-1 if name.endswith(".along") else 1, *(records[name] for records in runs))
        for name in runs[0]
    }


def _along(axis: int, *parts: Array) -> Array:
    return concrete(np.concatenate([np.asarray(part) for part in parts], axis))


def _options(run: Run, k: int, together: int) -> Run:
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
