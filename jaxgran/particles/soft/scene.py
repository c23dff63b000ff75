"""A gas of soft spheres in reduced units."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float


class SoftScene(eqx.Module):
    """A gas of viscoelastic spheres in units of its diameter, mass and first temperature.

    Attributes:
        side: of the box.
        alpha: elastic constant over effective mass.
        dissipative_constant: A.
        contact_duration: mean duration of an elastic contact at T = 1.
        collision_frequency: collisions per particle and time at T = 1.
        clipped: whether contact ends where the force vanishes, or else where the overlap does.
    """

    side: Float[Array, ""]
    alpha: Float[Array, ""]
    dissipative_constant: Float[Array, ""]
    contact_duration: Float[Array, ""]
    collision_frequency: Float[Array, ""]
    clipped: bool = eqx.field(static=True, default=True)

    @property
    def material(self) -> tuple[Any, Any]:
        """The numbers that derivatives are followed in: (alpha, A), or their tangents."""
        return self.alpha, self.dissipative_constant
