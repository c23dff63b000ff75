"""The gas before a wall that takes energy, which is not that in the middle of the box."""

from math import pi, sqrt

import jax.numpy as jnp
from jaxtyping import Array, Float

CONDUCTIVITY = {2: 2 / sqrt(pi), 3: 75 / (64 * sqrt(pi))}
"""Heat conductivity of a dilute gas of elastic spheres, times ``sigma^(d-1) / (k sqrt(k T/m))``."""

CROSS_SECTION = {2: 2.0, 3: pi}
"""Of two spheres, over ``sigma^(d-1)``: the mean free path is ``1/(sqrt(2) n`` this one``)``."""

MOST_IMPACTS = 2.5
"""An upper bound of `share_of_impacts`, for any wall."""


def share_of_impacts(
    eps: Float[Array, "*#rows"], frequency: Float[Array, "*#rows"], dimension: int
) -> Float[Array, "..."]:
    """Impacts on a wall of restitution eps over those on it in a gas that is everywhere alike.

        2/(1 + eps) * (1 + (3/2 - 2/pi)/(d + 2) (1 - eps^2)/(1 + Kn)) * sqrt(y)

    - Spheres bring the momentum M to the wall and take eps M from it; both together are the
      pressure of the gas, within a few sound times. So 2/(1 + eps) times as many come as from a
      gas at rest: the gas is denser before the wall.
    - Those that come were last hit where it is warmer (first order of Chapman and Enskog in the
      flow of heat q), but for those that have crossed the box, of mean free path Kn times its
      width W.
    - In a box of many mean free paths heat must be conducted to the wall. In a gas that cools
      everywhere at one rate T is a parabola, at the wall ``q W/(6 kappa)`` below its mean, and
      its ratio to it is ``y = 1 - a sqrt(y)`` with
      ``a = (1 - eps) n W sqrt(2 T/pi) T/(6 kappa T)``.

    Measured, see `jaxgran.models.course.WALLS`: within 3.5 % for eps from .6 to .9 and Kn from .09
    to 1.2. Where the spheres meet walls only (Kn >> 1) there is no pressure to balance, and it
    is too large; so it is in the first sound times.

    Args:
        eps: restitution of the wall at the speed of an impact.
        frequency: impacts of a sphere on the two walls across an axis, over its impacts on
            others, in a gas that is everywhere alike.
        dimension: d.
    """
    # Mean speed over that along one axis, of two walls: frequency = <|v_x|>/(W nu).
    knudsen = {2: pi / 2, 3: 2.0}[dimension] * frequency
    to_wall = (1.5 - 2 / pi) / (dimension + 2) * (1 - eps**2) / (1 + knudsen)
    path = 1 / (sqrt(2) * CROSS_SECTION[dimension])  # n sigma^(d-1) times the mean free path
    a = sqrt(2 / pi) * path / (6 * CONDUCTIVITY[dimension]) * (1 - eps) / knudsen
    cold = 2 / (a + jnp.sqrt(a**2 + 4))
    return 2 / (1 + eps) * (1 + to_wall) * cold
