"""Scatter of T by the energy that contacts hold.

A contact of soft spheres stores kinetic energy until the spheres separate. The number of contacts
of N spheres and their energies are random. This adds a scatter to T of one run, whose correlation
lasts about as long as a contact. Contacts are independent. A pair that comes together with the
energy E of its normal motion stores the share f(t) of it during a time t_c:

    N var(ln T) = (2/d^2) <E^2 f^2>/(m T)^2 (t_c/tau_c) eps^2.

The mean is over the contacts that exist at one time, so that impacts count by their duration.
E/(m T) of impacts has an exponential distribution, and their duration is in proportion to
E^(-1/10): <E^2>/(m T)^2 = Gamma(29/10)/Gamma(9/10) = 1.71. Over a Hertz contact <f> = 4/9 and
<f^2> = .56/1.71.

The factor eps^2, with the restitution eps of the contacts that hold most energy, is for dissipative
contacts, in which the kinetic energy dips less. The scatter is given by the integral
``int s (s - s_end) dt`` over the contact, where s is the share of E that is missing from the
kinetic energy. It is the integral of an elastic contact times eps^2, with an error of .02 of the
elastic one at eps = .8 and .07 at eps = .6.

The correlation is taken to be exponential, with the correct integral. The true one falls later and
faster, which matters only for times less than t_c/2 apart. T_0 is the exact temperature at t = 0:
the scatter is 0 there.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.gas import Gas
from jaxgran.theory.density import is_soft

CONTACT_VARIANCE = 1.12
"""``2 <E^2 f^2>/(m T)^2``: variance of ln T times N d^2 over t_c/tau_c of elastic spheres."""

CONTACT_MEMORY = 0.26
"""Integral of the correlation of the scatter, in the mean duration t_c of impacts.

``<E^2 t^2> <f>^2/(2 <E^2 t> <f^2> t_c) = .302 Gamma(28/10)/(Gamma(29/10) Gamma(9/10))``, with the
duration t of each impact and means over impacts.
"""

ENERGETIC_SPEED = 2.4
"""Normal speed, over sqrt(2 T), of the contacts that hold most: their E is 2.9 m T in the mean."""


class ContactNoise(NamedTuple):
    """Scatter of ln T of one run by its contacts.

    Attributes:
        size: standard deviation times the root of N, long after t = 0.
        memory: decay of the correlation, in collisions of a particle.
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
    # t_c is in proportion to X/v and tau_c to 1/v, with the length X of overlaps.
    length_ratio = law.impact_length(speed) / law.impact_length(jnp.ones_like(speed))
    contact_fraction = gas.contact_fraction * length_ratio
    eps = law.restitution(ENERGETIC_SPEED * speed)
    size = jnp.sqrt(CONTACT_VARIANCE * contact_fraction) * eps / gas.dimension
    return ContactNoise(size, CONTACT_MEMORY * contact_fraction)


def contact_covariance(
    contacts: ContactNoise, collisions: Float[Array, "times"]
) -> Float[Array, "times times"]:
    """Return the covariance of ln T by contacts, times N, which is 0 at the first time.

    Args:
        contacts: at some times, the first of which is t = 0.
        collisions: of a particle since t = 0, at these times.
    """
    # Times since t = 0, and between each two, in units of the memory.
    age = jnp.cumsum(jnp.diff(collisions, prepend=collisions[:1]) / contacts.memory)
    separation = jnp.abs(age[:, None] - age[None])
    correlation = jnp.exp(-separation) - jnp.exp(-age[:, None] - age[None])
    return jnp.outer(contacts.size, contacts.size) * correlation
