"""Walls around a gas: its volume between them, and the rate of impacts on them.

`Walls` is an element of a scene, the container of a `Gas`. `wall_impact_ratio` describes the gas
near a wall that dissipates energy, for models that do not simulate it.
"""

from math import pi, sqrt
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.validation import FRACTION
from jaxgran.scene.elements import Element
from jaxgran.scene.laws import ConstantRestitution, RestitutionLaw
from jaxgran.scene.parameters import number_named, optional_number_named

VOLUME_TOLERANCE = 0.02
"""Allowed relative deviation of `container_volume_ratio` from 1."""

CONDUCTIVITY = {2: 2 / sqrt(pi), 3: 75 / (64 * sqrt(pi))}
"""Heat conductivity of a dilute gas of elastic spheres, times ``sigma^(d-1) / (k sqrt(k T/m))``,
by dimension."""

CROSS_SECTION = {2: 2.0, 3: pi}
"""Cross section S of two spheres over ``sigma^(d-1)``, by dimension.

The mean free path is ``1/(sqrt(2) n S sigma^(d-1))``."""

MAX_WALL_IMPACT_RATIO = 2.5
"""Upper bound of `wall_impact_ratio` for any wall."""


def _wall_law(law: RestitutionLaw | float) -> RestitutionLaw:
    if isinstance(law, RestitutionLaw):
        return law
    FRACTION.check("restitution of the walls", law, "Give a number or a law of restitution.")
    return ConstantRestitution(law)


class Walls(Element):
    """Flat walls at rest around the gas: a cube (square), or a box of given sides.

    A wall reverses the normal velocity of a sphere and multiplies it by the restitution. A
    viscoelastic law uses the effective mass and radius of a sphere on a flat wall of the same
    material.

    Args:
        side: side of the cube, m, or d sides of a box, > 2.1 diameters; the centres of the spheres
            move in a box whose sides are shorter by one diameter.
        restitution: restitution of impacts on the walls: a number in [0, 1], or a law.
        tangential_restitution: beta_t of the walls for rough spheres (`Rough`), in [-1, 1]; None
            for smooth walls.
        tangential_damping, friction: x_t and mu of contacts of frictional spheres (`Frictional`)
            with the walls, >= 0, where l is the distance of a centre from the wall; None for smooth
            walls.

    Raises:
        ValueError: for a value outside its range, or if only one of x_t and mu is given.

    >>> boxed = dataclasses.replace(gas, container=jaxgran.Walls(0.05, restitution=0.9))
    >>> float(boxed.value("wall_side")), float(boxed.value("wall_coefficient"))
    (0.05, 0.9)
    """

    side: Float[Array, "..."] = eqx.field(converter=number_named("side of the walls"))
    restitution: RestitutionLaw = eqx.field(converter=_wall_law, kw_only=True)
    tangential_restitution: Float[Array, ""] | None = eqx.field(
        converter=optional_number_named("tangential_restitution of the walls"),
        default=None,
        kw_only=True,
    )
    tangential_damping: Float[Array, ""] | None = eqx.field(
        converter=optional_number_named("tangential_damping of the walls"),
        default=None,
        kw_only=True,
    )
    friction: Float[Array, ""] | None = eqx.field(
        converter=optional_number_named("friction of the walls"), default=None, kw_only=True
    )

    part: ClassVar[str] = " of the walls"

    def __check_init__(self):
        if (self.tangential_damping is None) != (self.friction is None):
            given = "tangential_damping"
            missing = "friction"
            if self.tangential_damping is None:
                given, missing = missing, given
            raise ValueError(
                f"the walls have {given} but no {missing}. Give both, or leave {given} out."
            )

    def more_collisions(self, diameter: Array, dimension: int) -> Float[Array, ""]:
        """Ratio of the collision frequency to that without walls at the same mean density.

        ``prod_k L_k/W_k <prod_k (1 - |n_k| sigma/W_k)>``, averaged over all directions n, with the
        width ``W_k = L_k - sigma`` that is accessible to the centres. The centres have less room,
        and near a wall they meet other spheres on one side only. Exact for a dilute gas.

        Args:
            diameter: sigma, m.
            dimension: d, 2 or 3.
        """
        widths = jnp.broadcast_to(self.side, (dimension,)) - diameter
        near = diameter / widths
        pairs = (jnp.sum(near) ** 2 - jnp.sum(near**2)) / 2
        room = jnp.prod(1 + near)
        if dimension == 2:
            return room * (1 - 2 / pi * jnp.sum(near) + pairs / pi)
        return room * (1 - jnp.sum(near) / 2 + 2 / (3 * pi) * pairs - jnp.prod(near) / (4 * pi))


def container_volume_ratio(gas: Any, num_particles: int | float) -> float:
    """Ratio of two volumes: of N spheres at the gas's number density, and of its container."""
    sides = np.broadcast_to(gas.container.side, (gas.dimension,))
    return float(num_particles / gas.number_density) / float(np.prod(sides))


def wall_impact_ratio(
    eps: Float[Array, "*#rows"], frequency: Float[Array, "*#rows"], dimension: int
) -> Float[Array, "..."]:
    """Ratio of the impact rate on a wall of restitution eps to that in a homogeneous gas.

        2/(1 + eps) * (1 + (3/2 - 2/pi)/(d + 2) (1 - eps^2)/(1 + Kn)) * sqrt(y)

    - First factor: spheres bring the momentum M to the wall and take eps M from it. The sum is the
      pressure of the gas, after a few sound times. Hence the impact rate is 2/(1 + eps) times that
      of a gas at rest: the gas is denser near the wall.
    - Second factor: the spheres that arrive had their last collision where the gas is warmer (first
      order of Chapman and Enskog in the heat flux q), except those that have crossed the box. The
      Knudsen number Kn is the mean free path over the width W of the box.
    - Third factor: in a box of many mean free paths heat must be conducted to the wall. In a gas
      that cools everywhere at the same rate the profile of T is a parabola, and T at the wall is
      ``q W/(6 kappa)`` below the mean. The ratio of the two is ``y = 1 - a sqrt(y)`` with
      ``a = (1 - eps) n W sqrt(2 T/pi)/(6 kappa)``.

    The formula agrees with measurements within 3.5 % for eps from 0.6 to 0.9 and Kn from 0.09 to
    1.2; see `jaxgran.models.error_model.WALL_ERROR`. The ratio is too large for Kn >> 1, where
    spheres meet only walls and there is no pressure to balance, and in the first sound times.

    Args:
        eps: restitution of the wall at the speed of an impact.
        frequency: impact rate of a sphere on the two walls across an axis, over its collision rate
            with other spheres, in a homogeneous gas.
        dimension: d, 2 or 3.
    """
    # Kn = frequency * (mean speed) / <|v_x|>, since frequency = <|v_x|>/(W nu).
    knudsen = {2: pi / 2, 3: 2.0}[dimension] * frequency
    heat_flux = (1.5 - 2 / pi) / (dimension + 2) * (1 - eps**2) / (1 + knudsen)
    path = 1 / (sqrt(2) * CROSS_SECTION[dimension])  # n sigma^(d-1) times the mean free path
    a = sqrt(2 / pi) * path / (6 * CONDUCTIVITY[dimension]) * (1 - eps) / knudsen
    root_y = 2 / (a + jnp.sqrt(a**2 + 4))
    return 2 / (1 + eps) * (1 + heat_flux) * root_y
