"""A gas in reduced units.

- `reduced_scene`, for kinetic theory and DSMC: speeds in `Gas.impact_speed`, lengths in
  `Gas.path_length`.
- `sphere_scene`, for spheres in boxes: the diameter, the mass and the initial temperature are 1,
  and rates are per collision.
"""

from math import pi
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene import elements, laws
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import pair_contact_value


class ReducedRough(NamedTuple):
    """`Rough` in reduced units.

    Attributes:
        beta: tangential restitution beta_t.
        inertia: q.
        ratio: T_rot/T at t = 0.
        friction: mu; None without Coulomb's limit.
    """

    beta: Float[Array, ""]
    inertia: Float[Array, ""]
    ratio: Float[Array, ""]
    friction: Float[Array, ""] | None = None

    @property
    def eta(self) -> Float[Array, ""]:
        """Coefficient eta of `Rough`, ``q (1 + beta_t) / (2 (1 + q))``."""
        return self.eta_on_wall(self.beta) / 2

    def eta_on_wall(self, beta: Float[Array, ""]) -> Float[Array, ""]:
        """Coefficient eta for a wall at rest with beta_w, ``q (1 + beta_w) / (1 + q)``."""
        return self.inertia * (1 + beta) / (1 + self.inertia)


class ReducedWalls(NamedTuple):
    """`Walls` in reduced units.

    Attributes:
        law: of impacts on them, as in `ReducedScene`.
        frequency: impacts on the two walls across each axis per particle and unit of time, divided
            by sqrt(T/T_0); None where spheres resolve their contacts.
        surface: beta_t of the walls, or their `ReducedFriction`; None if they are smooth.
    """

    law: Any
    frequency: Any
    surface: Any


class ReducedDrag(NamedTuple):
    """`StokesDrag` in reduced units: the rates of velocities and of angular velocities.

    The second is None in a `SphereScene` of smooth spheres.
    """

    rate: Float[Array, ""]
    rotational_rate: Any


PAIRS = (0, 0), (0, 1), (1, 1)
"""Kinds of pairs of small (0) and large (1) spheres."""


class ReducedSizes(NamedTuple):
    """Small and large spheres in equal numbers, in reduced units.

    Attributes:
        spread: s, the standard deviation of the diameters over their mean.
        laws: the law of the impacts of each of `PAIRS`, with a first axis (3,).
        frequency: impacts of each of `PAIRS`, over the number of particles and over the collisions
            of a particle in a gas of equal spheres with the same relative velocities.
    """

    spread: Float[Array, ""]
    laws: Any
    frequency: Float[Array, "3"]

    @property
    def masses(self) -> Float[Array, "2"]:
        """Masses of small and large spheres, over the mass of a sphere of the mean diameter."""
        return jnp.stack([1 - self.spread, 1 + self.spread]) ** 3


class ReducedScene(NamedTuple):
    """The law and the elements of a gas in reduced units; None for each missing element.

    Attributes:
        law: of restitution, for speeds in units of `Gas.impact_speed`, or a `ReducedContact`.
        surface: `ReducedRough`, or `ReducedFriction` of contacts.
        walls, drag: `ReducedWalls`, `ReducedDrag`.
        drive: of `WhiteNoise`, the growth rate of T/T_0 that it causes.
        sizes: `ReducedSizes`.
    """

    law: Any
    surface: Any = None
    walls: Any = None
    drag: Any = None
    drive: Any = None
    sizes: Any = None

    @property
    def drag_rates(self) -> Any:
        """`ReducedDrag` in the unit of time of the scene; None without drag."""
        return self.drag

    @property
    def has_elements(self) -> bool:
        """True unless there are only smooth spheres in free flight."""
        return any(element is not None for element in self[1:])


def reduced_scene(gas: Gas) -> ReducedScene:
    """Return a gas of impacts with rates in the unit of time `path_length` over `impact_speed`.

    The density of centres at a hard wall is Z times the mean density (contact theorem). Here
    ``Z = 1 + 2^(d-1) phi g_2`` is the pressure of elastic spheres over the pressure of a dilute
    gas. Hence a sphere hits the walls ``Z sum_k 2/(L_k - sigma) sqrt(T/(2 pi))`` times a second.
    """
    d = gas.dimension
    length = gas.path_length
    speed = gas.impact_speed
    surface = walls = drag = drive = None
    if isinstance(gas.surface, elements.Rough):
        rough = gas.surface
        ratio = rough.rotational_temperature / gas.temperature
        surface = ReducedRough(rough.tangential_restitution, rough.inertia, ratio, rough.friction)
    if gas.container is not None:
        box = gas.container
        law = box.restitution.on_wall(diameter=gas.diameter, mass=gas.mass, speed=speed)
        pressure = 1 + 2 ** (d - 1) * gas.packing_fraction * gas.contact_value
        widths = jnp.broadcast_to(box.side - gas.diameter, (d,))
        frequency = pressure * length / widths / pi**0.5
        walls = ReducedWalls(law, frequency, box.tangential_restitution)
    if gas.drag is not None:
        time = length / speed
        drag = ReducedDrag(gas.drag.rate * time, gas.drag.rotational_rate * time)
    if gas.drive is not None:
        drive = gas.drive.strength * (length / speed) / gas.temperature
    sizes = None if gas.diameter_sd is None else _reduced_sizes(gas, gas.size_spread)
    return ReducedScene(gas.reduced_law, surface, walls, drag, drive, sizes)


def _reduced_sizes(gas: Gas, spread: Float[Array, ""]) -> ReducedSizes:
    """Return two sizes in equal numbers that have the mean and the spread of the diameters.

    Unequal spheres have the eps of equal ones with the same effective radius and effective mass.
    """
    d = gas.dimension
    diameters = jnp.stack([1 - spread, 1 + spread])
    a, b = diameters[jnp.array(PAIRS).T]
    radius = 2 * a * b / (a + b)
    mass = 2 * (a * b) ** 3 / (a**3 + b**3)

    def law(radius: Array, mass: Array) -> laws.ReducedLaw:
        return gas.law.reduced(
            diameter=gas.diameter * radius, mass=gas.mass * mass, speed=gas.impact_speed
        )

    contact = pair_contact_value(gas.packing_fraction, spread, radius, d) / gas.contact_value
    share = jnp.array([0.125, 0.25, 0.125])
    return ReducedSizes(
        spread, jax.vmap(law)(radius, mass), share * contact * ((a + b) / 2) ** (d - 1)
    )


class ReducedContact(eqx.Module):
    """Contacts of `Viscoelastic` spheres, or of a sphere and a wall, in units of `sphere_scene`.

    Attributes:
        alpha: elastic constant over effective mass.
        dissipative_constant: A.
        clipped: whether a contact ends where the force vanishes; otherwise it ends where the
            overlap does.
    """

    alpha: Float[Array, "..."]
    dissipative_constant: Float[Array, "..."]
    clipped: bool = eqx.field(static=True)

    @classmethod
    def from_law(cls, law: laws.Viscoelastic, gas: Gas) -> "ReducedContact":
        """Return the contacts of two spheres of a gas with a law."""
        time = gas.diameter / jnp.sqrt(gas.temperature)
        alpha = law.alpha(diameter=gas.diameter, mass=gas.mass) * gas.diameter**0.5 * time**2
        return cls(alpha, law.dissipative_constant / time, law.clipped)


class ReducedFriction(NamedTuple):
    """Friction of contacts: `Frictional` in units of `sphere_scene`, or the friction of walls.

    Attributes:
        damping: x_t.
        friction: mu.
        inertia: q; None for walls.
        ratio: T_rot/T at t = 0; None for walls.
    """

    damping: Float[Array, ""]
    friction: Float[Array, ""]
    inertia: Any = None
    ratio: Any = None


class SphereScene(NamedTuple):
    """Spheres in a box, in units of their diameter, their mass and the initial temperature.

    In a container positions are coordinates from a corner, and the centre of a sphere that touches
    no wall lies between 1/2 and the container's side less 1/2. The periodic box is a cube longer
    than the container by a diameter, so that no sphere meets another one through its boundary.

    Attributes:
        side: of the periodic box.
        container: sides of the container; None without walls.
        collision_frequency: collisions per particle and time at T = 1.
        contact_duration: mean duration of an elastic contact at T = 1.
        material: the numbers in which derivatives are taken. All rates are per collision, so that
            in a denser gas the same happens sooner.
    """

    side: Float[Array, ""]
    container: Float[Array, "d"] | None
    collision_frequency: Float[Array, ""]
    contact_duration: Float[Array, ""]
    material: ReducedScene

    @property
    def galilean_invariant(self) -> bool:
        """True if any frame at constant velocity will do: there are no walls and no drag."""
        return self.container is None and self.material.drag is None

    @property
    def filled_side(self) -> Float[Array, ""]:
        """Side of a cube (square) with the volume that is open to the spheres."""
        if self.container is None:
            return self.side
        return jnp.prod(self.container) ** (1 / len(self.container))

    @property
    def drag_rates(self) -> Any:
        """`ReducedDrag` in the unit of time of the scene; None without drag."""
        return jax.tree.map(lambda rate: rate * self.collision_frequency, self.material.drag)

    def log_loss(self, material: ReducedScene) -> Float[Array, ""]:
        """Return ln of an impact's loss up to a constant.

        It is ``A alpha^(2/5)`` of contacts, and otherwise ``I/(1 - I)`` with the share I of normal
        energy that impacts dissipate.
        """
        law = material.law
        if isinstance(law, ReducedContact):
            return jnp.log(law.dissipative_constant) + 0.4 * jnp.log(law.alpha)
        lost = laws.mean_loss(law, self.side)
        return jnp.log(lost) - jnp.log1p(-lost)


def sphere_scene(gas: Gas, num_particles: int, material: ReducedScene) -> SphereScene:
    """Return N spheres in a box, with the law, the surface and the walls of a material."""
    side = gas.box_side(num_particles) / gas.diameter
    container = None
    nu = gas.collision_frequency
    if gas.container is not None:
        container = jnp.broadcast_to(gas.container.side, (gas.dimension,)) / gas.diameter
        side = jnp.max(container) + 1
    drag = drive = None
    if gas.drag is not None:
        rotational = None if gas.surface is None else gas.drag.rotational_rate / nu
        drag = ReducedDrag(gas.drag.rate / nu, rotational)
    if gas.drive is not None:
        drive = gas.drive.strength / (nu * gas.temperature)
    # It does not depend on T_0, and between walls of soft spheres its derivative is refused.
    fixed = gas.replace(temperature=jax.lax.stop_gradient(gas.temperature))
    unit_time = fixed.diameter / jnp.sqrt(fixed.temperature)
    return SphereScene(
        side=side,
        container=container,
        collision_frequency=fixed.collision_frequency * unit_time,
        contact_duration=gas.contact_duration / (gas.diameter / jnp.sqrt(gas.temperature)),
        material=material._replace(drag=drag, drive=drive),
    )
