"""Sweeps: the cooling curves of many gases, over devices and processes, with an optional store.

The members of a sweep are gases that share a structure and differ in parameters and keys. Each
process runs chunks of members in one compiled program on its devices. A store is a Zarr group,
labelled for xarray, whose arrays are divided into the same chunks. The status of a chunk is written
last: until then it is `MISSING`, and a sweep that is resumed computes the chunk.
"""

import dataclasses
import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax._src import distributed
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, ArrayLike, Float, Key, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils import status
from jaxgran._utils.extras import import_extra
from jaxgran._utils.validation import check_bool, checked_int, checked_times
from jaxgran._utils.waiting import block_until_ready
from jaxgran.data.checkpoint import describe_run
from jaxgran.data.curve import CoolingCurve, from_arrays
from jaxgran.data.curve_arrays import STATUS, TIME, label_of, to_arrays
from jaxgran.data.particles import Particles
from jaxgran.data.quantities import QUANTITIES
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel
from jaxgran.models.cool import cool
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.spheres import AbstractSpheres
from jaxgran.particles.capacity import Capacity
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import PARAMETER_UNITS

DEFAULT_CHUNK = {False: 1024, True: 16}
"""Members per chunk, by whether the model is stochastic."""

MAX_WAIT = 366 * 24 * 3600 * 1000
"""Time, ms, that a process that has finished its chunks waits for the others: a year."""

_BARRIERS = count()
"""Numbers of barriers: all processes pass the same ones."""

DEVICE = "device"
MEMBER = "member"

SPARE_FACTORS = (2.0, 4.0, 8.0)
"""Ratios of capacity to expected need, tried in turn: a chunk in which a member overflows its
arrays is run again with the next ratio."""

MISSING = -1
"""Status in a store of a member that is not finished."""

ATTRIBUTE = "sweep"
"""Attribute of a store that identifies the sweep."""

WALL_SIDE = "wall_side"
"""The only parameter that may be one number or d numbers."""


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
    the complete result. If a process dies, JAX ends the others, at the latest after
    ``heartbeat_timeout_seconds`` of `jax.distributed.initialize`. The same call then computes the
    missing chunks, with any number of processes.

    A member that fails has the values nan and a nonzero ``status``; the other members continue.
    Members that the model does not support are reported in a warning.

    Args:
        gases: a gas in which some or all parameters have a leading axis of members, as returned by
            ``jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values)``. A list of floats
            (coefficients of a series, sides of a box) has the axis of members first.
        times: t, s, increasing and >= 0, shape (times,).
        model: a `jaxgran.extend.AbstractModel`, by default `jaxgran.KineticTheory()`. Arrays of
            particle models are sized for the member with the largest need, unless `sized_for` was
            called.
        key: the random key, from which `jax.random.fold_in` derives one key for each member; or an
            array with one key for each member. By default `jax.random.key(0)`. The key of a member
            does not depend on the number of members.
        save: for models with particles: a function of the particles of one replica of a member, or
            "particles", as in `jaxgran.cool`. Its values, with a first axis of members, are
            ``curves.saved``, ``curves.saved_error`` and ``curves.replicas.saved``. Integers and
            booleans of an unsupported member are 0.
        store: path of a Zarr group that `xarray.open_zarr` reads: arrays have the names of
            `CoolingCurve.to_xarray` and a first dimension member, and swept parameters and units
            are labels. Each chunk is written when it ends; until then its status is -1. If the
            group is the store of the same sweep, only missing chunks are computed. Needs the extra
            `sweep`, and a file system that all processes share. None keeps the results in memory
            only.
        chunk: number of members computed and written together, >= 1; by default as in an existing
            store, otherwise 16 for a stochastic model and 1024 for others.
        progress: show a progress bar on a terminal.

    Returns:
        The curves of all members in one object, as `jax.vmap` of `jaxgran.cool` returns them: T has
        shape (members, times). Without particles.

    Raises:
        ValueError: if the leading axes of the parameters have different lengths, if parameters of
            all members are outside their range, if the model supports no member, for several
            processes without a store, if `save` is not a function of particles or returns values
            without names, or if the store belongs to another sweep or another version of jaxgran.
            Nothing is overwritten.
        OSError: if the store cannot be written.

    >>> gases = jax.vmap(lambda a: gas.replace(dissipative_constant=a))(jnp.array([1e-6, 3e-6]))
    >>> jaxgran.sweep(gases, times, progress=False).temperature.shape
    (2, 4)
    """
    check_bool(progress=progress)
    times = checked_times(times)
    gases, keys, swept = _checked_members(gases, key)
    model = checks.checked_model(KineticTheory() if model is None else model)
    model.check_save(save)
    if not isinstance(store, str | os.PathLike | None):
        raise ValueError(f"store must be a path, got {store!r:.60}")
    if store is None and jax.process_count() > 1:
        raise ValueError(
            f"a sweep over {jax.process_count()} processes needs store, a folder that all share"
        )
    number = len(keys)
    path = None if store is None else Path(store)
    stored = None if path is None else _stored_identity(path)
    if chunk is not None:
        chunk = min(checked_int("chunk", chunk, 1), number)
    elif stored is not None:
        chunk = int(stored["chunk"])
    else:
        chunk = min(DEFAULT_CHUNK[model.stochastic], -(-number // jax.process_count()))

    @cache
    def why_unsupported(i: int) -> str | None:
        try:
            model.check_scene(_member(gases, i))
        except ValueError as error:
            return str(error)
        return None

    stand_in = next((i for i in range(number) if why_unsupported(i) is None), None)
    if stand_in is None:
        name = type(model).__name__
        raise ValueError(f"{name} supports no member of this sweep; member 0: {why_unsupported(0)}")
    models = [model]
    if isinstance(model, AbstractSpheres) and model._sizes is None:
        supported = [_member(gases, i) for i in range(number) if why_unsupported(i) is None]
        models = [_sized_for_all(model, supported, spare) for spare in SPARE_FACTORS]
    run_member = partial(_run_member, model=models[0], times=times, save=save)
    like = jax.eval_shape(run_member, *_rows((gases, keys), stand_in))
    arrays: Any = {
        name: np.full((number, *x.shape), _empty(name, x.dtype), x.dtype)
        for name, x in _records(like).items()
    }
    if path is not None:
        parts = {"gases": gases, "key": keys, "times": times, "model": model, "save": save}
        labels = _labels(gases, swept, np.asarray(times))
        arrays = _open_store(path, _identity(chunk, parts), arrays, labels, save == "particles")
    chunks = [slice(i, min(i + chunk, number)) for i in range(0, number, chunk)]
    mine = chunks[jax.process_index() :: jax.process_count()]
    missing = [rows for rows in mine if np.any(arrays[STATUS][rows] == MISSING)]
    for rows in tqdm(missing, desc="chunks", delay=3, disable=None if progress else True):
        members = np.arange(rows.start, rows.stop)
        unsupported = np.array([why_unsupported(i) is not None for i in members.tolist()])
        if np.any(unsupported):
            first = int(members[unsupported][0])
            warnings.warn(
                f"{unsupported.sum()} of members {members[0]} to {members[-1]} cannot be simulated "
                f"and are nan; the first of them is {first}: {why_unsupported(first)}",
                stacklevel=2,
            )
        chosen = _rows((gases, keys), np.where(unsupported, stand_in, members))
        computed = _run_chunk(models, chosen, times, chunk, save)
        faults = computed.pop(STATUS)
        faults[unsupported] = status.UNSUPPORTED.bit
        for name, values in computed.items():
            values[unsupported] = _empty(name, values.dtype)
            arrays[name][rows] = values
        arrays[STATUS][rows] = faults  # last: the chunk is complete now
    _wait_for_all("all chunks are finished")
    known = {name: jnp.asarray(arrays[name][:]) for name in _records(like)}
    return jax.vmap(lambda known: from_arrays({"times": times} | known, like))(known)


def _checked_members(gases: Any, key: Any) -> tuple[Gas, Key[Array, "members"], list[str]]:
    """Return gases and keys with an axis of members, and the names of the swept parameters.

    Raises:
        ValueError: for anything but a gas, for leading axes of different lengths, and if nothing
            has an axis of members.
    """
    how = "jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values)"
    if not isinstance(gases, Gas):
        got = type(gases).__name__
        raise ValueError(
            f"gases must be one Gas with an axis of members, got a {got}. Build it by {how}"
        )
    keys = jax.random.key(0) if key is None else key
    is_array = isinstance(keys, jax.Array)
    if is_array and keys.dtype == jnp.uint32 and keys.ndim in (1, 2):
        keys = jax.random.wrap_key_data(keys)
    if not (is_array and jnp.issubdtype(keys.dtype, jax.dtypes.prng_key) and keys.ndim <= 1):
        raise ValueError(
            f"key must be a key such as jax.random.key(5), or an array of keys, got {key!r:.60}"
        )
    swept = _swept_names(gases)
    lengths = {} if keys.ndim == 0 else {"key": len(keys)}
    lengths |= {name: len(gases.value(name)) for name in swept}
    if not lengths:
        raise ValueError(
            "no parameter of gases has a leading axis, and there is only one key. Build gases by "
            f"{how}, give an array of keys, or use jaxgran.cool for one gas."
        )
    number = next(iter(lengths.values()))
    if set(lengths.values()) != {number} or number == 0:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(
            f"the leading axes of a sweep must have one length, at least 1, got {listed}. Give "
            "every swept parameter one value for each member."
        )
    if keys.ndim == 0:
        keys = jax.vmap(partial(jax.random.fold_in, keys))(jnp.arange(number))
    same = {name: gases.value(name) for name in gases.domains if name not in swept}
    repeated = {name: jnp.broadcast_to(x, (number, *x.shape)) for name, x in same.items()}
    gases = gases.replace(**repeated)
    if constants := gases.law.constants:  # lists, which jax.vmap has repeated already
        gases = eqx.tree_at(
            lambda gases: [getattr(gases.law, name) for name in constants],
            gases,
            replace_fn=lambda x: x if x.ndim > 1 else jnp.broadcast_to(x, (number, *x.shape)),
        )
    return gases, keys, swept


def _swept_names(gases: Gas) -> list[str]:
    """Return the names of the parameters that have an axis of members.

    Raises:
        ValueError: for parameters with further axes, and for wall sides that may belong to one box
            or to several cubes.
    """
    shapes = {name: np.shape(gases.value(name)) for name in gases.domains}
    for name, shape in shapes.items():
        if len(shape) - (name in (*gases.law.lists, WALL_SIDE)) > 1:
            raise ValueError(
                f"{name} has shape {shape}, but a sweep has only one axis of members. Flatten the "
                "axes, as in jnp.meshgrid(...)[0].ravel()."
            )
    sides = shapes.pop(WALL_SIDE, ())
    swept = [name for name, x in shapes.items() if len(x) > (name in gases.law.lists)]
    is_one_box = sides == (gases.dimension,) and not swept
    if sides == () or is_one_box:
        return swept
    if sides == (gases.dimension,) and len(swept) < len(shapes):
        raise ValueError(
            f"{WALL_SIDE} of shape {sides} is ambiguous: one box with these sides, or {sides[0]} "
            "cubes. Give every parameter of gases an axis of members, as jax.vmap does."
        )
    return [*swept, WALL_SIDE]


def _rows(tree: Any, rows: Any) -> Any:
    return jax.tree.map(lambda x: x[rows], tree)


def _member(gases: Gas, i: int) -> Gas:
    """Return one gas; raise ValueError for a parameter outside its range, which vmap lets pass."""
    gas = _rows(gases, i)
    return gas.replace(**{name: gas.value(name) for name in gas.domains})


def _empty(name: str, dtype: Any) -> Any:
    """Return the value of an array where nothing was computed: nan, or 0 where there is no nan."""
    if name == STATUS:
        return MISSING
    return np.nan if np.issubdtype(dtype, np.inexact) else np.zeros((), dtype)[()]


def _sized_for_all(model: AbstractSpheres, gases: Sequence[Gas], spare: float) -> AbstractSpheres:
    """Return a model with arrays long enough, and blocks of steps short enough, for all gases."""
    sized = [model.sized_for(gas, spare) for gas in gases]
    needs = [model._sizes for model in sized if model._sizes is not None]
    if len({need.engine for need in needs}) > 1:  # look-aheads of two searches, for one array
        return _sized_for_all(dataclasses.replace(model, neighbours="cells"), gases, spare)
    sizes = needs[0]._replace(
        steps=min(need.steps for need in needs),
        capacity=_largest([need.capacity for need in needs]),
        equilibration_capacity=_largest([need.equilibration_capacity for need in needs]),
    )
    return dataclasses.replace(model, _sizes=sizes)


def _largest(capacities: Sequence[Capacity]) -> Capacity:
    """Return a capacity that is enough for all of some runs."""
    return Capacity(*np.max(capacities, axis=0).tolist())


def _run_member(gas: Gas, key: PRNGKeyArray, *, model, times, save) -> CoolingCurve:
    """Return the curve of one member, with a status and without particles."""
    curve = cool(gas, times, model=model, key=key, save=save)
    fault = status.OK if curve.status is None else curve.status
    return dataclasses.replace(curve, particles=None, status=jnp.asarray(fault, jnp.int32))


def _records(curve: CoolingCurve) -> dict[str, Any]:
    """Return the arrays of a member by name, without the times, which all members share."""
    return {name: array for name, array in to_arrays(curve).items() if name != "times"}


def _run_chunk(
    models: Sequence[AbstractModel],
    members: tuple[Gas, Key[Array, "members"]],
    times: Float[Array, "times"],
    chunk: int,
    save: Any,
) -> dict[str, np.ndarray]:
    """Compute at most `chunk` members on all devices of this process.

    The last member is repeated until every device has the same number. If members of a particle
    model overflow their arrays, the chunk is run again with the next model.
    """
    number = len(members[1])
    mesh = Mesh(np.array(jax.local_devices()[:chunk]), (DEVICE,))
    rows = np.minimum(np.arange(-(-chunk // mesh.size) * mesh.size), number - 1)
    arrays: dict[str, np.ndarray] = {}
    for model in models:
        out = block_until_ready(_run_on_devices(model, _rows(members, rows), times, mesh, save))
        arrays = {name: np.array(values)[:number] for name, values in out.items()}
        if not np.any(arrays[STATUS] & (status.LIST_FULL.bit | status.CONTACTS_FULL.bit)):
            break
    return arrays


@eqx.filter_jit
def _run_on_devices(model: AbstractModel, members: Any, times: Array, mesh: Mesh, save: Any) -> Any:
    arrays, rest = eqx.partition((model, times), eqx.is_array)

    def run_members(arrays, members):
        model, times = eqx.combine(arrays, rest)

        def run_member(member):
            return _records(_run_member(*member, model=model, times=times, save=save))

        # On a CPU many particles run faster one member after the other: under jax.vmap a loop runs
        # for all members until the slowest one ends. Also, their numbers are then independent.
        if model.stochastic and jax.default_backend() == "cpu":
            return jax.lax.map(run_member, members)
        return jax.vmap(run_member)(members)

    specs = PartitionSpec(), PartitionSpec(DEVICE)
    # With check_vma, shard_map would require the loops of a member to declare an axis of devices.
    sharded = jax.shard_map(
        run_members, mesh=mesh, in_specs=specs, out_specs=specs[1], check_vma=False
    )
    return sharded(arrays, members)


def _identity(chunk: int, parts: dict[str, Any]) -> dict[str, Any]:
    """Return what identifies a sweep: the chunk, the version, and a hash of each other part."""
    identity = {"chunk": chunk, "version of jaxgran": version("jaxgran")}
    for name, part in parts.items():
        words = json.dumps(describe_run(part=part))
        identity[name] = hashlib.sha256(words.encode()).hexdigest()[:16]
    return identity


def _labels(gases: Gas, swept: list[str], times: np.ndarray) -> dict[str, tuple]:
    """Return dimensions, values and attributes of the labels of a store, by name.

    A swept parameter that has the name of a quantity of a curve gets the prefix initial_.
    """
    number = len(jax.tree.leaves(gases)[0])
    labels = {MEMBER: (MEMBER, np.arange(number)), TIME: (TIME, times, {"units": "s"})}
    for name in swept:
        values = np.asarray(gases.value(name))
        label = f"initial_{name}" if name in QUANTITIES else name
        dims = (MEMBER, *(f"{label}_{k}" for k in range(values.ndim - 1)))
        if np.all(values == values[:1]):
            dims = dims[1:]
            values = values[0]
        labels[label] = dims, values, {"units": PARAMETER_UNITS.get(name, "1")}
    return labels


def _open_store(
    path: Path,
    identity: dict[str, Any],
    empty: dict[str, np.ndarray],
    labels: dict[str, tuple],
    are_particles: bool,
) -> Any:
    """Return the Zarr group of a sweep; create it, with all labels and no finished chunk."""
    zarr = import_extra("zarr", "sweep")
    xarray = import_extra("xarray", "sweep")
    if _stored_identity(path) is None and jax.process_index() == 0:
        variables = {}
        encoding = {}
        for name, values in empty.items():
            if name == STATUS:
                dims = ()
                attributes = {"long_name": "faults, see jaxgran.explain_status"}
            else:
                dims, attributes = label_of(name, values.ndim - 1, are_particles)
            variables[name] = (MEMBER, *dims), values, attributes
            fill = _empty(name, values.dtype)
            encoding[name] = {"chunks": (identity["chunk"], *values.shape[1:]), "fill_value": fill}
        dataset = xarray.Dataset(variables, labels, {ATTRIBUTE: identity})
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a format that may change: nothing is shared
                dataset.to_zarr(temporary, encoding=encoding, zarr_format=3)
            os.rename(temporary, path)  # complete, or not there
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    _wait_for_all("the store is there")
    stored = _stored_identity(path) or {}
    differ = [name for name in identity if stored.get(name) != identity[name]]
    if differ:
        raise ValueError(
            f"{path} belongs to another sweep, with another {', '.join(differ)}. Name another "
            "store, or remove it to start again."
        )
    return zarr.open_group(path, mode="r+")


def _wait_for_all(event: str) -> None:
    """Wait until all processes are here; JAX ends this process if another one dies.

    This is the barrier of the processes. That of the devices
    (`jax.experimental.multihost_utils.sync_global_devices`) fails after half an hour on CPUs.
    """
    if jax.process_count() > 1:
        assert distributed.global_state.client is not None
        name = f"jaxgran.sweep {next(_BARRIERS)}: {event}"
        distributed.global_state.client.wait_at_barrier(name, MAX_WAIT)


def _stored_identity(path: Path) -> dict[str, Any] | None:
    """Return the identity of the sweep of a store, or None if there is no store yet."""
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return None
    try:
        return dict(import_extra("zarr", "sweep").open_group(path, mode="r").attrs[ATTRIBUTE])
    except Exception as error:  # zarr raises any type for a folder that holds something else
        raise ValueError(
            f"{path} is not the store of a sweep ({error}). Name another folder, or remove it."
        ) from None
