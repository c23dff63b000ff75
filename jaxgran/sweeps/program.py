"""What the devices of a process run: the members of one chunk, in one compiled program."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran.checks import status
from jaxgran.data import saved
from jaxgran.data.curve import CoolingCurve, Particles
from jaxgran.data.saved import OF_REPLICAS
from jaxgran.data.tables import UNITS
from jaxgran.models.base import AbstractModel
from jaxgran.models.cooling import cool
from jaxgran.models.spheres import AbstractSpheres, Plan
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.interruption import waited_for
from jaxgran.scene.gas import Gas
from jaxgran.sweeps.batch import Keys

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
        saved.leaves(like)
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
            records = {name: np.asarray(x)[:number] for name, x in waited_for(out).items()}
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
    known = {name: getattr(curve, name) for name in UNITS if name != "times"}
    if curve.replicas is not None:
        each = {name: getattr(curve.replicas, name) for name in UNITS if name != "times"}
        known |= {f"{name}{OF_REPLICAS}": values for name, values in each.items()}
    found = {name: values for name, values in known.items() if values is not None}
    fault = status.OK if curve.status is None else curve.status
    return found | saved.leaves(curve) | {STATUS: jnp.asarray(fault, jnp.int32)}


def failed(records: Records, rows: np.ndarray) -> Records:
    """The records with some members nan, and with the status of a gas that is not taken.

    Saved whole numbers, which cannot be nan, are 0.
    """
    changed = {}
    for name, values in records.items():
        values = np.array(values)
        values[rows] = status.NOT_TAKEN.bit if name == STATUS else unknown(values.dtype)
        changed[name] = values
    return changed


def unknown(dtype: Any) -> Any:
    """A value of some type for what is not known: nan where it has one, else 0."""
    return np.nan if np.issubdtype(dtype, np.inexact) else np.zeros((), dtype)[()]


def joined(chunks: Sequence[Records]) -> Records:
    """The records of several chunks, one after the other."""
    return {name: np.concatenate([each[name] for each in chunks]) for name in chunks[0]}


def curves(records: Records, times: Array, like: CoolingCurve | None) -> CoolingCurve:
    """The curves of all members in one, as `jax.vmap` returns them, without particles.

    Args:
        records: of all members.
        times: t, s.
        like: of `Program.like`, if something was saved.
    """

    def of_one(records: Records) -> CoolingCurve:
        kept = {k: x for k, x in records.items() if saved.is_saved(k)}
        records = {k: x for k, x in records.items() if k not in kept}
        plain = {k: x for k, x in records.items() if not k.endswith(OF_REPLICAS)}
        names = [k.removesuffix(OF_REPLICAS) for k in records.keys() - plain.keys()]
        each = {name: records[f"{name}{OF_REPLICAS}"] for name in names}
        replicas = CoolingCurve(times=times, **each) if each else None
        curve = CoolingCurve(times=times, **plain, replicas=replicas)
        return curve if like is None else saved.with_leaves(curve, like, kept)

    return jax.vmap(of_one)({name: jnp.asarray(values) for name, values in records.items()})


def _sized(model: AbstractSpheres, gases: Sequence[Gas], spare: float) -> AbstractSpheres:
    """A model whose arrays are long enough, and whose blocks are short enough, for some gases."""
    plans = [plan for gas in gases if (plan := model.sized_for(gas, spare).plan) is not None]
    pace = type(plans[0].pace)(*map(min, zip(*(plan.pace for plan in plans), strict=True)))
    run, melt = (
        Capacity(*map(max, zip(*each, strict=True)))
        for each in zip(*((p.capacity, p.melt_capacity) for p in plans), strict=True)
    )
    return dataclasses.replace(model, plan=Plan(plans[0].replicas, pace, run, melt))
