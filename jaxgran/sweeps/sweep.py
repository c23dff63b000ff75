"""Cool many gases: over the devices of one or several processes, kept in a store."""

import os
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import ArrayLike, PRNGKeyArray
from tqdm import tqdm

from jaxgran.checks.validation import checked_times, no_type_check, whole_number
from jaxgran.data.curve import CoolingCurve, Particles
from jaxgran.data.description import described
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.spheres import AbstractSpheres
from jaxgran.scene.gas import Gas
from jaxgran.sweeps import store as stores
from jaxgran.sweeps.batch import Batch, batched, first_valid, refusal
from jaxgran.sweeps.program import Program, Records, curves, failed, joined, records_of

CHUNKS = {False: 1024, True: 16}
"""Members of a chunk of a deterministic and of a stochastic model."""

LOOK_SECONDS = 0.3
"""A process that has ended its chunks looks this often whether the others have."""


@no_type_check
def sweep(
    gases: Gas,
    times: ArrayLike | Sequence[float],
    *,
    model: AbstractModel | None = None,
    key: PRNGKeyArray | None = None,
    save: Callable[[Particles], Any] | Literal["particles"] | None = None,
    store: str | Path | None = None,
    chunk: int | None = None,
    progress: bool = True,
) -> CoolingCurve:
    """How each of many gases cools: over all devices, kept in a store while it goes.

    The members of a chunk are shared out by `jax.shard_map` over the devices of a process, and the
    chunks over the processes of a `jax.distributed` job: chunk c belongs to process c modulo their
    number. Members do not depend on each other, so that processes exchange nothing but the store,
    and none waits for another before its own chunks are done. Then each waits until all are, and
    returns them all. If a process dies, JAX ends the others after ``heartbeat_timeout_seconds`` of
    `jax.distributed.initialize`; the same call, of as many processes as you like, goes on with the
    chunks that are missing.

    A member that fails has nan and a ``status``, and does not end the others. One that the model
    does not take is named in a warning.

    Args:
        gases: a gas whose floats, some or all, have a leading axis of members, as
            ``jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values)`` returns it. A list
            of floats (coefficients of a series, sides of a box) has it before its own axis.
        times: t, s, increasing and >= 0, shape (times,).
        model: a `jaxgran.AbstractModel`, by default `jaxgran.KineticTheory()`. Arrays of particle
            models are made for the members that need the longest, unless `sized_for` was called.
        key: of the random numbers, from which each member has its own by
            `jax.random.fold_in`; or a row of keys, one for each member. By default
            `jax.random.key(0)`. A member's key does not depend on the number of members.
        save: of a model with particles: a function of the particles of one replica of a member, or
            "particles", as in `jaxgran.cool`. Its values, with a first axis of members, are
            ``curves.saved``, ``curves.saved_error`` and ``curves.replicas.saved``; in the store
            they are arrays named by their places, as "saved.S.0", "saved_error.S.0" and
            "saved_of_replicas.S.0", with dimensions member, time and "saved.S.0.axis0" and so on
            (of particles: replica, particle, axis). Whole numbers and booleans of a member that is
            not taken are 0.
        store: a folder, made as a Zarr group that `xarray.open_zarr` reads, with dimensions member
            and time, swept floats and units as labels; chunks are written as they end. If it is the
            store of the same sweep, only what is missing is computed. Needs the extra `sweep`, and
            a file system that all processes see. None keeps the results in memory only.
        chunk: members that are computed and written together, >= 1; by default 1024, of a
            stochastic model 16, or that of the store.
        progress: show a progress bar on a terminal.

    Returns:
        The curves of all members in one, as `jax.vmap` of `jaxgran.cool` returns them: T has shape
        (members, times). Without particles.

    Raises:
        ValueError: for a batch whose floats have leading axes of different lengths, floats outside
            their range in all members, a model that takes none of them, several processes without a
            store, something to save that is no function of particles or has no names, or a store
            of another sweep, of another version of jaxgran, or half written;
            nothing is overwritten.
        OSError: if the store cannot be written.

    This docstring is long because it says what becomes of the chunks of every process.

    >>> gases = jax.vmap(lambda a: gas.replace(dissipative_constant=a))(jnp.array([1e-6, 3e-6]))
    >>> jaxgran.sweep(gases, times, progress=False).temperature.shape
    (2, 4)
    """
    times, batch = checked_times(times), batched(gases, key)
    model = checks.checked_model(KineticTheory() if model is None else model)
    model.check_save(save)
    chunk = _checked_chunk(chunk, store, model, len(batch))
    valid = first_valid(batch, model)
    program = Program.of(model, times, chunk, _to_hold(batch, model), save)
    like = None
    if store is not None or save is not None:
        like = program.like(batch.member(valid), batch.keys[0])

    def computed(number: int) -> Records:
        members = np.arange(number * chunk, min((number + 1) * chunk, len(batch)))
        return _computed(program, model, batch, members, valid)

    if store is None:
        if jax.process_count() > 1:
            raise ValueError(
                f"the {jax.process_count()} processes of a job share a sweep by its store: give "
                "store, a folder that all of them see"
            )
        chunks = [computed(number) for number in _bar(range(-(-len(batch) // chunk)), progress)]
        return curves(joined(chunks), times, like)
    asked = {} if save is None else {"save": save}
    description = described(
        gases=batch.gases, keys=batch.keys, times=times, model=model, chunk=chunk, **asked
    )
    shapes, whole = jax.eval_shape(records_of, like), save == "particles"
    kept = stores.opened(store, batch, np.asarray(times), shapes, description, chunk, whole)
    _finish(kept, computed, progress)
    return curves(kept.read_all(), times, like)


def _finish(kept: stores.Store, computed: Callable[[int], Records], progress: bool) -> None:
    """Write the chunks of this process that are missing, and wait for those of the others."""
    kept.check()
    finished = kept.finished()
    own = range(jax.process_index(), len(finished), jax.process_count())
    for number in _bar([number for number in own if not finished[number]], progress):
        kept.write(number, computed(number))
    while not np.all(kept.finished()):  # JAX ends this process if another one dies
        time.sleep(LOOK_SECONDS)


def _computed(
    program: Program, model: AbstractModel, batch: Batch, members: np.ndarray, valid: int
) -> Records:
    """The records of some members; those that the model does not take are nan."""
    refused = {int(i): why for i in members if (why := refusal(batch, int(i), model)) is not None}
    if refused:
        first = next(iter(refused))
        warnings.warn(
            f"{len(refused)} of members {members[0]} to {members[-1]} cannot be simulated and are "
            f"nan, the first of them {first}: {refused[first]}",
            stacklevel=5,
        )
    out = np.isin(members, list(refused))
    records = program.run(*batch.taken(np.where(out, valid, members)))
    return failed(records, out) if refused else records


def _checked_chunk(chunk: Any, store: Any, model: AbstractModel, number: int) -> int:
    """Members of a chunk: as given, of an existing store, or the default."""
    if not isinstance(store, str | os.PathLike | None):
        raise ValueError(f"store must be a path, got {store!r:.60}")
    if chunk is not None:
        return min(whole_number("chunk", chunk, 1), number)
    if store is not None and (stored := stores.stored_chunk(Path(store))) is not None:
        return stored
    return min(CHUNKS[model.stochastic], -(-number // jax.process_count()))


def _to_hold(batch: Batch, model: AbstractModel) -> list[Gas]:
    """The gases for which a model must make its arrays."""
    if not isinstance(model, AbstractSpheres) or model.plan is not None:
        return []
    taken = [i for i in range(len(batch)) if refusal(batch, i, model) is None]
    return [batch.member(i) for i in taken]


def _bar(numbers: Sequence[int], progress: bool) -> Iterable[int]:
    return tqdm(numbers, desc="chunks", delay=3, disable=None if progress else True)
