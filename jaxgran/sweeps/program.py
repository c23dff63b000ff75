"""What the devices of a process run: the members of one chunk, in one compiled program."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran.checks import status
from jaxgran.data.curve import CoolingCurve
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

OF_REPLICAS = "_of_replicas"
"""The ending of the names of records that have an axis of replicas."""

STATUS = "status"

FULL = status.LIST_FULL.bit | status.CONTACTS_FULL.bit

Records = dict[str, Any]
"""Arrays by name, with a first axis of members."""


class Program(NamedTuple):
    """A model, and the devices of this process on which members run.

    Attributes:
        models: the model with arrays of several lengths, the shortest first.
        times: t, s.
        mesh: the devices.
        each: members that a device takes in one call.
    """

    models: tuple[AbstractModel, ...]
    times: Float[Array, "times"]
    mesh: Mesh
    each: int

    @classmethod
    def of(
        cls,
        model: AbstractModel,
        times: Float[Array, "times"],
        chunk: int,
        members: Sequence[Gas],
    ) -> "Program":
        """For all devices of this process, which share a chunk.

        Args:
            model: as the user gave it.
            times: t, s.
            chunk: most members of one call.
            members: the gases of known numbers that arrays must hold.
        """
        devices = np.array(jax.local_devices()[:chunk])
        models = (model,)
        if isinstance(model, AbstractSpheres) and model.plan is None:
            models = tuple(_sized(model, members, spare) for spare in SPARE)
        return cls(models, times, Mesh(devices, (DEVICE,)), -(-chunk // len(devices)))

    def shapes(self, gas: Gas, key: PRNGKeyArray) -> Records:
        """Types and shapes of the records of a member, without its axis."""
        return jax.eval_shape(partial(_records, self.models[0], self.times), gas, key)

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
            out = _over_devices(model, gases, keys, self.times, self.mesh, _one_by_one(model))
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
) -> Records:
    arrays, rest = eqx.partition((model, times), eqx.is_array)

    def some(arrays, gases, keys):
        one = partial(_records, *eqx.combine(arrays, rest))
        if one_by_one:
            return jax.lax.map(lambda each: one(*each), (gases, keys))
        return jax.vmap(one)(gases, keys)

    members, same = PartitionSpec(DEVICE), PartitionSpec()
    # The loops of a member have no axis of devices, which the check would ask them to declare.
    over = jax.shard_map(
        some, mesh=mesh, in_specs=(same, members, members), out_specs=members, check_vma=False
    )
    return over(arrays, gases, keys)


def _records(model: AbstractModel, times: Array, gas: Gas, key: PRNGKeyArray) -> Records:
    """What is recorded of one member: the quantities of its curve, of its replicas, its status."""
    curve = cool(gas, times, model=model, key=key)
    known = {name: getattr(curve, name) for name in UNITS if name != "times"}
    if curve.replicas is not None:
        each = {name: getattr(curve.replicas, name) for name in UNITS if name != "times"}
        known |= {f"{name}{OF_REPLICAS}": values for name, values in each.items()}
    found = {name: values for name, values in known.items() if values is not None}
    fault = status.OK if curve.status is None else curve.status
    return found | {STATUS: jnp.asarray(fault, jnp.int32)}


def failed(records: Records, rows: np.ndarray) -> Records:
    """The records with some members nan, and with the status of a gas that is not taken."""
    changed = {}
    for name, values in records.items():
        values = np.array(values)
        values[rows] = status.NOT_TAKEN.bit if name == STATUS else np.nan
        changed[name] = values
    return changed


def joined(chunks: Sequence[Records]) -> Records:
    """The records of several chunks, one after the other."""
    return {name: np.concatenate([each[name] for each in chunks]) for name in chunks[0]}


def curves(records: Records, times: Array) -> CoolingCurve:
    """The curves of all members in one, as `jax.vmap` returns them, without particles."""

    def of_one(records: Records) -> CoolingCurve:
        plain = {k: x for k, x in records.items() if not k.endswith(OF_REPLICAS)}
        names = [k.removesuffix(OF_REPLICAS) for k in records.keys() - plain.keys()]
        each = {name: records[f"{name}{OF_REPLICAS}"] for name in names}
        replicas = CoolingCurve(times=times, **each) if each else None
        return CoolingCurve(times=times, **plain, replicas=replicas)

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
