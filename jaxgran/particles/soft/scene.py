"""A gas of soft spheres in reduced units."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles.soft.walls import SoftWalls
from jaxgran.tangents.rotation import RubbingMaterial
from jaxgran.tangents.thermal import ElementMaterial


class SoftDrag(NamedTuple):
    """`jaxgran.StokesDrag` in reduced units.

    Attributes:
        per_collision: gamma over the collision frequency at T = 1.
        rotational_per_collision: the same of spins.
    """

    per_collision: Float[Array, ""]
    rotational_per_collision: Float[Array, ""]


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
        of walls and drag, of which rates are over the collision frequency, and of friction; or
        their tangents."""
        own = self.alpha, self.dissipative_constant
        if self.plain:
            return own
        found = *own, self._of_elements(self.drag)
        return found if self.surface is None else (*found, self.rubbing)

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
        if drag is not None:
            drag = SoftDrag(*(rate * self.collision_frequency for rate in drag))
        return self._of_elements(drag)

    def _of_elements(self, drag: SoftDrag | None) -> ElementMaterial:
        rates = {}
        if drag is not None:
            rates["drag"] = drag.per_collision
            if self.surface is not None:
                rates["spin_drag"] = drag.rotational_per_collision
        if self.walls is None:
            return ElementMaterial(**rates)
        return ElementMaterial(self.walls.alpha, self.walls.dissipative_constant, **rates)

    @property
    def rubbing(self) -> RubbingMaterial | None:
        """The numbers of friction; None of smooth spheres."""
        if self.surface is None:
            return None
        found = RubbingMaterial(*self.surface)
        if self.walls is None:
            return found
        walls = self.walls
        return found._replace(wall_damping=walls.damping, wall_friction=walls.friction)

    def with_rubbing(self, material: RubbingMaterial | None) -> "SoftScene":
        """The same scene with other numbers of friction."""
        if material is None:
            return self
        *surface, damping, friction = material
        walls = self.walls
        if walls is not None:
            walls = dataclasses.replace(walls, damping=damping, friction=friction)
        return dataclasses.replace(self, surface=SoftSurface(*surface), walls=walls)

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
            none = 0.0 * walls.alpha
            walls = dataclasses.replace(
                walls, dissipative_constant=none, damping=None, friction=None
            )
        if drag is not None:
            drag = SoftDrag(*(0.0 * rate for rate in drag))
        zero = 0.0 * self.alpha
        return dataclasses.replace(
            self, dissipative_constant=zero, walls=walls, drag=drag, surface=None
        )
