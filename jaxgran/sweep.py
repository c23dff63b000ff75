"""Sweeps: the cooling curves of many gases, over devices and processes, with an optional store.

The members of a sweep are gases that share a structure and differ in floats and keys (`Batch`).
Each process runs chunks of members in one compiled program on its devices (`Program`). A Zarr group
on disk holds finished chunks, so that an interrupted sweep can be resumed (`Store`).
"""

import dataclasses
import hashlib
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, ArrayLike, Float, Key, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils import status
from jaxgran._utils.validation import checked_int, checked_times, no_type_check
from jaxgran.data.checkpoint import describe_run, differences
from jaxgran.data.curve import (
    OF_REPLICAS,
    QUANTITY_UNITS,
    REPLICA,
    TIME,
    CoolingCurve,
    Particles,
    import_extra,
    is_saved,
    saved_arrays,
    saved_dimensions,
    saved_unit,
    with_saved_arrays,
)
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel
from jaxgran.models.cool import cool
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.spheres import AbstractSpheres, Plan
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.run import block_until_ready
from jaxgran.scene.gas import FLOAT_UNITS, Gas

Keys = Key[Array, "members"]

Records = dict[str, Any]
"""Arrays by name, with a first axis of members."""

Save = Callable[[Particles], Any] | Literal["particles"] | None
"""The option `save` of `jaxgran.cool`."""

DEFAULT_CHUNK = {False: 1024, True: 16}
"""Members per chunk, by whether the model is stochastic."""

POLL_SECONDS = 0.3
"""Interval at which a process that has finished its chunks checks those of the others."""

DEVICE_AXIS = "device"

SPARE_FACTORS = (2.0, 4.0, 8.0)
"""Ratios of capacity to expected need, tried in turn: a chunk in which a member overflows its
arrays is run again with the next ratio."""

OVERFLOW_BITS = status.LIST_FULL.bit | status.CONTACTS_FULL.bit

STATUS = "status"
MEMBER = "member"
CHUNK, FINISHED = "chunk", "finished"

WALL_SIDE = "wall_side"
"""The only float that may be one number or d numbers."""

CURVE_FLOATS = ("temperature", "rotational_temperature")
"""Floats of a gas that have the name of a quantity of a curve."""

INITIAL_PREFIX = "initial_"
"""Prefix that distinguishes `CURVE_FLOATS` from the quantities of a curve in a store."""

FORMAT_VERSION = 1
MAX_DIFFERENCES = 4
"""Number of differences listed in an error message."""


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
    """Compute the cooling curves of many gases on all devices, and optionally store them on disk.

    `jax.shard_map` distributes the members of a chunk over the devices of a process. The chunks are
    distributed over the processes of a `jax.distributed` job: process p computes the chunks c with
    c = p modulo the number of processes. Members are independent, so the processes share nothing
    but the store. When a process has finished its own chunks, it waits for all others and returns
    the complete result. If a process dies, JAX ends the others after
    ``heartbeat_timeout_seconds`` of `jax.distributed.initialize`. The same call then computes the
    missing chunks, with any number of processes.

    A member that fails has the values nan and a nonzero ``status``; the other members continue.
    Members that the model does not support are reported in a warning.

    Args:
        gases: a gas in which some or all floats have a leading axis of members, as returned by
            ``jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values)``. A list of floats
            (coefficients of a series, sides of a box) has the axis of members first.
        times: t, s, increasing and >= 0, shape (times,).
        model: a `jaxgran.AbstractModel`, by default `jaxgran.KineticTheory()`. Arrays of particle
            models are sized for the member with the largest need, unless `sized_for` was called.
        key: the random key, from which `jax.random.fold_in` derives one key for each member; or an
            array with one key for each member. By default `jax.random.key(0)`. The key of a member
            does not depend on the number of members.
        save: for models with particles: a function of the particles of one replica of a member, or
            "particles", as in `jaxgran.cool`. Its values, with a first axis of members, are
            ``curves.saved``, ``curves.saved_error`` and ``curves.replicas.saved``. In the store
            they are arrays named by their path, such as "saved.S.0", "saved_error.S.0" and
            "saved_of_replicas.S.0", with the dimensions member, time, "saved.S.0.axis0" and so on
            (for particles: replica, particle, axis). Integers and booleans of an unsupported member
            are 0.
        store: path of a Zarr group that `xarray.open_zarr` reads, with the dimensions member and
            time, and with swept floats and units as labels. Each chunk is written when it ends. If
            the group is the store of the same sweep, only missing chunks are computed. Needs the
            extra `sweep`, and a file system that all processes share. None keeps the results in
            memory only.
        chunk: number of members computed and written together, >= 1; by default that of an existing
            store, otherwise 16 for a stochastic model and 1024 for others.
        progress: show a progress bar on a terminal.

    Returns:
        The curves of all members in one object, as `jax.vmap` of `jaxgran.cool` returns them: T has
        shape (members, times). Without particles.

    Raises:
        ValueError: if the leading axes of the floats have different lengths, if floats of all
            members are outside their range, if the model supports no member, for several processes
            without a store, if `save` is not a function of particles or returns values without
            names, or if the store belongs to another sweep or another version of jaxgran, or is
            incomplete. Nothing is overwritten.
        OSError: if the store cannot be written.

    >>> gases = jax.vmap(lambda a: gas.replace(dissipative_constant=a))(jnp.array([1e-6, 3e-6]))
    >>> jaxgran.sweep(gases, times, progress=False).temperature.shape
    (2, 4)
    """
    times, batch = checked_times(times), make_batch(gases, key)
    model = checks.checked_model(KineticTheory() if model is None else model)
    model.check_save(save)
    chunk = _chunk_size(chunk, store, model, len(batch))
    valid = first_supported_member(batch, model)
    program = Program.create(model, times, chunk, _supported_gases(batch, model), save)
    structure = None
    if store is not None or save is not None:
        structure = program.curve_structure(batch.member(valid), batch.keys[0])

    def compute(number: int) -> Records:
        members = np.arange(number * chunk, min((number + 1) * chunk, len(batch)))
        return _compute_chunk(program, model, batch, members, valid)

    if store is None:
        if jax.process_count() > 1:
            raise ValueError(
                f"a sweep over {jax.process_count()} processes needs a store. Give store, a folder "
                "that all processes can access."
            )
        numbers = range(-(-len(batch) // chunk))
        chunks = [compute(number) for number in _progress_bar(numbers, progress)]
        return stack_curves(join_chunks(chunks), times, structure)
    saved = {} if save is None else {"save": save}
    description = describe_run(
        gases=batch.gases, keys=batch.keys, times=times, model=model, chunk=chunk, **saved
    )
    shapes, saves_particles = jax.eval_shape(records_of, structure), save == "particles"
    opened = open_store(
        store, batch, np.asarray(times), shapes, description, chunk, saves_particles
    )
    _compute_missing_chunks(opened, compute, progress)
    return stack_curves(opened.read_all(), times, structure)


def _chunk_size(chunk: Any, store: Any, model: AbstractModel, num_members: int) -> int:
    """Return the members per chunk: as given, of an existing store, or the default."""
    if not isinstance(store, str | os.PathLike | None):
        raise ValueError(f"store must be a path, got {store!r:.60}")
    if chunk is not None:
        return min(checked_int("chunk", chunk, 1), num_members)
    if store is not None and (stored := stored_chunk(Path(store))) is not None:
        return stored
    return min(DEFAULT_CHUNK[model.stochastic], -(-num_members // jax.process_count()))


def _progress_bar(numbers: Sequence[int], progress: bool) -> Iterable[int]:
    return tqdm(numbers, desc="chunks", delay=3, disable=None if progress else True)


class SweptFloat(NamedTuple):
    """Values of a float that was given with an axis of members.

    Attributes:
        values: with a first axis of members, or one value that all members share.
        per_member: whether there is an axis of members.
    """

    values: np.ndarray
    per_member: bool


class Batch(NamedTuple):
    """The members of a sweep.

    Attributes:
        gases: a `Gas` whose leaves have a first axis of members.
        keys: one for each member.
        swept_names: names of the floats that were given with an axis of members.
    """

    gases: Gas
    keys: Keys
    swept_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.keys)

    def member(self, i: int) -> Gas:
        """Return one gas, with all of its floats checked.

        Raises:
            ValueError: for a float outside its range.
        """
        gas = jax.tree.map(lambda x: x[i], self.gases)
        return gas.replace(**{name: gas.value(name) for name in gas.domains})

    def swept_floats(self) -> dict[str, SweptFloat]:
        """Return the swept floats by name, with "initial_" before `CURVE_FLOATS`."""
        arrays = {
            f"{INITIAL_PREFIX}{name}" if name in CURVE_FLOATS else name: np.asarray(
                self.gases.value(name)
            )
            for name in self.swept_names
        }
        return {
            name: SweptFloat(values[0], False)
            if np.all(values == values[:1])
            else SweptFloat(values, True)
            for name, values in arrays.items()
        }

    def select(self, rows: np.ndarray) -> tuple[Gas, Keys]:
        """Return the gases and keys of some members."""
        return jax.tree.map(lambda x: x[rows], (self.gases, self.keys))


def make_batch(gases: Any, key: Any) -> Batch:
    """Make the members from user input: every leaf gets a leading axis of the same length.

    Raises:
        ValueError: for anything but a gas, for leading axes of different lengths, and if nothing
            has an axis of members.
    """
    if not isinstance(gases, Gas):
        raise ValueError(
            f"gases must be a jaxgran.Gas with batched floats, got {_describe_type(gases)}"
        )
    keys = _checked_keys(key)
    lengths = {} if keys.ndim == 0 else {"key": len(keys)}
    swept = {name: np.shape(gases.value(name))[0] for name in _swept_names(gases)}
    lengths |= swept
    if not lengths:
        raise ValueError(
            "no float of gases has a leading axis, and there is only one key. Build gases by "
            "jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values), give an array of "
            "keys, or use jaxgran.cool for one gas."
        )
    if len(set(lengths.values())) > 1 or 0 in lengths.values():
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(
            f"the leading axes of a sweep must have one length, at least 1, got {listed}. Give "
            "every swept float one value for each member."
        )
    number = next(iter(lengths.values()))
    members = jnp.arange(number)
    if keys.ndim == 0:
        keys = jax.vmap(lambda i: jax.random.fold_in(keys, i))(members)
    same = {name: gases.value(name) for name in gases.domains if name not in swept}
    repeated = {name: jnp.broadcast_to(x, (number, *x.shape)) for name, x in same.items()}
    gases = gases.replace(**repeated)
    return Batch(gases, keys, tuple(swept))


def _describe_type(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__}: stack the floats of its gases into one Gas"
    if isinstance(value, dict):
        return "a dict: use jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values)"
    return type(value).__name__


def _checked_keys(key: Any) -> Key[Array, "..."]:
    """Return one typed key, or an array of them with one axis."""
    if key is None:
        return jax.random.key(0)
    if isinstance(key, jax.Array):
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim <= 1:
            return key
        if key.dtype == jnp.uint32 and key.ndim in (1, 2):
            return jax.random.wrap_key_data(key)
    raise ValueError(
        f"key must be a key such as jax.random.key(5), or an array of keys, got {key!r:.60}"
    )


def _swept_names(gases: Gas) -> list[str]:
    """Return the names of the floats that have an axis of members.

    Raises:
        ValueError: for floats with further axes, and for wall sides that may belong to one box or
            to several cubes.
    """
    ndims = {name: np.ndim(gases.value(name)) for name in gases.domains}
    single = {name: int(name in gases.law.lists) for name in ndims if name != WALL_SIDE}
    plain = [name for name in single if ndims[name] > single[name]]
    for name, ndim in ndims.items():
        if ndim - single.get(name, 1) > 1:
            raise ValueError(
                f"{name} has shape {np.shape(gases.value(name))}, but a sweep has only one axis of "
                "members. Flatten the axes, as in jnp.meshgrid(...)[0].ravel()."
            )
    if WALL_SIDE not in ndims or ndims[WALL_SIDE] == 0:
        return plain
    length = np.shape(gases.value(WALL_SIDE))[0]
    if ndims[WALL_SIDE] == 2 or length != gases.dimension or len(plain) == len(single):
        return [*plain, WALL_SIDE]
    if not plain:
        return plain  # one box of d sides
    raise ValueError(
        f"{WALL_SIDE} of shape {np.shape(gases.value(WALL_SIDE))} is ambiguous: the sides of one "
        f"box or those of {length} cubes. Give every float of gases an axis of members, as "
        "jax.vmap returns them."
    )


def first_supported_member(batch: Batch, model: AbstractModel) -> int:
    """Return the index of the first member that a model supports.

    Raises:
        ValueError: if the model supports none; the message says why it rejects the first one.
    """
    first = None
    for i in range(len(batch)):
        reason = reason_unsupported(batch, i, model)
        if reason is None:
            return i
        first = first or reason
    assert first is not None
    raise ValueError(f"{type(model).__name__} supports no member of this sweep; member 0: {first}")


def reason_unsupported(batch: Batch, i: int, model: AbstractModel) -> str | None:
    """Return why a model does not support a member; None if it does."""
    try:
        model.check_scene(batch.member(i))
    except ValueError as error:
        return str(error)
    return None


def _supported_gases(batch: Batch, model: AbstractModel) -> list[Gas]:
    """Return the gases for which the arrays of a model must be sized."""
    if not isinstance(model, AbstractSpheres) or model.plan is not None:
        return []
    supported = [i for i in range(len(batch)) if reason_unsupported(batch, i, model) is None]
    return [batch.member(i) for i in supported]


class Program(NamedTuple):
    """A model, and the devices of this process on which members run.

    Attributes:
        models: the model with arrays of several lengths, the shortest first.
        times: t, s.
        mesh: the devices.
        members_per_device: in one call.
        save: the option `save` of `jaxgran.cool`.
    """

    models: tuple[AbstractModel, ...]
    times: Float[Array, "times"]
    mesh: Mesh
    members_per_device: int
    save: Save = None

    @classmethod
    def create(
        cls,
        model: AbstractModel,
        times: Float[Array, "times"],
        chunk: int,
        members: Sequence[Gas],
        save: Save = None,
    ) -> "Program":
        """Make a program for all devices of this process, which share a chunk.

        Args:
            model: as given by the user.
            times: t, s.
            chunk: largest number of members in one call.
            members: the gases for which arrays must be long enough.
            save: the option `save` of `jaxgran.cool`.
        """
        devices = np.array(jax.local_devices()[:chunk])
        models = (model,)
        if isinstance(model, AbstractSpheres) and model.plan is None:
            models = tuple(_sized_for_all(model, members, spare) for spare in SPARE_FACTORS)
        return cls(models, times, Mesh(devices, (DEVICE_AXIS,)), -(-chunk // len(devices)), save)

    def curve_structure(self, gas: Gas, key: PRNGKeyArray) -> CoolingCurve:
        """Return the curve of a member with types and shapes in place of arrays.

        Raises:
            ValueError: if a saved value has no name.
        """
        cool_member = partial(cool, times=self.times, model=self.models[0], save=self.save)
        structure = jax.eval_shape(lambda gas, key: cool_member(gas, key=key), gas, key)
        saved_arrays(structure)
        return structure

    def run(self, gases: Gas, keys: Keys) -> Records:
        """Compute the records of at most a chunk of members.

        The last member is repeated until every device has the same number. If members of a particle
        model overflow their arrays, the chunk is run again with longer arrays.
        """
        number = len(keys)
        rows = np.minimum(np.arange(self.members_per_device * self.mesh.size), number - 1)
        gases, keys = jax.tree.map(lambda x: x[rows], (gases, keys))
        records: Records = {}
        for model in self.models:
            sequential = _prefers_sequential(model)
            out = _run_on_devices(model, gases, keys, self.times, self.mesh, sequential, self.save)
            records = {name: np.asarray(x)[:number] for name, x in block_until_ready(out).items()}
            if not np.any(records[STATUS] & OVERFLOW_BITS):
                break
        return records


def _prefers_sequential(model: AbstractModel) -> bool:
    """Return whether a device should run its members one after the other.

    On a CPU this is faster for a model with many particles: under `jax.vmap` its loops would run
    for all members until the slowest one ends. Also, the numbers of a member do not depend on the
    others.
    """
    return model.stochastic and jax.default_backend() == "cpu"


@eqx.filter_jit
def _run_on_devices(
    model: AbstractModel,
    gases: Gas,
    keys: Keys,
    times: Float[Array, "times"],
    mesh: Mesh,
    sequential: bool,
    save: Save,
) -> Records:
    arrays, rest = eqx.partition((model, times), eqx.is_array)

    def run_members(arrays, gases, keys):
        model, times = eqx.combine(arrays, rest)

        def run_member(gas, key):
            return records_of(cool(gas, times, model=model, key=key, save=save))

        if sequential:
            return jax.lax.map(lambda member: run_member(*member), (gases, keys))
        return jax.vmap(run_member)(gases, keys)

    members, same = PartitionSpec(DEVICE_AXIS), PartitionSpec()
    # With check_vma, shard_map would require the loops of a member to declare an axis of devices.
    sharded = jax.shard_map(
        run_members,
        mesh=mesh,
        in_specs=(same, members, members),
        out_specs=members,
        check_vma=False,
    )
    return sharded(arrays, gases, keys)


def _sized_for_all(model: AbstractSpheres, gases: Sequence[Gas], spare: float) -> AbstractSpheres:
    """Return a model with arrays long enough, and blocks of steps short enough, for all gases."""
    plans = [plan for gas in gases if (plan := model.sized_for(gas, spare).plan) is not None]
    pace = type(plans[0].pace)(*map(min, zip(*(plan.pace for plan in plans), strict=True)))
    run, equilibration = (
        Capacity(*map(max, zip(*capacities, strict=True)))
        for capacities in zip(*((p.capacity, p.equilibration_capacity) for p in plans), strict=True)
    )
    return dataclasses.replace(model, plan=Plan(plans[0].replicas, pace, run, equilibration))


def _compute_chunk(
    program: Program, model: AbstractModel, batch: Batch, members: np.ndarray, valid: int
) -> Records:
    """Compute the records of some members; a valid member stands in for unsupported ones."""
    reasons = {
        int(i): why
        for i in members
        if (why := reason_unsupported(batch, int(i), model)) is not None
    }
    if reasons:
        first = next(iter(reasons))
        warnings.warn(
            f"{len(reasons)} of members {members[0]} to {members[-1]} cannot be simulated and are "
            f"nan; the first of them is {first}: {reasons[first]}",
            stacklevel=5,
        )
    unsupported = np.isin(members, list(reasons))
    records = program.run(*batch.select(np.where(unsupported, valid, members)))
    return mark_unsupported(records, unsupported) if reasons else records


def records_of(curve: CoolingCurve) -> Records:
    """Return the records of one member, without the axis of members.

    They are its curve, the curves of its replicas, saved values and the status.
    """
    known = {name: getattr(curve, name) for name in QUANTITY_UNITS if name != "times"}
    if curve.replicas is not None:
        each = {name: getattr(curve.replicas, name) for name in QUANTITY_UNITS if name != "times"}
        known |= {f"{name}{OF_REPLICAS}": values for name, values in each.items()}
    present = {name: values for name, values in known.items() if values is not None}
    fault = status.OK if curve.status is None else curve.status
    return present | saved_arrays(curve) | {STATUS: jnp.asarray(fault, jnp.int32)}


def mark_unsupported(records: Records, rows: np.ndarray) -> Records:
    """Return the records with some members nan (integers: 0) and their status unsupported."""
    changed = {}
    for name, values in records.items():
        values = np.array(values)
        values[rows] = status.UNSUPPORTED.bit if name == STATUS else missing_value(values.dtype)
        changed[name] = values
    return changed


def missing_value(dtype: Any) -> Any:
    """Return nan for a type that has it, otherwise 0."""
    return np.nan if np.issubdtype(dtype, np.inexact) else np.zeros((), dtype)[()]


def join_chunks(chunks: Sequence[Records]) -> Records:
    """Concatenate the records of several chunks."""
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


def stack_curves(records: Records, times: Array, structure: CoolingCurve | None) -> CoolingCurve:
    """Return the curves of all members in one object, as `jax.vmap` does, without particles.

    Args:
        records: of all members.
        times: t, s.
        structure: of `Program.curve_structure`, if something was saved.
    """

    def curve_of(records: Records) -> CoolingCurve:
        saved = {k: x for k, x in records.items() if is_saved(k)}
        records = {k: x for k, x in records.items() if k not in saved}
        plain = {k: x for k, x in records.items() if not k.endswith(OF_REPLICAS)}
        names = [k.removesuffix(OF_REPLICAS) for k in records.keys() - plain.keys()]
        each = {name: records[f"{name}{OF_REPLICAS}"] for name in names}
        replicas = CoolingCurve(times=times, **each) if each else None
        curve = CoolingCurve(times=times, **plain, replicas=replicas)
        return curve if structure is None else with_saved_arrays(curve, structure, saved)

    return jax.vmap(curve_of)({name: jnp.asarray(values) for name, values in records.items()})


class Store(NamedTuple):
    """An open store: a Zarr group with an array for each record, in chunks of members.

    The array `finished` holds a digest of the values of each chunk, which is written after the
    values. A chunk that was being written when a process died therefore counts as missing.

    Attributes:
        path: of the group.
        group: the `zarr.Group`.
        names: of the records, sorted.
        num_members: of the sweep.
        chunk: members per chunk.
    """

    path: Path
    group: Any
    names: tuple[str, ...]
    num_members: int
    chunk: int

    def rows(self, number: int) -> slice:
        """Return the members of a chunk."""
        return slice(number * self.chunk, min((number + 1) * self.chunk, self.num_members))

    def finished(self) -> np.ndarray:
        """Return for each chunk whether any process has written it.

        Raises:
            ValueError: if the array `finished` cannot be read.
        """
        return _read_values(self.path, self.group[FINISHED]) != 0

    def write(self, number: int, records: Records) -> None:
        """Write the values of a chunk, then its digest."""
        for name in self.names:
            self.group[name][self.rows(number)] = records[name]
        self.group[FINISHED][number] = _digest(records)

    def check(self) -> None:
        """Check every finished chunk.

        Raises:
            ValueError: for the first chunk whose values do not match its digest.
        """
        for number in np.flatnonzero(self.finished()):
            self.read(int(number))

    def read(self, number: int) -> Records:
        """Return the records of a finished chunk.

        Raises:
            ValueError: if the values do not match the digest.
        """
        rows = self.rows(number)
        try:
            records = {name: np.asarray(self.group[name][rows]) for name in self.names}
            intact = _digest(records) == self.group[FINISHED][number]
        except Exception as error:  # a codec raises any type for a truncated file
            raise self._damaged_chunk(number, f" ({error})") from None
        if not intact:
            raise self._damaged_chunk(number)
        return records

    def read_all(self) -> Records:
        """Return the records of all members, once all chunks are finished."""
        return join_chunks([self.read(number) for number in range(len(self.finished()))])

    def _damaged_chunk(self, number: int, why: str = "") -> ValueError:
        rows = self.rows(number)
        return ValueError(
            f"{self.path}: chunk {number} (members {rows.start} to {rows.stop - 1}) is incomplete "
            f"or was changed{why}. Copy the store again, or name another one."
        )


def _compute_missing_chunks(
    store: Store, compute: Callable[[int], Records], progress: bool
) -> None:
    """Compute and write the missing chunks of this process, then wait for the other processes."""
    store.check()
    finished = store.finished()
    assigned = range(jax.process_index(), len(finished), jax.process_count())
    missing = [number for number in assigned if not finished[number]]
    for number in _progress_bar(missing, progress):
        store.write(number, compute(number))
    while not np.all(store.finished()):  # JAX ends this process if another one dies
        time.sleep(POLL_SECONDS)


def stored_chunk(path: str | Path) -> int | None:
    """Return the chunk size of a store; None if there is no such store yet."""
    path = Path(path)
    return None if _is_absent(path) else int(_open_group(path).attrs["chunk"])


def open_store(
    path: str | Path,
    batch: Batch,
    times: np.ndarray,
    shapes: Records,
    description: dict[str, str],
    chunk: int,
    saves_particles: bool = False,
) -> Store:
    """Open the store of a sweep, or create it.

    Args:
        path: a folder that is empty or does not exist, or the store of the same sweep.
        batch: the members.
        times: t, s.
        shapes: types and shapes of the records of one member.
        description: everything that determines the results.
        chunk: members per chunk.
        saves_particles: whether the particles themselves are saved.

    Raises:
        ValueError: if the folder or file is something else, the store of another sweep or of
            another version, or a damaged store.
        OSError: if it cannot be written.
        ModuleNotFoundError: without the extra `sweep`.
    """
    path = Path(path)
    if _is_absent(path):
        _create_group(path, batch, times, shapes, description, chunk, saves_particles)
    group = _open_group(path)
    _check_same_sweep(path, dict(group.attrs), description)
    for name, (_, values, _) in coordinates(batch, times).items():
        stored = _read_values(path, _checked_array(path, group, name, values))
        if not np.array_equal(stored, values, equal_nan=True):
            raise _damaged_store(path, f"other values in {name!r}")
    for name, member_shape in shapes.items():
        _checked_array(path, group, name, member_shape, len(batch))
    _checked_array(path, group, FINISHED, _empty_digests(len(batch), chunk))
    return Store(path, group, tuple(sorted(shapes)), len(batch), chunk)


def _create_group(
    path: Path,
    batch: Batch,
    times: np.ndarray,
    shapes: Records,
    description: dict[str, str],
    chunk: int,
    saves_particles: bool,
) -> None:
    """Create the group with all labels and no finished chunk.

    It is written under a temporary name and then renamed, so that exactly one of several processes
    creates it; the others keep that one.
    """
    zarr = import_extra("zarr", "sweep")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        temporary.chmod(0o777 & ~_umask())
        group = zarr.open_group(str(temporary), mode="w", zarr_format=3)
        for name, (dims, values, attributes) in coordinates(batch, times).items():
            array = group.create_array(
                name,
                shape=values.shape,
                dtype=values.dtype,
                dimension_names=dims,
                attributes=attributes,
            )
            array[...] = values
        for name, member_shape in shapes.items():
            create_record_array(group, name, member_shape, len(batch), chunk, saves_particles)
        group.create_array(
            FINISHED,
            shape=_empty_digests(len(batch), chunk).shape,
            chunks=(1,),
            dtype=np.uint64,
            fill_value=0,
            dimension_names=(CHUNK,),
            attributes={"long_name": "digest of the values of a finished chunk, else 0"},
        )
        group.attrs.update(
            {
                "format": FORMAT_VERSION,
                "version": version("jaxgran"),
                "chunk": chunk,
                "description": description,
                "coordinates": " ".join(sorted(batch.swept_floats())),
            }
        )
        with warnings.catch_warnings():
            # The names and types of the arrays do not change any more.
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(str(temporary))
        os.rename(temporary, path)
    except OSError:
        shutil.rmtree(temporary, ignore_errors=True)
        if _is_absent(path):
            raise
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def create_record_array(
    group: Any,
    name: str,
    member_shape: Any,
    num_members: int,
    chunk: int,
    saves_particles: bool = False,
) -> None:
    """Create the array of a record, filled with nan (integers: 0), in chunks of members.

    Args:
        group: the `zarr.Group`.
        name: of the record.
        member_shape: type and shape of the record of one member.
        num_members: of the sweep.
        chunk: members per chunk.
        saves_particles: whether the particles themselves are saved.
    """
    dims, attributes = _dimensions_and_attributes(name, len(member_shape.shape), saves_particles)
    group.create_array(
        name,
        shape=(num_members, *member_shape.shape),
        chunks=(chunk, *member_shape.shape),
        dtype=member_shape.dtype,
        fill_value=missing_value(member_shape.dtype),
        dimension_names=(MEMBER, *dims),
        attributes=attributes,
    )


def coordinates(batch: Batch, times: np.ndarray) -> dict[str, Any]:
    """Return the dimensions, values and attributes of each coordinate of a store, by name."""
    by_name = {
        MEMBER: ((MEMBER,), np.arange(len(batch)), {}),
        TIME: ((TIME,), times, {"units": QUANTITY_UNITS["times"]}),
    }
    for name, (values, per_member) in batch.swept_floats().items():
        dims = (MEMBER,) if per_member else ()
        dims += tuple(f"{name}_{k}" for k in range(values.ndim - len(dims)))  # of a list
        unit = FLOAT_UNITS.get(name.removeprefix(INITIAL_PREFIX), "1")
        by_name[name] = (dims, values, {"units": unit})
    return by_name


def _dimensions_and_attributes(
    name: str, ndim: int, saves_particles: bool
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the names of the axes of one member's record, and its attributes."""
    long_name = name.replace("_", " ")
    if name == STATUS:
        return (), {"long_name": "faults, see jaxgran.explain_status"}
    if is_saved(name):
        unit = saved_unit(name, saves_particles)
        attributes = {"long_name": long_name} | ({} if unit is None else {"units": unit})
        return saved_dimensions(name, ndim, saves_particles), attributes
    quantity = name.removesuffix(OF_REPLICAS)
    dims = (TIME,) if quantity == name else (REPLICA, TIME)
    return dims, {"units": QUANTITY_UNITS[quantity], "long_name": long_name}


def _open_group(path: Path) -> Any:
    zarr = import_extra("zarr", "sweep")
    try:
        if path.is_file():
            raise ValueError("it is a file")
        group = zarr.open_group(str(path), mode="r+", use_consolidated=False)
        attributes = dict(group.attrs)
        chunk, description = attributes.get("chunk"), attributes.get("description")
        if not (isinstance(chunk, int) and chunk > 0 and isinstance(description, dict)):
            raise ValueError("its attributes do not describe a sweep")
    except Exception as error:  # zarr raises any type for a folder that holds something else
        raise ValueError(
            f"{path} is not the store of a sweep ({error}). Name another folder, or remove it."
        ) from None
    return group


def _check_same_sweep(path: Path, attributes: dict[str, Any], description: dict[str, str]) -> None:
    installed = version("jaxgran")
    stored, stored_format = attributes.get("version"), attributes.get("format")
    if (stored_format, stored) != (FORMAT_VERSION, installed):
        raise ValueError(
            f"{path} was written by jaxgran {stored} in format {stored_format}, this is "
            f"{installed} with format {FORMAT_VERSION}, which may compute other numbers. Finish "
            "the sweep with that version, or name another store."
        )
    differ = differences(attributes["description"], description)
    if differ:
        more = len(differ) - MAX_DIFFERENCES
        rest = f" and {more} more" if more > 0 else ""
        raise ValueError(
            f"{path} belongs to another sweep: {'; '.join(differ[:MAX_DIFFERENCES])}{rest}. Name "
            "another store, or remove it to start again."
        )


def _checked_array(path: Path, group: Any, name: str, like: Any, *members: int) -> Any:
    """Return an array of a store, of the given type and shape.

    Raises:
        ValueError: if there is no such array.
    """
    try:
        array = group[name]
        shape, dtype = array.shape, array.dtype
    except Exception as error:  # zarr raises any type for a missing or truncated file
        raise _damaged_store(path, f"no array {name!r} ({error})") from None
    if (shape, dtype) != ((*members, *like.shape), like.dtype):
        raise _damaged_store(path, f"an array {name!r} of {dtype} and shape {shape}")
    return array


def _read_values(path: Path, array: Any) -> np.ndarray:
    try:
        return np.asarray(array[...])
    except Exception as error:  # a codec raises any type for a truncated file
        raise _damaged_store(path, f"a damaged array {array.basename!r} ({error})") from None


def _damaged_store(path: Path, has: str) -> ValueError:
    return ValueError(
        f"{path} is damaged: it has {has}. Copy the store again, or name another one."
    )


def _empty_digests(num_members: int, chunk: int) -> np.ndarray:
    """Return a digest of 0, which means unfinished, for each chunk."""
    return np.zeros(-(-num_members // chunk), np.uint64)


def _is_absent(path: Path) -> bool:
    return not path.exists() or (path.is_dir() and not any(path.iterdir()))


def _digest(records: Records) -> np.uint64:
    """Return a positive hash of the names, types, shapes and values of records."""
    digest = hashlib.sha256()
    for name in sorted(records):
        values = np.ascontiguousarray(records[name])
        digest.update(f"{name} {values.dtype} {values.shape}".encode())
        digest.update(values.tobytes())
    return np.uint64(int.from_bytes(digest.digest()[:8], "big") | 1)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
