"""The arrays of a store: their dimensions, units and first values."""

from typing import Any

import numpy as np

from jaxgran.data import saved
from jaxgran.data.saved import OF_REPLICAS, REPLICA, TIME
from jaxgran.data.tables import UNITS
from jaxgran.scene import gas_words
from jaxgran.sweeps.batch import INITIAL, Batch
from jaxgran.sweeps.program import STATUS, unknown

MEMBER = "member"


def labels(batch: Batch, times: np.ndarray) -> dict[str, Any]:
    """Coordinates: dimensions, values and attributes, by name."""
    found = {
        MEMBER: ((MEMBER,), np.arange(len(batch)), {}),
        TIME: ((TIME,), times, {"units": UNITS["times"]}),
    }
    for name, (values, of_members) in batch.labels().items():
        dims = (MEMBER,) if of_members else ()
        dims += tuple(f"{name}_{k}" for k in range(values.ndim - len(dims)))  # of a list
        unit = gas_words.UNITS.get(name.removeprefix(INITIAL), "1")
        found[name] = (dims, values, {"units": unit})
    return found


def empty(
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
        fill_value=unknown(of_one.dtype),
        dimension_names=(MEMBER, *dims),
        attributes=attributes,
    )


def _described(name: str, ndim: int, whole: bool) -> tuple[tuple[str, ...], dict[str, str]]:
    """Labels of the axes of one member's record, and its attributes."""
    words = name.replace("_", " ")
    if name == STATUS:
        return (), {"long_name": "faults, see jaxgran.explain_status"}
    if saved.is_saved(name):
        unit = saved.unit(name, whole)
        attributes = {"long_name": words} | ({} if unit is None else {"units": unit})
        return saved.dimensions(name, ndim, whole), attributes
    quantity = name.removesuffix(OF_REPLICAS)
    dims = (TIME,) if quantity == name else (REPLICA, TIME)
    return dims, {"units": UNITS[quantity], "long_name": words}
