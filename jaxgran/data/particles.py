"""Positions and velocities of simulated or measured particles."""

from typing import NamedTuple

from jaxtyping import Array, Float


class Particles(NamedTuple):
    """Positions and velocities of all particles of all replicas at one time.

    Attributes:
        position: in [0, box_side), m, shape (replicas, N, d).
        velocity: m/s, same shape.
        box_side: side of the periodic cube (d = 3) or square (d = 2), m; for a container its side,
            or its d sides.
        angular_velocity: 1/s, shape (replicas, N, 3), in a plane (replicas, N, 1); None for smooth
            spheres.

    >>> side, apart = gas.box_side(2), jnp.array([[[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]]])
    >>> start = jaxgran.Particles(apart, jnp.zeros((1, 2, 3)), side)
    >>> start.position.shape  # replicas, N, d
    (1, 2, 3)
    """

    position: Float[Array, "replicas N d"]
    velocity: Float[Array, "replicas N d"]
    box_side: Float[Array, "..."]
    angular_velocity: Float[Array, "replicas N spins"] | None = None
