"""A gas of hard spheres in reduced units."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float

from jaxgran.particles.hard.walls import HardWalls
from jaxgran.scene.reduced_scene import ReducedRough
from jaxgran.scene.restitution import ReducedLaw


class HardScene(NamedTuple):
    """A gas of hard spheres in units of its diameter, mass and first temperature.

    Attributes:
        side: of the periodic box.
        law: of restitution, for speeds in units of sqrt(2).
        collision_frequency: at T = 1.
        contact_time: in mean free times; the impact of a sphere within this time of its last one
            is elastic.
        elastic: whether all impacts are, and smooth.
        surface: of rough spheres; else None.
        walls: of a container; None where the box is periodic.
    """

    side: Float[Array, ""]
    law: ReducedLaw
    collision_frequency: Float[Array, ""]
    contact_time: Float[Array, ""]
    elastic: Bool[Array, ""]
    surface: ReducedRough | None = None
    walls: HardWalls | None = None

    @property
    def material(self) -> ReducedLaw:
        """The numbers that derivatives are followed in: those of the law."""
        return self.law
