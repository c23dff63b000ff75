"""How many pairs of spheres there are within some reach, and the room that arrays of them need."""

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran import status
from jaxgran.gas import sphere_surface
from jaxgran.sweep_and_prune import unsorted

FEW = 128
"""Rows that cost less than to compile once more."""


class Room(NamedTuple):
    """How many rows the arrays of a compiled run have."""

    pairs: int
    ahead: int  # particles, that a sweep can look
    near: int
    contacts: int
    members: int

    def outgrown_by(self, needed: Int[Array, "kinds"]) -> Int[Array, ""]:
        """The status of a run that needs so many rows of each."""
        full = needed > jnp.array(self)
        in_list = status.flag(status.LIST_FULL, jnp.any(full[:2]))
        return in_list | status.flag(status.CONTACTS_FULL, jnp.any(full[2:]))

    def grown(self, needed: Sequence[int]) -> "Room":
        """With more rows than needed where there are fewer."""
        return Room(
            *(r if n <= r else int(1.3 * n) + 32 for r, n in zip(self, needed, strict=True))
        )


def rooms(
    expected: Sequence[float], ahead: float, spare: float, more: float, num_particles: int
) -> tuple[Room, Room]:
    """Room of a run, and of its melt as that begins.

    Args:
        expected: rows a particle of each kind: pairs, near ones, contacts, members.
        ahead: particles of a box within reach along x.
        spare: room over that; its root for the pairs listed, which vary least.
        more: rows a particle besides, of pairs near each other, in random places.
        num_particles: of all replicas; no more can be members.
    """
    counts, spares = [num_particles * x for x in expected], (spare**0.5, spare, spare, spare)
    pairs, near, contacts, members = (
        int(s * x + 5 * x**0.5) + 64 for s, x in zip(spares, counts, strict=True)
    )
    ahead = int(spare * ahead + 5 * ahead**0.5) + 64  # planes of a lattice need most
    extra = int(num_particles * more)
    near_too, contacts_too = (min(rows + extra, pairs) for rows in (near, contacts))
    room = Room(pairs, ahead, near, contacts, min(members, num_particles))
    members_too = min(members + 2 * extra, num_particles)
    melting = Room(pairs, ahead, near_too, contacts_too, members_too)
    return (melting if extra <= FEW else room), melting


def pairs_in_contact(num_particles: int, side: ArrayLike, dimension: int) -> Array:
    """Pairs a particle within contact, were the pair correlation 1."""
    return (
        num_particles * sphere_surface(dimension) / (2 * dimension) / jnp.asarray(side**dimension)
    )


def contact_value(collision_frequency: Array, inside: float, dimension: int) -> float:
    """Pair correlation at contact, from the collisions of a particle at T = 1."""
    return float(collision_frequency) * pi**0.5 / (2 * dimension * inside)


def skin_with(more: float, num_particles: int, side: ArrayLike, dimension: int) -> Array:
    """Reach beyond contact, in diameters, in which so many more pairs a particle are listed."""
    inside = pairs_in_contact(num_particles, side, dimension)
    return jnp.minimum((1 + more / inside) ** (1 / dimension) - 1, longest_skin(side))


def within_reach(num_particles: int, side: ArrayLike, skin: ArrayLike) -> float:
    """Particles that a sweep over an even gas must look ahead, for contact and a skin."""
    along_x = jnp.minimum((1 + jnp.asarray(skin)) / jnp.asarray(side), 0.5)
    return float(num_particles * (along_x + 3 * unsorted(num_particles)))


def longest_skin(side: ArrayLike) -> Float[Array, ""]:
    """The longest skin, in diameters, in whose reach a sphere meets no sphere and its image."""
    return 0.5 * jnp.asarray(side) * (1 - 1e-6) - 1
