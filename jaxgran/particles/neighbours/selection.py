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
        rows: of the pairs, in the arrays from which they were selected.
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
    rows, num_rows = rows_where(selected, max_rows)
    real = jnp.arange(max_rows, dtype=jnp.int32) < num_rows
    rows = jnp.where(real, rows, 0)
    ends = jnp.stack([i[rows], j[rows]])
    is_member = marked(others, ends, real[None])
    members, num_members = rows_where(is_member, max_members)
    slots = jnp.arange(max_members, dtype=jnp.int32)
    slot = jnp.zeros(n, jnp.int32).at[members].set(slots, mode="drop")
    first, second = jnp.where(real[None], slot[ends], 0)
    return Selection(rows, real, members, first, second, num_rows, num_members)
