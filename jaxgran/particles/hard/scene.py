"""A gas of hard spheres in reduced units."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxgran.particles.hard.walls import HardWalls
from jaxgran.scene.reduced_scene import ReducedDrag, ReducedDrive, ReducedRough
from jaxgran.scene.restitution import ReducedLaw
from jaxgran.scene.shear import mean_loss


class Material(NamedTuple):
    """The numbers of a scene with elements that derivatives are followed in.

    Attributes:
        law, surface, drag, drive: as in `HardScene`.
        wall_law, wall_beta, wall_frequency: of `HardWalls`.
    """

    law: ReducedLaw
    surface: ReducedRough | None
    drag: ReducedDrag | None
    drive: ReducedDrive | None
    wall_law: ReducedLaw | None
    wall_beta: Float[Array, "..."] | None
    wall_frequency: Float[Array, "..."] | None


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
        drag: rates over the collision frequency; None in a vacuum. Time and velocities are then
            transformed, see `jaxgran.particles.drag`.
        drive: growth of T over the collision frequency by white noise; None where there is none.
        prepared: () where the gas begins in the steady state of such a drive; else None.
    """

    side: Float[Array, ""]
    law: ReducedLaw
    collision_frequency: Float[Array, ""]
    contact_time: Float[Array, ""]
    elastic: Bool[Array, ""]
    surface: ReducedRough | None = None
    walls: HardWalls | None = None
    drag: ReducedDrag | None = None
    drive: ReducedDrive | None = None
    prepared: tuple[()] | None = None

    @property
    def has_elements(self) -> bool:
        """Whether there is more than smooth spheres in free flight."""
        return any(x is not None for x in (self.surface, self.walls, self.drag, self.drive))

    @property
    def material(self) -> ReducedLaw | Material:
        """The numbers that derivatives are followed in: those of the law, and of elements.

        All are per collision, so that a denser gas does the same sooner.
        """
        if not self.has_elements:
            return self.law
        found = Material(self.law, self.surface, self.drag, self.drive, None, None, None)
        if self.walls is None:
            return found
        _, law, beta, frequency = self.walls
        return found._replace(wall_law=law, wall_beta=beta, wall_frequency=frequency)

    def log_loss(self, material: ReducedLaw) -> Float[Array, ""]:
        """ln of ``I/(1 - I)`` with the share I of the normal energy that impacts take."""
        lost = mean_loss(material, self.side)
        return jnp.log(lost) - jnp.log1p(-lost)

    def with_material(self, material: Any) -> "HardScene":
        """The same scene with other numbers of its material."""
        if not self.has_elements:
            return self._replace(law=material)
        walls = self.walls
        if walls is not None:
            law: Any = material.wall_law
            frequency: Any = material.wall_frequency
            walls = walls._replace(law=law, beta=material.wall_beta, frequency=frequency)
        return self._replace(
            law=material.law,
            surface=material.surface,
            walls=walls,
            drag=material.drag,
            drive=material.drive,
        )

    def by_impacts(self, elastic: bool) -> "HardScene":
        """The scene of a melt, without drag and drive; with elastic and smooth impacts or not."""
        drag = None if self.drag is None else ReducedDrag(*(0 * x for x in self.drag))
        drive = None if self.drive is None else ReducedDrive(0 * self.drive.strength)
        return self._replace(elastic=self.elastic | elastic, drag=drag, drive=drive)

    @property
    def decay_rates(self) -> ReducedDrag:
        """The drag in the units of the scene's time."""
        assert self.drag is not None
        rate, nu = self.drag, self.collision_frequency
        return ReducedDrag(rate.rate * nu, rate.rotational_rate * nu)
