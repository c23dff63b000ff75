"""Cool many gases: over the devices of one or several processes, kept in a store.

The members of a sweep: gases that share a structure and differ in floats and keys.

What the devices of a process run: the members of one chunk, in one compiled program.

The arrays of a store: their dimensions, units and first values.

The chunks of a sweep on the disk: a Zarr group, which `xarray.open_zarr` reads with labels.

The group is made whole under another name and then renamed, so that of several processes the first
makes it. A chunk's values are written before its number in the array `finished`, which is a digest
of them: a chunk that was under way when a process died counts as not begun.
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
from jaxgran._utils.validation import checked_times, no_type_check, whole_number
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

SIDES = "wall_side"
"""The float that is one number or d of them."""

INITIAL = "initial_"

RECORDED = ("temperature", "rotational_temperature")
"""Floats of a gas that are quantities of a curve, too."""


class Label(NamedTuple):
    """Values of a float: with a first axis of members, or one for all."""

    values: np.ndarray
    of_members: bool


class Batch(NamedTuple):
    """Gases with a leading axis of members on every float, and a key for each.

    Attributes:
        gases: a `Gas` whose leaves have a first axis of members.
        keys: one for each member.
        swept: names of the floats that were given with an axis of members.
    """

    gases: Gas
    keys: Keys
    swept: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.keys)

    def member(self, i: int) -> Gas:
        """One gas, with all of its floats checked.

        Raises:
            ValueError: for a float outside its range.
        """
        gas = jax.tree.map(lambda x: x[i], self.gases)
        return gas.replace(**{name: gas.value(name) for name in gas.domains})

    def labels(self) -> dict[str, "Label"]:
        """The swept floats by name; T and T_rot at t = 0 are "initial_" ones, beside records."""
        each = {
            f"{INITIAL}{name}" if name in RECORDED else name: np.asarray(self.gases.value(name))
            for name in self.swept
        }
        return {
            name: Label(values[0], False) if np.all(values == values[:1]) else Label(values, True)
            for name, values in each.items()
        }

    def taken(self, rows: np.ndarray) -> tuple[Gas, Keys]:
        """The gases and keys of some members."""
        return jax.tree.map(lambda x: x[rows], (self.gases, self.keys))


def batched(gases: Any, key: Any) -> Batch:
    """The members that a user gives, every leaf with a leading axis of the same length.

    Raises:
        ValueError: for anything but a gas, for a batch whose leaves have different lengths, and
            where nothing has an axis of members.
    """
    if not isinstance(gases, Gas):
        raise ValueError(f"gases must be a jaxgran.Gas with batched floats, got {_kind(gases)}")
    keys = _checked_keys(key)
    lengths = {} if keys.ndim == 0 else {"key": len(keys)}
    swept = {name: np.shape(gases.value(name))[0] for name in _swept(gases)}
    lengths |= swept
    if not lengths:
        raise ValueError(
            "no float of gases has a leading axis, and there is one key: build gases by jax.vmap("
            "lambda a: gas.replace(dissipative_constant=a))(values), give an array of keys, or "
            "take jaxgran.cool for one gas"
        )
    if len(set(lengths.values())) > 1 or 0 in lengths.values():
        said = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(
            f"the leading axes of a sweep must have one length, at least 1, got {said}: give "
            "every swept float one value for each member"
        )
    number = next(iter(lengths.values()))
    members = jnp.arange(number)
    if keys.ndim == 0:
        keys = jax.vmap(lambda i: jax.random.fold_in(keys, i))(members)
    same = {name: gases.value(name) for name in gases.domains if name not in swept}
    repeated = {name: jnp.broadcast_to(x, (number, *x.shape)) for name, x in same.items()}
    gases = gases.replace(**repeated)
    return Batch(gases, keys, tuple(swept))


def _kind(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__}: stack the floats of its gases into one Gas"
    if isinstance(value, dict):
        return "a dict: take jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values)"
    return type(value).__name__


def _checked_keys(key: Any) -> Key[Array, "..."]:
    """One key or a row of them, typed."""
    if key is None:
        return jax.random.key(0)
    if isinstance(key, jax.Array):
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim <= 1:
            return key
        if key.dtype == jnp.uint32 and key.ndim in (1, 2):
            return jax.random.wrap_key_data(key)
    raise ValueError(
        f"key must be a key such as jax.random.key(5), or a row of keys, got {key!r:.60}"
    )


def _swept(gases: Gas) -> list[str]:
    """Names of the floats that have an axis of members.

    Raises:
        ValueError: for floats with further axes, and for wall sides of which it cannot be told
            whether they are those of one box or of several cubes.
    """
    ndims = {name: np.ndim(gases.value(name)) for name in gases.domains}
    single = {name: int(name in gases.law.lists) for name in ndims if name != SIDES}
    plain = [name for name in single if ndims[name] > single[name]]
    for name, ndim in ndims.items():
        if ndim - single.get(name, 1) > 1:
            raise ValueError(
                f"{name} has shape {np.shape(gases.value(name))}, and a sweep has one axis of "
                "members: flatten the others, as in jnp.meshgrid(...)[0].ravel()"
            )
    if SIDES not in ndims or ndims[SIDES] == 0:
        return plain
    length = np.shape(gases.value(SIDES))[0]
    if ndims[SIDES] == 2 or length != gases.dimension or len(plain) == len(single):
        return [*plain, SIDES]
    if not plain:
        return plain  # one box of d sides
    raise ValueError(
        f"{SIDES} of shape {np.shape(gases.value(SIDES))} may be the sides of one box or those of "
        f"{length} cubes: give every float of gases an axis of members, as jax.vmap returns them"
    )


def first_valid(batch: Batch, model: AbstractModel) -> int:
    """The first member that a model takes.

    Raises:
        ValueError: what is wrong with the first one, if the model takes none.
    """
    first = None
    for i in range(len(batch)):
        refused = refusal(batch, i, model)
        if refused is None:
            return i
        first = first or refused
    assert first is not None
    raise ValueError(f"{type(model).__name__} takes no member of this sweep; member 0: {first}")


def refusal(batch: Batch, i: int, model: AbstractModel) -> str | None:
    """Why a model does not take a member, in words; None if it does."""
    try:
        model.check_scene(batch.member(i))
    except ValueError as error:
        return str(error)
    return None


DEVICE = "device"
"""The axis of the mesh."""

SPARE = (2.0, 4.0, 8.0)
"""Capacities over the expected need that are tried one after the other: a chunk in which some
member outgrows its arrays is run again with the next."""

STATUS = "status"

FULL = status.LIST_FULL.bit | status.CONTACTS_FULL.bit

Records = dict[str, Any]
"""Arrays by name, with a first axis of members."""

Save = Callable[[Particles], Any] | Literal["particles"] | None
"""The option of `jaxgran.cool`."""


class Program(NamedTuple):
    """A model, and the devices of this process on which members run.

    Attributes:
        models: the model with arrays of several lengths, the shortest first.
        times: t, s.
        mesh: the devices.
        each: members that a device takes in one call.
        save: what is kept of the particles, as in `jaxgran.cool`.
    """

    models: tuple[AbstractModel, ...]
    times: Float[Array, "times"]
    mesh: Mesh
    each: int
    save: Save = None

    @classmethod
    def of(
        cls,
        model: AbstractModel,
        times: Float[Array, "times"],
        chunk: int,
        members: Sequence[Gas],
        save: Save = None,
    ) -> "Program":
        """For all devices of this process, which share a chunk.

        Args:
            model: as the user gave it.
            times: t, s.
            chunk: most members of one call.
            members: the gases of known numbers that arrays must hold.
            save: what is kept of the particles.
        """
        devices = np.array(jax.local_devices()[:chunk])
        models = (model,)
        if isinstance(model, AbstractSpheres) and model.plan is None:
            models = tuple(_sized(model, members, spare) for spare in SPARE)
        return cls(models, times, Mesh(devices, (DEVICE,)), -(-chunk // len(devices)), save)

    def like(self, gas: Gas, key: PRNGKeyArray) -> CoolingCurve:
        """The curve of a member, with types and shapes in place of arrays.

        Raises:
            ValueError: if what is saved cannot be kept by name.
        """
        of_one = partial(cool, times=self.times, model=self.models[0], save=self.save)
        like = jax.eval_shape(lambda gas, key: of_one(gas, key=key), gas, key)
        saved_arrays(like)
        return like

    def run(self, gases: Gas, keys: Keys) -> Records:
        """The records of some members, at most a chunk of them.

        The last one is repeated until every device has the same number. Particle models whose
        members outgrow their arrays are run again with longer ones.
        """
        number = len(keys)
        rows = np.minimum(np.arange(self.each * self.mesh.size), number - 1)
        gases, keys = jax.tree.map(lambda x: x[rows], (gases, keys))
        records: Records = {}
        for model in self.models:
            one_by_one = _one_by_one(model)
            out = _over_devices(model, gases, keys, self.times, self.mesh, one_by_one, self.save)
            records = {name: np.asarray(x)[:number] for name, x in block_until_ready(out).items()}
            if not np.any(records[STATUS] & FULL):
                break
        return records


def _one_by_one(model: AbstractModel) -> bool:
    """Whether a device takes its members one after the other.

    On a CPU that is the faster way for a model of many particles, whose loops would else go on for
    all until the last has ended; and a member's numbers do not depend on the others.
    """
    return model.stochastic and jax.default_backend() == "cpu"


@eqx.filter_jit
def _over_devices(
    model: AbstractModel,
    gases: Gas,
    keys: Keys,
    times: Float[Array, "times"],
    mesh: Mesh,
    one_by_one: bool,
    save: Save,
) -> Records:
    arrays, rest = eqx.partition((model, times), eqx.is_array)

    def some(arrays, gases, keys):
        model, times = eqx.combine(arrays, rest)

        def one(gas, key):
            return records_of(cool(gas, times, model=model, key=key, save=save))

        if one_by_one:
            return jax.lax.map(lambda member: one(*member), (gases, keys))
        return jax.vmap(one)(gases, keys)

    members, same = PartitionSpec(DEVICE), PartitionSpec()
    # The loops of a member have no axis of devices, which the check would ask them to declare.
    over = jax.shard_map(
        some, mesh=mesh, in_specs=(same, members, members), out_specs=members, check_vma=False
    )
    return over(arrays, gases, keys)


def records_of(curve: CoolingCurve) -> Records:
    """What is recorded of one member: its curve, those of its replicas, what it saved, its status.

    The axis of members is not there yet.
    """
    known = {name: getattr(curve, name) for name in QUANTITY_UNITS if name != "times"}
    if curve.replicas is not None:
        each = {name: getattr(curve.replicas, name) for name in QUANTITY_UNITS if name != "times"}
        known |= {f"{name}{OF_REPLICAS}": values for name, values in each.items()}
    found = {name: values for name, values in known.items() if values is not None}
    fault = status.OK if curve.status is None else curve.status
    return found | saved_arrays(curve) | {STATUS: jnp.asarray(fault, jnp.int32)}


def failed_records(records: Records, rows: np.ndarray) -> Records:
    """The records with some members nan, and with the status of a gas that is not taken.

    Saved whole numbers, which cannot be nan, are 0.
    """
    changed = {}
    for name, values in records.items():
        values = np.array(values)
        values[rows] = status.UNSUPPORTED.bit if name == STATUS else unknown_value(values.dtype)
        changed[name] = values
    return changed


def unknown_value(dtype: Any) -> Any:
    """A value of some type for what is not known: nan where it has one, else 0."""
    return np.nan if np.issubdtype(dtype, np.inexact) else np.zeros((), dtype)[()]


def join_chunks(chunks: Sequence[Records]) -> Records:
    """The records of several chunks, one after the other."""
    return {name: np.concatenate([each[name] for each in chunks]) for name in chunks[0]}


def stack_curves(records: Records, times: Array, like: CoolingCurve | None) -> CoolingCurve:
    """The curves of all members in one, as `jax.vmap` returns them, without particles.

    Args:
        records: of all members.
        times: t, s.
        like: of `Program.like`, if something was saved.
    """

    def of_one(records: Records) -> CoolingCurve:
        kept = {k: x for k, x in records.items() if is_saved(k)}
        records = {k: x for k, x in records.items() if k not in kept}
        plain = {k: x for k, x in records.items() if not k.endswith(OF_REPLICAS)}
        names = [k.removesuffix(OF_REPLICAS) for k in records.keys() - plain.keys()]
        each = {name: records[f"{name}{OF_REPLICAS}"] for name in names}
        replicas = CoolingCurve(times=times, **each) if each else None
        curve = CoolingCurve(times=times, **plain, replicas=replicas)
        return curve if like is None else with_saved_arrays(curve, like, kept)

    return jax.vmap(of_one)({name: jnp.asarray(values) for name, values in records.items()})


def _sized(model: AbstractSpheres, gases: Sequence[Gas], spare: float) -> AbstractSpheres:
    """A model whose arrays are long enough, and whose blocks are short enough, for some gases."""
    plans = [plan for gas in gases if (plan := model.sized_for(gas, spare).plan) is not None]
    pace = type(plans[0].pace)(*map(min, zip(*(plan.pace for plan in plans), strict=True)))
    run, melt = (
        Capacity(*map(max, zip(*each, strict=True)))
        for each in zip(*((p.capacity, p.equilibration_capacity) for p in plans), strict=True)
    )
    return dataclasses.replace(model, plan=Plan(plans[0].replicas, pace, run, melt))


MEMBER = "member"


def labels(batch: Batch, times: np.ndarray) -> dict[str, Any]:
    """Coordinates: dimensions, values and attributes, by name."""
    found = {
        MEMBER: ((MEMBER,), np.arange(len(batch)), {}),
        TIME: ((TIME,), times, {"units": QUANTITY_UNITS["times"]}),
    }
    for name, (values, of_members) in batch.labels().items():
        dims = (MEMBER,) if of_members else ()
        dims += tuple(f"{name}_{k}" for k in range(values.ndim - len(dims)))  # of a list
        unit = FLOAT_UNITS.get(name.removeprefix(INITIAL), "1")
        found[name] = (dims, values, {"units": unit})
    return found


def make_empty_array(
    group: Any, name: str, of_one: Any, num_members: int, chunk: int, whole: bool = False
) -> None:
    """Make an array for a record, of nan (of whole numbers: 0), in chunks of members.

    Args:
        group: the `zarr.Group`.
        name: of the record.
        of_one: type and shape of that of a member.
        num_members: of the sweep.
        chunk: members of a chunk.
        whole: whether the particles themselves are saved.
    """
    dims, attributes = _described(name, len(of_one.shape), whole)
    group.create_array(
        name,
        shape=(num_members, *of_one.shape),
        chunks=(chunk, *of_one.shape),
        dtype=of_one.dtype,
        fill_value=unknown_value(of_one.dtype),
        dimension_names=(MEMBER, *dims),
        attributes=attributes,
    )


def _described(name: str, ndim: int, whole: bool) -> tuple[tuple[str, ...], dict[str, str]]:
    """Labels of the axes of one member's record, and its attributes."""
    words = name.replace("_", " ")
    if name == STATUS:
        return (), {"long_name": "faults, see jaxgran.explain_status"}
    if is_saved(name):
        unit = saved_unit(name, whole)
        attributes = {"long_name": words} | ({} if unit is None else {"units": unit})
        return saved_dimensions(name, ndim, whole), attributes
    quantity = name.removesuffix(OF_REPLICAS)
    dims = (TIME,) if quantity == name else (REPLICA, TIME)
    return dims, {"units": QUANTITY_UNITS[quantity], "long_name": words}


FORMAT = 1
"""Of the group."""

CHUNK, FINISHED = "chunk", "finished"
MAX_NAMED = 4
"""Differences that are named in an error."""


class Store(NamedTuple):
    """An open store.

    Attributes:
        path: of the group.
        group: the `zarr.Group`.
        names: of the records, sorted.
        num_members: of the sweep.
        chunk: members of a chunk.
    """

    path: Path
    group: Any
    names: tuple[str, ...]
    num_members: int
    chunk: int

    def rows(self, number: int) -> slice:
        """The members of a chunk."""
        return slice(number * self.chunk, min((number + 1) * self.chunk, self.num_members))

    def finished(self) -> np.ndarray:
        """Whether each chunk has been written, by whichever process.

        Raises:
            ValueError: if that is not known any more.
        """
        return _values(self.path, self.group[FINISHED]) != 0

    def write(self, number: int, records: Records) -> None:
        """Write a chunk, and then that it is finished."""
        for name in self.names:
            self.group[name][self.rows(number)] = records[name]
        self.group[FINISHED][number] = _digest(records)

    def check(self) -> None:
        """Check every finished chunk.

        Raises:
            ValueError: naming the first one that does not hold what was written.
        """
        for number in np.flatnonzero(self.finished()):
            self.read(int(number))

    def read(self, number: int) -> Records:
        """The records of a finished chunk.

        Raises:
            ValueError: if it does not hold what was written.
        """
        rows = self.rows(number)
        try:
            records = {name: np.asarray(self.group[name][rows]) for name in self.names}
            whole = _digest(records) == self.group[FINISHED][number]
        except Exception as error:  # whatever a codec raises for a file that was cut off
            raise self._damaged(number, f" ({error})") from None
        if not whole:
            raise self._damaged(number)
        return records

    def read_all(self) -> Records:
        """The records of all members, once all chunks are finished."""
        return join_chunks([self.read(number) for number in range(len(self.finished()))])

    def _damaged(self, number: int, why: str = "") -> ValueError:
        rows = self.rows(number)
        return ValueError(
            f"{self.path}: chunk {number} (members {rows.start} to {rows.stop - 1}) is half "
            f"written or was changed{why}: copy the store again, or name another one"
        )


def stored_chunk(path: str | Path) -> int | None:
    """The chunk size of a store; None if there is no such store yet."""
    path = Path(path)
    return None if _absent(path) else int(_open_group(path).attrs["chunk"])


def open_store(
    path: str | Path,
    batch: Batch,
    times: np.ndarray,
    shapes: Records,
    description: dict[str, str],
    chunk: int,
    whole: bool = False,
) -> Store:
    """The store of a sweep, made now if there is none.

    Args:
        path: a folder that is empty or does not exist, or the store of the same sweep.
        batch: the members.
        times: t, s.
        shapes: types and shapes of the records of one member.
        description: all that determines the results.
        chunk: members of a chunk.
        whole: whether the particles themselves are saved.

    Raises:
        ValueError: for a folder or file that is something else, the store of another sweep or of
            another version, and for a store that is damaged.
        OSError: if it cannot be written.
        ModuleNotFoundError: without the extra `sweep`.
    """
    path = Path(path)
    if _absent(path):
        _make(path, batch, times, shapes, description, chunk, whole)
    group = _open_group(path)
    _check_same(path, dict(group.attrs), description)
    for name, found in labels(batch, times).items():
        stored = _values(path, _array(path, group, name, found[1]))
        if not np.array_equal(stored, found[1], equal_nan=True):
            raise _not_whole(path, f"other values in {name!r}")
    for name, of_one in shapes.items():
        _array(path, group, name, of_one, len(batch))
    _array(path, group, FINISHED, _flags(len(batch), chunk))
    return Store(path, group, tuple(sorted(shapes)), len(batch), chunk)


def _array(path: Path, group: Any, name: str, like: Any, *members: int) -> Any:
    """An array of a store, of the type and shape that it must have.

    Raises:
        ValueError: if there is no such array.
    """
    try:
        found = group[name]
        kind = (found.shape, found.dtype)
    except Exception as error:  # whatever zarr raises where something is lost or cut off
        raise _not_whole(path, f"no array {name!r} ({error})") from None
    if kind != ((*members, *like.shape), like.dtype):
        raise _not_whole(path, f"an array {name!r} of {kind[1]} and shape {kind[0]}")
    return found


def _values(path: Path, array: Any) -> np.ndarray:
    try:
        return np.asarray(array[...])
    except Exception as error:  # whatever a codec raises for a file that was cut off
        raise _not_whole(path, f"a damaged array {array.basename!r} ({error})") from None


def _not_whole(path: Path, has: str) -> ValueError:
    return ValueError(
        f"{path} has {has} and is not whole: copy the store again, or name another one"
    )


def _flags(num_members: int, chunk: int) -> np.ndarray:
    """A digest for each chunk, 0 before it is finished."""
    return np.zeros(-(-num_members // chunk), np.uint64)


def _absent(path: Path) -> bool:
    return not path.exists() or (path.is_dir() and not any(path.iterdir()))


def _open_group(path: Path) -> Any:
    zarr = import_extra("zarr", "sweep")
    try:
        if path.is_file():
            raise ValueError("it is a file")
        group = zarr.open_group(str(path), mode="r+", use_consolidated=False)
        attributes = dict(group.attrs)
        chunk, described = attributes.get("chunk"), attributes.get("description")
        if not (isinstance(chunk, int) and chunk > 0 and isinstance(described, dict)):
            raise ValueError("its attributes do not describe a sweep")
    except Exception as error:  # whatever zarr raises for a folder that holds something else
        raise ValueError(
            f"{path} is no store of a sweep ({error}): name another folder, or remove it"
        ) from None
    return group


def _check_same(path: Path, attributes: dict[str, Any], description: dict[str, str]) -> None:
    own = version("jaxgran")
    version_of, form = attributes.get("version"), attributes.get("format")
    if (form, version_of) != (FORMAT, own):
        raise ValueError(
            f"{path} was written by jaxgran {version_of} in format {form}, this is {own} with "
            f"format {FORMAT}, which may compute other numbers: finish the sweep "
            "with that version, or name another store"
        )
    differ = differences(attributes["description"], description)
    if differ:
        more = f" and {len(differ) - MAX_NAMED} more" if len(differ) > MAX_NAMED else ""
        raise ValueError(
            f"{path} belongs to another sweep: {'; '.join(differ[:MAX_NAMED])}{more}. Name "
            "another store, or remove it to begin anew"
        )


def _make(
    path: Path,
    batch: Batch,
    times: np.ndarray,
    shapes: Records,
    description: dict[str, str],
    chunk: int,
    whole: bool,
) -> None:
    """Make the group with all labels and no chunk, at once; leave it if another was faster."""
    zarr = import_extra("zarr", "sweep")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        partial.chmod(0o777 & ~_umask())
        group = zarr.open_group(str(partial), mode="w", zarr_format=3)
        for name, (dims, values, attributes) in labels(batch, times).items():
            array = group.create_array(
                name,
                shape=values.shape,
                dtype=values.dtype,
                dimension_names=dims,
                attributes=attributes,
            )
            array[...] = values
        for name, of_one in shapes.items():
            make_empty_array(group, name, of_one, len(batch), chunk, whole)
        group.create_array(
            FINISHED,
            shape=_flags(len(batch), chunk).shape,
            chunks=(1,),
            dtype=np.uint64,
            fill_value=0,
            dimension_names=(CHUNK,),
            attributes={"long_name": "digest of the values of a finished chunk, else 0"},
        )
        group.attrs.update(
            {
                "format": FORMAT,
                "version": version("jaxgran"),
                "chunk": chunk,
                "description": description,
                "coordinates": " ".join(sorted(batch.labels())),
            }
        )
        with warnings.catch_warnings():
            # The names and types of the arrays do not change any more.
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(str(partial))
        os.rename(partial, path)
    except OSError:
        shutil.rmtree(partial, ignore_errors=True)
        if _absent(path):
            raise
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _digest(records: Records) -> np.uint64:
    """A number > 0 that tells records apart."""
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
        return stack_curves(join_chunks(chunks), times, like)
    asked = {} if save is None else {"save": save}
    description = describe_run(
        gases=batch.gases, keys=batch.keys, times=times, model=model, chunk=chunk, **asked
    )
    shapes, whole = jax.eval_shape(records_of, like), save == "particles"
    kept = open_store(store, batch, np.asarray(times), shapes, description, chunk, whole)
    _finish(kept, computed, progress)
    return stack_curves(kept.read_all(), times, like)


def _finish(kept: Store, computed: Callable[[int], Records], progress: bool) -> None:
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
    return failed_records(records, out) if refused else records


def _checked_chunk(chunk: Any, store: Any, model: AbstractModel, number: int) -> int:
    """Members of a chunk: as given, of an existing store, or the default."""
    if not isinstance(store, str | os.PathLike | None):
        raise ValueError(f"store must be a path, got {store!r:.60}")
    if chunk is not None:
        return min(whole_number("chunk", chunk, 1), number)
    if store is not None and (stored := stored_chunk(Path(store))) is not None:
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
