"""Scatter of T by the energy that contacts hold.

A contact of soft spheres stores kinetic energy for a while. The number of contacts of N spheres and
their energies are random, so that T of one run has a further scatter, which is forgotten within a
contact. Contacts are independent, and each lasts t_c: with the energy E of the normal motion of a
pair, of which it stores the share f(t),

    N var(ln T) = (t_c/tau_c) (2/d^2) <E^2> <f^2>/(m T)^2 <eps^2>.

Over Hertz contacts <f^2> = .56/1.71, and E/(m T) of impacts has an exponential distribution, of
which slow contacts, which are longer, have more: <E^2>/(m T)^2 = Gamma(29/10)/Gamma(9/10) = 1.71.
The kinetic energy dips less in a dissipative contact. What counts is ``int s (s - s_end) dt`` over
the contact, where s is the share of E that is missing: by integration of single contacts it is the
one of an elastic contact times eps^2, within 4 % of the elastic one.

Soft spheres of t_c/tau_c = .05 (phi = .05, beta = .02 and .3) and .17 (phi = .2, beta = .5) have
.7 to .9 of this variance, since contacts at finite overlap are shorter.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.gas import Gas
from jaxgran.theory.density import is_soft

CONTACT_VARIANCE = 1.12
"""``2 x 1.71 x .56/1.71``: variance of ln T times N d^2 over t_c/tau_c of elastic spheres."""

CONTACT_MEMORY = 0.30
"""Time over which the scatter is forgotten, in t_c: ``<f>^2/(2 <f^2>)`` with <f> = 4/9."""

ENERGETIC_SPEED = 2.4
"""Normal speed, over sqrt(2 T), of the contacts that hold most: their E is 2.9 m T in the mean."""


class ContactNoise(NamedTuple):
    """Scatter of ln T of one run by its contacts.

    Attributes:
        size: standard deviation times the root of N.
        memory: collisions of a particle over which it is forgotten.
    """

    size: Float[Array, "*points"]
    memory: Float[Array, "*points"]


def contact_noise(gas: Gas, log_temperature: Float[Array, "*points"]) -> ContactNoise | None:
    """Return the scatter of ln T by contacts; None for hard spheres.

    Args:
        gas: the scene.
        log_temperature: ln(T/T_0).
    """
    law = gas.reduced_law
    if not is_soft(law):
        return None
    speed = jnp.exp(log_temperature / 2)
    longer = law.impact_length(speed) / law.impact_length(jnp.ones_like(speed))
    fraction = gas.contact_fraction * longer
    eps = law.restitution(ENERGETIC_SPEED * speed)
    size = jnp.sqrt(CONTACT_VARIANCE * fraction) * eps / gas.dimension
    return ContactNoise(size, CONTACT_MEMORY * fraction)


def contact_covariance(
    contacts: ContactNoise, collisions: Float[Array, "times"]
) -> Float[Array, "times times"]:
    """Return the covariance of ln T by contacts, times N.

    Args:
        contacts: at some times.
        collisions: of a particle since t = 0, at these times.
    """
    since = jnp.abs(collisions[:, None] - collisions[None])
    memory = (contacts.memory[:, None] + contacts.memory[None]) / 2
    return jnp.outer(contacts.size, contacts.size) * jnp.exp(-since / memory)
