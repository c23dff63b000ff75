"""A gas of soft spheres in reduced units."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles.soft.walls import SoftWalls
from jaxgran.tangents.thermal import ElementMaterial


class SoftDrag(NamedTuple):
    """`jaxgran.StokesDrag` in reduced units.

    Attributes:
        per_collision: gamma over the collision frequency at T = 1.
        rotational_rate: of spins.
    """

    per_collision: Float[Array, ""]
    rotational_rate: Float[Array, ""]


class SoftSurface(NamedTuple):
    """`jaxgran.Frictional` in reduced units.

    Attributes:
        damping: x_t.
        friction: mu.
        inertia: q.
        ratio: T_rot/T at t = 0.
    """

    damping: Float[Array, ""]
    friction: Float[Array, ""]
    inertia: Float[Array, ""]
    ratio: Float[Array, ""]


class SoftScene(eqx.Module):
    """A gas of viscoelastic spheres in units of its diameter, mass and first temperature.

    Attributes:
        side: of the periodic box; it encloses a container, see `jaxgran.particles.soft.walls`.
        alpha: elastic constant over effective mass.
        dissipative_constant: A.
        contact_duration: mean duration of an elastic contact at T = 1.
        collision_frequency: collisions per particle and time at T = 1.
        clipped: whether contact ends where the force vanishes, or else where the overlap does.
        walls, drag, surface: elements of the scene; None is what it does not have.
    """

    side: Float[Array, ""]
    alpha: Float[Array, ""]
    dissipative_constant: Float[Array, ""]
    contact_duration: Float[Array, ""]
    collision_frequency: Float[Array, ""]
    clipped: bool = eqx.field(static=True, default=True)
    walls: SoftWalls | None = None
    drag: SoftDrag | None = None
    surface: SoftSurface | None = None

    @property
    def plain(self) -> bool:
        """Whether there are smooth spheres in free flight and nothing else."""
        return self.walls is None and self.drag is None and self.surface is None

    @property
    def inertial(self) -> bool:
        """Whether nothing is at rest beside the spheres: no walls and no gas that drags."""
        return self.walls is None and self.drag is None

    @property
    def material(self) -> tuple[Any, ...]:
        """The numbers that derivatives are followed in: (alpha, A) and, where there are some, those
        of walls and drag, of which gamma is over the collision frequency; or their tangents."""
        own = self.alpha, self.dissipative_constant
        if self.inertial:
            return own
        drag = None if self.drag is None else self.drag.per_collision
        return *own, self._of_elements(drag)

    def with_material(self, material: tuple[Array, Array]) -> "SoftScene":
        """The same scene of smooth spheres in free flight with another (alpha, A)."""
        alpha, constant = material
        return dataclasses.replace(self, alpha=alpha, dissipative_constant=constant)

    def log_loss(self, material: tuple[Array, Array]) -> Float[Array, ""]:
        """ln of an impact's loss, up to a constant: of ``A alpha^(2/5)``, which it is as."""
        alpha, constant = material
        return jnp.log(constant) + 0.4 * jnp.log(alpha)

    @property
    def of_elements(self) -> ElementMaterial:
        """The numbers of walls and drag."""
        drag = self.drag
        return self._of_elements(
            None if drag is None else drag.per_collision * self.collision_frequency
        )

    def _of_elements(self, drag: Any) -> ElementMaterial:
        if self.walls is None:
            return ElementMaterial(drag=drag)
        return ElementMaterial(self.walls.alpha, self.walls.dissipative_constant, drag)

    @property
    def shortest_contact(self) -> Float[Array, ""]:
        """Mean duration of the shorter contacts, on spheres or walls, at T = 1."""
        if self.walls is None:
            return self.contact_duration
        # Durations go as alpha^(-2/5) v^(-1/5).
        on_wall = self.contact_duration * (self.alpha / self.walls.alpha) ** 0.4
        return jnp.minimum(self.contact_duration, on_wall)

    @property
    def filled_side(self) -> Float[Array, ""]:
        """Side of a cube (square) of the volume in which the spheres are."""
        if self.walls is None:
            return self.side
        return jnp.prod(self.walls.sides) ** (1 / len(self.walls.sides))

    def lossless(self) -> "SoftScene":
        """The same gas without losses: smooth spheres in a vacuum, between elastic walls."""
        walls, drag = self.walls, self.drag
        if walls is not None:
            walls = dataclasses.replace(walls, dissipative_constant=0.0 * walls.alpha)
        if drag is not None:
            drag = SoftDrag(*(0.0 * rate for rate in drag))
        zero = 0.0 * self.alpha
        return dataclasses.replace(
            self, dissipative_constant=zero, walls=walls, drag=drag, surface=None
        )
