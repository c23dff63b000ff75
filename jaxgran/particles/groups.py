"""Groups of replicas: one program runs for each of them, on one device or several.

A run on the host consists of groups of replicas, the first axis of its state: one group of all
replicas, which share arrays, or a group for each replica (`grouped`). Groups run one after the
other on a device, and side by side on several CPU devices
(`jax.config.update("jax_num_cpu_devices", 2)`), because XLA works through sorts, sums and scatters
on one core. Each group has a key, a step, a neighbour list and arrays of its own: its numbers are
independent of the number of devices.

Small replicas of spheres on one device share one array, which saves the overhead of many short
operations. They share every quantity that the state holds once: the length of blocks or windows,
which the fastest spheres of all replicas decide, refined steps, and the skin, and thereby the times
of new neighbour lists. Each replica is as accurate as alone, but not the same bit for bit, and so,
after some collisions, another sample of the same gas. Replicas of `MIN_SPHERES_PER_RUN` spheres and
more run one after the other even on one CPU device: one array does not save time any more. Replicas
of DSMC share nothing but the array: each has its own steps and random numbers.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, PRNGKeyArray

from jaxgran._utils.tracing import fast_compilation
from jaxgran.gradients.rule import Records

MIN_SPHERES_PER_RUN = 8192
"""Smallest number of spheres in a replica with which replicas run one after the other.

Run time of four replicas one after the other, over the run time of the same four in one array, on
one core:

    spheres     1000   2000   4096
    hard         1.4    1.1    0.9
    soft         1.4    1.3    1.1
"""

GROUPS = "groups"
"""Name of the axis of groups of replicas, which devices share."""

T = TypeVar("T")


class Groups(NamedTuple):
    """Groups of replicas of a run on the host.

    Attributes:
        number: number of groups.
        devices: CPU devices that share the groups; () for the default device alone.
    """

    number: int
    devices: tuple[Any, ...] = ()

    @property
    def rows(self) -> np.ndarray:
        """Groups that are run: the last one is repeated until devices have the same number."""
        shared = max(len(self.devices), 1)
        return np.minimum(np.arange(-(-self.number // shared) * shared), self.number - 1)

    def keys(self, key: PRNGKeyArray) -> Array:
        """Return a key for each group.

        A single group has `key`; group k of several has ``fold_in(key, k)``.
        """
        if self.number == 1:
            return key[None]
        return jax.vmap(partial(jax.random.fold_in, key))(self.rows)

    def split(self, arrays: Any) -> Any:
        """Return arrays of all replicas with a first axis of groups; None remains None."""
        rows = self.rows
        return jax.tree.map(lambda x: x.reshape(self.number, -1, x.shape[-1])[rows], arrays)

    def join(self, arrays: Any, axis: int = 0) -> Any:
        """Return arrays in which an axis of groups is joined with the next axis, of replicas."""

        def joined(x: Any) -> Array:
            kept = np.take(np.asarray(x), np.arange(self.number), axis)
            replicas = kept.shape[axis] * kept.shape[axis + 1]  # there may be no directions: not -1
            shape = *kept.shape[:axis], replicas, *kept.shape[axis + 2 :]
            return jnp.asarray(kept.reshape(shape))

        return jax.tree.map(joined, arrays)

    def join_records(self, records: Records) -> Records:
        """Return the records of all replicas; their axes are times and groups."""
        others = self.join(records._replace(tangents={}), axis=1)
        # Directions come before replicas.
        tangents = jax.tree.map(lambda x: np.moveaxis(x, 1, 2), records.tangents)
        return others._replace(tangents=self.join(tangents, axis=2))


def grouped(replicas: int, spheres: int) -> Groups:
    """Return the groups of replicas: one of all of them, or one of each on CPU devices.

    There is one group on one device where each replica has less than `MIN_SPHERES_PER_RUN` spheres,
    on an accelerator, and if the user has chosen a device by `jax.default_device`.

    Args:
        replicas: number of replicas.
        spheres: number in each replica, 0 for DSMC.
    """
    chosen = jax.config.jax_default_device  # type: ignore[attr-defined]
    if replicas == 1 or jax.default_backend() != "cpu" or chosen is not None:
        return Groups(1)
    devices = tuple(jax.local_devices()[:replicas])
    if len(devices) > 1:
        return Groups(replicas, devices)
    return Groups(replicas if spheres >= MIN_SPHERES_PER_RUN else 1)


@cache
def over_groups(
    function: Callable[[Any, Any], T],
    devices: tuple[Any, ...],
    short: bool = False,
) -> Callable[[Any, Any], T]:
    """Return a compiled function that calls a function for each group of replicas.

    Args:
        function: of an input that all groups share, and of the input of one group.
        devices: that share the groups; () for the default device.
        short: whether the program runs for a short time. It is then compiled in three fifths of the
            time, and runs 5 to 40 % slower.
    """

    def call(shared: Any, groups: Any) -> T:
        return jax.lax.map(partial(function, shared), groups)

    options = fast_compilation(jax.default_backend()) if short else {}
    if devices:
        # With check_vma, shard_map would require all loops to declare the axis of groups.
        specs = PartitionSpec(), PartitionSpec(GROUPS)
        mesh = Mesh(np.array(devices), (GROUPS,))
        call = jax.shard_map(call, mesh=mesh, in_specs=specs, out_specs=specs[1], check_vma=False)
        # XLA would divide the operations of each group among threads of all cores, which then wait
        # for each other: two replicas of DSMC would take 15 to 20 % longer.
        options = options | {"xla_cpu_multi_thread_eigen": False}
    return jax.jit(call, compiler_options=options)
