"""Time steps of soft spheres in contact.

Units here: the diameter and the mass are 1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.particles.soft.candidates import Encounters
from jaxgran.scene.contact import contact_force, midpoint_rate


def overlap(
    x: Float[Array, "members d"],
    a: Int[Array, "contacts"],
    b: Int[Array, "contacts"],
    offset: Float[Array, "contacts d"],
) -> tuple[Float[Array, "contacts"], Float[Array, "contacts d"], Bool[Array, "contacts"]]:
    """The overlap xi (0 without contact), the normal from b to a, and which pairs touch."""
    r = x[a] - x[b] - offset
    distance2 = jnp.sum(r * r, -1)
    touching = distance2 < 1
    distance = jnp.sqrt(jnp.where(touching, distance2, 1.0))
    return 1 - distance, r / distance[:, None], touching


def elastic_energy(xi: Float[Array, "contacts"], alpha: ArrayLike) -> Float[Array, "contacts"]:
    """``(2/5) rho xi^(5/2)`` with ``rho = alpha / 2``, of spheres of mass 1."""
    return 0.2 * jnp.asarray(alpha) * xi**2.5


class ContactWork(NamedTuple):
    """Energies and contacts of a block, for each pair of its `Encounters`.

    Attributes:
        dissipated: energy lost to the dissipative force.
        exchanged: work of the elastic force, with all its parts counted as positive.
        begun: number of contacts that began.
        touched: whether the pair touched at any time.
        stored: elastic energy at the end.
        touching: whether the pair touches at the end.
    """

    dissipated: Float[Array, "contacts"]
    exchanged: Float[Array, "contacts"]
    begun: Int[Array, "contacts"]
    touched: Bool[Array, "contacts"]
    stored: Float[Array, "contacts"]
    touching: Bool[Array, "contacts"]


class PairKick(NamedTuple):
    """What the normal forces of pairs do in a time step.

    Attributes:
        xi, normal, touching: of the pairs, see `overlap`.
        force: normal force.
        viscous: dissipative force per overlap rate.
        v: velocities after it.
        work: dissipated and exchanged energy as in `ContactWork`, in all steps of the block so far.
    """

    xi: Float[Array, "contacts"]
    normal: Float[Array, "contacts d"]
    touching: Bool[Array, "contacts"]
    force: Float[Array, "contacts"]
    viscous: Float[Array, "contacts"]
    v: Float[Array, "members d"]
    work: tuple[Float[Array, "contacts"], Float[Array, "contacts"]]


def kicked(
    x: Float[Array, "members d"],
    v: Float[Array, "members d"],
    alpha: ArrayLike,
    rho: ArrayLike,
    dissipative_constant: ArrayLike,
    chosen: Encounters,
    dt: ArrayLike,
    clipped: bool,
    work: tuple[Float[Array, "contacts"], Float[Array, "contacts"]],
) -> PairKick:
    """The kick of a time step, the implicit midpoint rule of `midpoint_rate`; see `follow`.

    Args:
        rho: elastic constant, ``alpha / 2``.
        dt: time step.
        work: `PairKick.work` of the steps before.
    """
    a, b = chosen.a, chosen.b
    xi, normal, touching = overlap(x, a, b, chosen.offset)
    xi_dot = -jnp.sum((v[a] - v[b]) * normal, -1)
    rate = midpoint_rate(xi, xi_dot, alpha, dissipative_constant, dt)
    force = contact_force(xi, rate, rho, dissipative_constant, clipped=clipped)
    elastic = contact_force(xi, 0.0, rho, 0.0)
    kick = (dt * force)[:, None] * normal
    v = v.at[a].add(kick).at[b].add(-kick)
    # The midpoint and the trapezoidal sum of sqrt(xi) xi_dot^2 err to opposite sides.
    mean = xi_dot - dt * force
    viscous = contact_force(xi, 1.0, rho, dissipative_constant) - elastic
    lost = (force - elastic) * mean + 0.5 * viscous * (dt * force) ** 2
    dissipated, exchanged = work
    dissipated += dt * lost
    exchanged += dt * elastic * jnp.abs(mean)
    return PairKick(xi, normal, touching, force, viscous, v, (dissipated, exchanged))


def follow(
    x: Float[Array, "members d"],
    v: Float[Array, "members d"],
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    chosen: Encounters,
    duration: ArrayLike,
    num_steps: int,
    clipped: bool,
) -> tuple[Float[Array, "members d"], Float[Array, "members d"], ContactWork]:
    """Positions and velocities of the members of a block after its time steps.

    Drift-kick-drift steps of equal length, second order; for the kick see `kicked`.

    Args:
        x, v: positions and velocities of the members.
        alpha: elastic constant over effective mass, one number or one per pair.
        dissipative_constant: A, likewise.
        chosen: the pairs.
        duration: of the block.
        num_steps: number of steps.
        clipped: whether contacts end at zero force, as in `contact_force`.
    """
    rho, dt = 0.5 * alpha, duration / num_steps
    a, b, offset = chosen.a, chosen.b, chosen.offset

    def step(_, carry):
        x, v, *work, begun, before = carry
        kick = kicked(x, v, alpha, rho, dissipative_constant, chosen, dt, clipped, (*work,))
        begun += kick.touching & ~before
        return x + dt * kick.v, kick.v, *kick.work, begun, kick.touching

    zeros, first = jnp.zeros(len(a), x.dtype), overlap(x, a, b, offset)[2]
    carry = x + 0.5 * dt * v, v, zeros, zeros, jnp.zeros(len(a), jnp.int32), first
    end = jax.lax.fori_loop(0, num_steps, step, carry)
    x, v, dissipated, exchanged, begun, touching = end
    x = x - 0.5 * dt * v
    xi, _, last = overlap(x, a, b, offset)
    work = ContactWork(
        dissipated=dissipated,
        exchanged=exchanged,
        begun=begun + (last & ~touching),  # contacts that begin in the last half drift
        touched=(begun > 0) | first,
        stored=elastic_energy(xi, alpha),
        touching=last,
    )
    return x, v, work
