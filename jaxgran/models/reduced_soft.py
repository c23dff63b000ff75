"""A gas of soft spheres in units of its diameter, mass and first temperature."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles.soft.scene import SoftDrag, SoftScene, SoftSurface
from jaxgran.particles.soft.walls import MARGIN, SoftWalls
from jaxgran.scene.elements import StokesDrag, Walls
from jaxgran.scene.friction import Frictional
from jaxgran.scene.gas import Gas


def reduced_scene(gas: Gas, num_particles: int) -> SoftScene:
    """A gas of viscoelastic spheres in units of its diameter, mass and first temperature."""
    unit_time = gas.diameter / jnp.sqrt(gas.temperature)
    law: Any = gas.law  # `SoftSpheres.check` refuses others
    side, walls = gas.box_side(num_particles) / gas.diameter, None
    if gas.container is not None:
        walls = reduced_walls(gas, gas.container)
        side = jnp.max(walls.sides) + MARGIN
    return SoftScene(
        side=side,
        alpha=gas.alpha * gas.diameter**0.5 * unit_time**2,
        dissipative_constant=law.dissipative_constant / unit_time,
        contact_duration=gas.contact_duration / unit_time,
        collision_frequency=reduced_frequency(gas, unit_time),
        clipped=law.clipped,
        walls=walls,
        drag=None if gas.drag is None else reduced_drag(gas, gas.drag),
        surface=reduced_surface(gas),
    )


def reduced_walls(gas: Gas, container: Walls) -> SoftWalls:
    """The walls of a gas in these units."""
    unit_time = gas.diameter / jnp.sqrt(gas.temperature)
    law: Any = container.restitution  # `check_container` refuses others than Viscoelastic
    alpha = law.of_wall().alpha(diameter=gas.diameter, mass=gas.mass)
    return SoftWalls(
        sides=jnp.broadcast_to(container.side, (gas.dimension,)) / gas.diameter,
        alpha=alpha * gas.diameter**0.5 * unit_time**2,
        dissipative_constant=law.dissipative_constant / unit_time,
        clipped=law.clipped,
        damping=container.tangential_damping,
        friction=container.friction,
    )


def reduced_frequency(gas: Gas, unit_time: Float[Array, ""]) -> Float[Array, ""]:
    """Collisions per particle and unit of time at T = 1; of no T_0 where `held` refuses others."""
    if gas.container is None:
        return gas.collision_frequency * unit_time
    still = gas.replace(temperature=jax.lax.stop_gradient(gas.temperature))
    return still.collision_frequency * gas.diameter / jnp.sqrt(still.temperature)


def reduced_drag(gas: Gas, drag: StokesDrag) -> SoftDrag:
    """The drag of a gas in these units."""
    time = gas.diameter / jnp.sqrt(gas.temperature)
    per_collision = time / reduced_frequency(gas, time)
    return SoftDrag(drag.rate * per_collision, drag.rotational_rate * per_collision)


def reduced_surface(gas: Gas) -> SoftSurface | None:
    """The surface of the spheres of a gas in these units; None where they are smooth."""
    s, T = gas.surface, gas.temperature
    if not isinstance(s, Frictional):
        return None
    return SoftSurface(s.tangential_damping, s.friction, s.inertia, s.rotational_temperature / T)
