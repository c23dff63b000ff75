"""A scene in reduced units: speeds in `Gas.impact_speed`, lengths in `Gas.path_length`."""

from math import pi
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.elements import Rough
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import ReducedLaw


class ReducedRough(NamedTuple):
    """`Rough` in reduced units.

    Attributes:
        beta: tangential restitution beta_t.
        inertia: q.
        ratio: T_rot/T at t = 0.
    """

    beta: Float[Array, ""]
    inertia: Float[Array, ""]
    ratio: Float[Array, ""]

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
        law: law of restitution, in units of `Gas.impact_speed`.
        frequency: impacts on the two walls across each axis per particle and unit of time, divided
            by sqrt(T/T_0).
        beta: beta_t of the walls; None if they are smooth.
    """

    law: ReducedLaw
    frequency: Float[Array, "d"]
    beta: Float[Array, ""] | None


class ReducedDrag(NamedTuple):
    """`StokesDrag` in reduced units: the rates of velocities and of angular velocities."""

    rate: Float[Array, ""]
    rotational_rate: Float[Array, ""]


class ReducedDrive(NamedTuple):
    """`WhiteNoise` in reduced units: the growth rate of T/T_0 that it causes."""

    strength: Float[Array, ""]


class ReducedScene(NamedTuple):
    """A gas in units of `Gas.impact_speed` and `Gas.path_length`; None for each missing element.

    `prepared` is () for a gas with `DrivenStart`, which has no numbers.
    """

    law: ReducedLaw
    surface: ReducedRough | None = None
    walls: ReducedWalls | None = None
    drag: ReducedDrag | None = None
    drive: ReducedDrive | None = None
    prepared: tuple[()] | None = None


def reduced_scene(gas: Gas) -> ReducedScene:
    """Return the law of restitution and the elements of a gas in reduced units.

    The density of centres at a hard wall is Z times the mean density (contact theorem). Here
    ``Z = 1 + 2^(d-1) phi g_2`` is the pressure of elastic spheres over that of a dilute gas. Hence
    a sphere hits the walls ``Z sum_k 2/(L_k - sigma) sqrt(T/(2 pi))`` times a second.
    """
    d, length, speed = gas.dimension, gas.path_length, gas.impact_speed
    surface = walls = drag = drive = None
    if isinstance(gas.surface, Rough):
        ratio = gas.surface.rotational_temperature / gas.temperature
        surface = ReducedRough(gas.surface.tangential_restitution, gas.surface.inertia, ratio)
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
        drive = ReducedDrive(gas.drive.strength * (length / speed) / gas.temperature)
    prepared = None if gas.preparation is None else ()
    return ReducedScene(gas.reduced_law, surface, walls, drag, drive, prepared)
