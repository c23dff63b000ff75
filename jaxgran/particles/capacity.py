"""Capacities: the fixed lengths of the arrays of a compiled run, from the expected numbers of rows.

Capacities are static, so that every new set of them needs a compilation. They are computed for a
density (and a contact duration) that is rounded up to a geometric grid (`grid`): gases that
differ little share a compiled program.
"""

from collections.abc import Sequence
from math import ceil, log, pi
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Int

from jaxgran._utils import status
from jaxgran.particles.bit_masks import WORD
from jaxgran.particles.neighbours.cells import expected_run
from jaxgran.particles.neighbours.lists import compiled_engine
from jaxgran.particles.neighbours.sweep import unsorted_share
from jaxgran.scene.geometry import contact_value, sphere_surface

MAX_SHARED_ROWS = 128
"""Number of unused rows up to which they cost less time than another compilation."""

SMALL_RUN = 500
"""Number of particles of all replicas below which a run takes less time than a compilation."""

SPARE_ROWS = 16
"""Rows of each array beyond those that are expected, and five times their scatter."""

GROWTH = 1.3
"""Ratio of neighbouring capacities of arrays that were enlarged."""


def grid(num_particles: int) -> tuple[float, float]:
    """Return the grid of densities and contact durations for which capacities are computed.

    The grid of a small run is coarse, and its arrays are long. In a large run unused rows cost more
    than a compilation: its grid is fine, and fewer spare rows compensate for the rounding.

    Args:
        num_particles: number of particles of all replicas.

    Returns:
        The ratio of neighbouring grid points, see `round_up`, and a factor on the spare capacity.
    """
    return (1.5, 1.2) if num_particles < SMALL_RUN else (1.03, 1.03**-0.5)


def round_up(value: float, ratio: float) -> float:
    """Round a value > 0 up to a point of a geometric grid: an integer power of a ratio."""
    return max(ratio ** ceil(log(value) / log(ratio) - 1e-9), value)


class Capacity(NamedTuple):
    """Numbers of rows of the arrays of a compiled run.

    Attributes:
        pairs: pairs in the neighbour list.
        lookahead: particles with which a search compares each particle: a sweep with the following
            ones, cells with those in a run of cells.
        near: listed pairs that are near contact in a block (window).
        contacts: pairs that may be in contact in it.
        members: particles of those pairs.
    """

    pairs: int
    lookahead: int
    near: int
    contacts: int
    members: int

    def exceeded_by(self, needed: Int[Array, "kinds"]) -> Int[Array, ""]:
        """Return the status of a run that needs these numbers of rows."""
        full = needed > jnp.array(self, needed.dtype)
        in_list = status.flag(status.LIST_FULL, jnp.any(full[:2]))
        return in_list | status.flag(status.CONTACTS_FULL, jnp.any(full[2:]))

    def of_batch(self, members: int) -> "Capacity":
        """Return a capacity for several such gases in one array."""
        rows = (members * x for x in self)
        return Capacity(*rows)._replace(lookahead=self.lookahead)

    def grown(self, needed: Sequence[int]) -> "Capacity":
        """Return a capacity with more rows wherever more are needed than there are."""
        pairs = zip(self, needed, strict=True)
        return Capacity(*(r if n <= r else ceil(round_up(1.2 * n + 32, GROWTH)) for r, n in pairs))


class Neighbourhood(NamedTuple):
    """Expected numbers of neighbours in a homogeneous gas, whose density is rounded up.

    Attributes:
        in_contact: pairs per particle closer than contact if the pair correlation were 1.
        contact_value: pair correlation at contact.
        collision_frequency: collision frequency at T = 1.
        listed: pairs per particle in the neighbour list.
        engine: search for pairs in compiled code, "sweep" or "cells".
        lookahead: particles of a box within the list's cutoff along x (sweep) or in a run (cells).
    """

    in_contact: float
    contact_value: float
    collision_frequency: float
    listed: float
    engine: str
    lookahead: float

    @classmethod
    def expected(
        cls,
        side: float,
        num_particles: int,
        replicas: int,
        dimension: int,
        listed_more: float,
        *,
        engine: str,
        longer: float,
    ) -> "Neighbourhood":
        """Return the numbers for a box.

        Args:
            side: side of a cube that the particles fill, in diameters.
            num_particles: number of particles in one box.
            replicas: number of boxes.
            dimension: dimension d.
            listed_more: pairs per particle that the skin adds to the neighbour list.
            engine: one of `neighbours.lists.ENGINES`.
            longer: factor on the look-ahead of a sweep, of boxes that are shorter along x.
        """
        per_volume = sphere_surface(dimension) / (2 * dimension)
        exact = per_volume * num_particles / side**dimension
        phi = exact / 2 ** (dimension - 1)
        phi = min(round_up(phi, grid(replicas * num_particles)[0]), max(phi, 0.9))
        in_contact = phi * 2 ** (dimension - 1)
        side = (per_volume * num_particles / in_contact) ** (1 / dimension)
        skin = float(skin_for_pairs(listed_more, num_particles, side, dimension))
        at_contact = contact_value(phi, dimension)
        frequency = 2 * dimension * in_contact * at_contact / pi**0.5
        listed = in_contact * (1 + skin) ** dimension
        cutoff = (1 + skin) / side
        lookahead = num_particles * (min(cutoff, 0.5) + 3 * unsorted_share(num_particles))
        lookahead = min(lookahead * longer, float(num_particles))
        engine = compiled_engine(engine, lookahead)
        if engine == "cells":
            lookahead = expected_run(num_particles, cutoff, dimension)
        return cls(in_contact, at_contact, frequency, listed, engine, lookahead)

    def lookahead_capacity(self, spare: float) -> int:
        """Return the capacity of the look-ahead, by a factor on the expected one."""
        most = spare * self.lookahead + 5 * self.lookahead**0.5
        if self.engine == "cells":
            return WORD * ceil(most / WORD)  # a word of comparisons is as fast as a part of it
        return int(most) + 64  # planes of a lattice need most


def capacities(
    expected: Sequence[float],
    around: Neighbourhood,
    spare: float,
    extra: float,
    num_particles: int,
) -> tuple[Capacity, Capacity]:
    """Return the capacities of a run and of the first mean free times of its equilibration.

    Args:
        expected: rows per particle: listed pairs, near pairs, contacts, members.
        around: expected numbers of neighbours.
        spare: capacity over expected rows; its root is used for the listed pairs, which vary least.
        extra: additional pairs per particle near contact at random initial positions.
        num_particles: number of particles of all replicas, the largest number of members.
    """
    spare = max(spare * grid(num_particles)[1], 1.0)
    counts = [num_particles * x for x in expected]
    spares = (spare**0.5, spare, spare, spare)
    pairs, near, contacts, members = (
        int(s * x + 5 * x**0.5) + SPARE_ROWS for s, x in zip(spares, counts, strict=True)
    )
    lookahead = around.lookahead_capacity(spare)
    rows = int(num_particles * extra)
    more_near, more_contacts = (min(kind + rows, pairs) for kind in (near, contacts))
    run = Capacity(pairs, lookahead, near, contacts, min(members, num_particles))
    more_members = min(members + 2 * rows, num_particles)
    equilibration = Capacity(pairs, lookahead, more_near, more_contacts, more_members)
    return (equilibration if rows <= MAX_SHARED_ROWS else run), equilibration


def skin_for_pairs(listed_more: float, num_particles: int, side: ArrayLike, dimension: int) -> Any:
    """Return the skin, in diameters, that adds `listed_more` listed pairs per particle."""
    volume = num_particles * sphere_surface(dimension) / (2 * dimension)
    in_contact = volume / side**dimension
    skin = (1 + listed_more / in_contact) ** (1 / dimension) - 1
    longest = max_skin(side)
    return min(skin, longest) if isinstance(side, float) else jnp.minimum(skin, longest)


def max_skin(side: ArrayLike) -> Any:
    """Return the longest skin, in diameters, with which no pair is listed with two images."""
    return 0.5 * side * (1 - 1e-6) - 1
