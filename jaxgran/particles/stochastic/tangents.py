"""Tangents of a DSMC run in the parameters of the law of restitution."""

from typing import NamedTuple

from jaxtyping import Array, Float

from jaxgran.particles.stochastic.collision_rule import Outcome


class DSMCTangents(NamedTuple):
    """Tangents at a fixed own time s, ``ds = sqrt(T/T_0) dt``, in P parameters of the law.

    The tangent of the velocities is c v / 2. That of <dr^2> follows from ``d<dr^2>/ds = 2 d M``,
    ``dM/ds = 1/2 - kappa M``, the equation of kinetic theory for ``M = D / sqrt(T/T_0)``. Here
    kappa is the rate of velocity relaxation less half the cooling rate, and is measured on the
    collisions.

    Attributes:
        log_temperature: c = d ln T.
        clock: of the time.
        mobility: of M.
        displacement: of <dr^2>.
        persistence: of the logarithm of <v(0).v> / sqrt(T).
    """

    log_temperature: Float[Array, "*replicas P"]
    clock: Float[Array, "*replicas P"]
    mobility: Float[Array, "*replicas P"]
    displacement: Float[Array, "*replicas P"]
    persistence: Float[Array, "*replicas P"]


def carried(
    old: DSMCTangents,
    before: Float[Array, ""],
    dimension: int,
    sums: Outcome,
    dt: Float[Array, ""],
    ds: Float[Array, ""],
    energy: Float[Array, ""],
) -> tuple[Float[Array, ""], DSMCTangents]:
    """M and the tangents after a step.

    Args:
        old, before: the tangents and M before it.
        dimension: d.
        sums: over its collisions.
        dt, ds: its length in time and in own time.
        energy: sum v^2 after it.
    """
    c = old.log_temperature
    # The tangent of the velocities is (c/2) v; the law adds to it at every collision.
    gain, fading = (sums.along + sums.along_speed[:, None] * (c / 2)[None]) / energy
    # dM/ds = 1/2 - kappa M and its tangent, by the implicit midpoint rule.
    half = sums.memory / energy / 2
    mobility = ((1 - half) * before + ds / 2) / (1 + half)
    along = ((1 - half) * old.mobility - fading * (before + mobility) / 2) / (1 + half)
    tangents = DSMCTangents(
        log_temperature=c + gain,
        clock=old.clock - c / 2 * dt,
        mobility=along,
        displacement=old.displacement + dimension * ds * (old.mobility + along),
        persistence=old.persistence - fading,
    )
    return mobility, tangents
