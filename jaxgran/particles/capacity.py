"""Capacities: the fixed lengths of the arrays of a compiled run, from the expected numbers of rows.

Capacities are static, so that every new set of them is a compilation. They are computed for a
density (and a contact duration) that is rounded up to a geometric grid (`Grid`): gases that
differ little share a compiled program.
"""

from collections.abc import Sequence
from math import ceil, log, pi
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran._utils import status
from jaxgran.particles.neighbours import unsorted
from jaxgran.scene.geometry import contact_value, sphere_surface

FEW_PARTICLES = 128
"""Rows whose run time costs less than one more compilation."""

SMALL_NUMBER = 500
"""Particles of all replicas below which a run takes less time than a compilation."""


class Grid(NamedTuple):
    """The geometric grid of densities and contact durations for which capacities are computed.

    The grid of a small run is coarse, and its arrays are long. In a large one unused rows cost more
    than a compilation: its grid is fine, and what rounding up adds is taken from the spare rows.

    Attributes:
        ratio: of neighbouring grid points.
        spare: factor on the spare capacity.
    """

    ratio: float
    spare: float

    @classmethod
    def of(cls, num_particles: int) -> "Grid":
        """The grid for a number of particles of all replicas."""
        if num_particles < SMALL_NUMBER:
            return cls(1.5, 1.4)
        return cls(1.03, 1.03**-0.5)

    def up(self, value: float) -> float:
        """The least grid point, an integer power of the ratio, that is not below a value > 0."""
        power = ceil(log(value) / log(self.ratio) - 1e-9)
        return max(self.ratio**power, value)


GROWTH = Grid(1.3, 1.0)
"""The grid of capacities that have grown."""


class Capacity(NamedTuple):
    """Rows of the arrays of a compiled run.

    Attributes:
        pairs: in the neighbour list.
        lookahead: particles that a sweep compares each particle with.
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
        """The status of a run that needs so many rows of each kind."""
        full = needed > jnp.array(self)
        in_list = status.flag(status.LIST_FULL, jnp.any(full[:2]))
        return in_list | status.flag(status.CONTACTS_FULL, jnp.any(full[2:]))

    def grown(self, needed: Sequence[int]) -> "Capacity":
        """With more rows than needed wherever there are too few."""
        each = zip(self, needed, strict=True)
        return Capacity(*(r if n <= r else ceil(GROWTH.up(1.2 * n + 32)) for r, n in each))


class Neighbourhood(NamedTuple):
    """Expected numbers of neighbours in a homogeneous gas of rounded-up density.

    Attributes:
        in_contact: pairs per particle within contact, were the pair correlation 1.
        contact_value: pair correlation at contact.
        collision_frequency: at T = 1.
        listed: pairs per particle in the neighbour list.
        lookahead: particles of a box within the list's cutoff along x.
    """

    in_contact: float
    contact_value: float
    collision_frequency: float
    listed: float
    lookahead: float

    @classmethod
    def of(
        cls, side: float, num_particles: int, replicas: int, dimension: int, listed_more: float
    ) -> "Neighbourhood":
        """Of a box of a given side in diameters.

        Args:
            side: of the box.
            num_particles: in one box.
            replicas: number of boxes.
            dimension: d.
            listed_more: pairs per particle that the skin adds to the neighbour list.
        """
        per_volume = sphere_surface(dimension) / (2 * dimension)
        exact = per_volume * num_particles / side**dimension
        phi = exact / 2 ** (dimension - 1)
        phi = min(Grid.of(replicas * num_particles).up(phi), max(phi, 0.9))
        in_contact = phi * 2 ** (dimension - 1)
        side = (per_volume * num_particles / in_contact) ** (1 / dimension)
        skin = float(skin_adding(listed_more, num_particles, side, dimension))
        at_contact = float(contact_value(phi, dimension))
        frequency = 2 * dimension * in_contact * at_contact / pi**0.5
        listed = in_contact * (1 + skin) ** dimension
        return cls(
            in_contact, at_contact, frequency, listed, within_reach(num_particles, side, skin)
        )


def capacities(
    expected: Sequence[float], lookahead: float, spare: float, extra: float, num_particles: int
) -> tuple[Capacity, Capacity]:
    """Capacity of a run, and of the first mean free times of its melt.

    Args:
        expected: rows per particle: listed pairs, near pairs, contacts, members.
        lookahead: particles of a box within the cutoff along x.
        spare: capacity over expected rows; its root for the listed pairs, which vary least.
        extra: pairs per particle that are near contact besides, in random places.
        num_particles: of all replicas; members cannot be more.
    """
    spare = max(spare * Grid.of(num_particles).spare, 1.0)
    counts, spares = [num_particles * x for x in expected], (spare**0.5, spare, spare, spare)
    pairs, near, contacts, members = (
        int(s * x + 5 * x**0.5) + 64 for s, x in zip(spares, counts, strict=True)
    )
    lookahead = int(spare * lookahead + 5 * lookahead**0.5) + 64  # lattice planes need most
    rows = int(num_particles * extra)
    more_near, more_contacts = (min(kind + rows, pairs) for kind in (near, contacts))
    run = Capacity(pairs, lookahead, near, contacts, min(members, num_particles))
    more_members = min(members + 2 * rows, num_particles)
    melt = Capacity(pairs, lookahead, more_near, more_contacts, more_members)
    return (melt if rows <= FEW_PARTICLES else run), melt


def skin_adding(more: float, num_particles: int, side: ArrayLike, dimension: int) -> Array:
    """Skin, in diameters, that adds `more` listed pairs per particle."""
    surface = num_particles * sphere_surface(dimension) / (2 * dimension)
    in_contact = surface / jnp.asarray(side**dimension)
    return jnp.minimum((1 + more / in_contact) ** (1 / dimension) - 1, longest_skin(side))


def within_reach(num_particles: int, side: ArrayLike, skin: ArrayLike) -> float:
    """Particles of a homogeneous gas that a sweep must look ahead, for contact and a skin."""
    along_x = jnp.minimum((1 + jnp.asarray(skin)) / jnp.asarray(side), 0.5)
    return float(num_particles * (along_x + 3 * unsorted(num_particles)))


def longest_skin(side: ArrayLike) -> Float[Array, ""]:
    """The longest skin, in diameters, at which no sphere sees another one and its image."""
    return 0.5 * jnp.asarray(side) * (1 - 1e-6) - 1
