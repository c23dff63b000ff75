"""Some pairs of a neighbour list, and the particles that belong to them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxgran.particles.bit_masks import rows_where


def marked(
    mask: Bool[Array, "n"], rows: Int[Array, "..."], where: Bool[Array, "..."]
) -> Bool[Array, "n"]:
    """Return a mask that is also True in some rows, where a condition holds for them."""
    return mask.at[jnp.where(where, rows, len(mask))].set(True, mode="drop")


class Selection(NamedTuple):
    """Selected pairs, and the particles that belong to them: the members.

    Attributes:
        rows: index of each selected pair in the given arrays.
        real: which of them hold a pair.
        members: particles, in increasing order; n in empty slots.
        first, second: slots of both particles of each pair among the members.
        num_rows: number of selected pairs. If it exceeds the capacity, pairs are missing.
        num_members: number of members. If it exceeds the capacity, members are missing.
    """

    rows: Int[Array, "rows"]
    real: Bool[Array, "rows"]
    members: Int[Array, "members"]
    first: Int[Array, "rows"]
    second: Int[Array, "rows"]
    num_rows: Int[Array, ""]
    num_members: Int[Array, ""]


def select_members(
    selected: Bool[Array, "all"],
    i: Int[Array, "all"],
    j: Int[Array, "all"],
    others: Bool[Array, "n"],
    *,
    max_rows: int,
    max_members: int,
) -> Selection:
    """Return the selected pairs, with the particles that belong to them or to `others`.

    Args:
        selected: mask of the pairs.
        i, j: indices of both particles of each pair.
        others: mask of further members.
        max_rows: capacity for pairs.
        max_members: capacity for members.
    """
    n = len(others)
    rows, real, num_rows = rows_where(selected, max_rows)
    ends = jnp.stack([i[rows], j[rows]])
    is_member = marked(others, ends, real[None])
    members, is_used, num_members = rows_where(is_member, max_members)
    members = jnp.where(is_used, members, n)
    slots = jnp.arange(max_members, dtype=jnp.int32)
    # Where members are missing, their slot belongs to another one: the caller rejects the block.
    slot = jnp.zeros(n, jnp.int32).at[members].set(slots, mode="drop")
    first, second = jnp.where(real[None], slot[ends], 0)
    return Selection(
        rows=rows,
        real=real,
        members=members,
        first=first,
        second=second,
        num_rows=num_rows,
        num_members=num_members,
    )
