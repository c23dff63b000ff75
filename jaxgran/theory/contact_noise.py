"""Scatter of T by the energy that contacts hold.

A contact of soft spheres stores kinetic energy for a while. The number of contacts of N spheres and
their energies are random, so that T of one run has a further scatter, which is forgotten within a
contact. Contacts are independent. A pair that comes together with the energy E of its normal motion
stores the share f(t) of it for a time t_c:

    N var(ln T) = (2/d^2) <E^2 f^2>/(m T)^2 (t_c/tau_c) <eps^2>.

The mean is over contacts at one time, so that impacts count by their duration. E/(m T) of impacts
has an exponential distribution, and their duration is in proportion to E^(-1/10): <E^2>/(m T)^2 =
Gamma(29/10)/Gamma(9/10) = 1.71. Over a Hertz contact <f> = 4/9 and <f^2> = .56/1.71.

The kinetic energy dips less in a dissipative contact. What counts is ``int s (s - s_end) dt`` over
the contact, where s is the share of E that is missing: it is the one of an elastic contact times
eps^2, with an error of .02 of the elastic one at eps = .8 and .07 at eps = .6.

The scatter is taken to be forgotten exponentially, over the integral of its correlation. It is
forgotten later and faster in truth, which only times less than half of t_c apart show. T_0 is the
exact temperature at t = 0, where there is none of it.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.gas import Gas
from jaxgran.theory.density import is_soft

CONTACT_VARIANCE = 1.12
"""``2 <E^2 f^2>/(m T)^2``: variance of ln T times N d^2 over t_c/tau_c of elastic spheres."""

CONTACT_MEMORY = 0.26
"""Integral of its correlation, in the mean duration t_c of impacts: ``<E^2 t^2> <f>^2/(2 <E^2 t>
<f^2> t_c)`` = ``.302 Gamma(28/10)/(Gamma(29/10) Gamma(9/10))``, with the duration t of each."""

ENERGETIC_SPEED = 2.4
"""Normal speed, over sqrt(2 T), of the contacts that hold most: their E is 2.9 m T in the mean."""


class ContactNoise(NamedTuple):
    """Scatter of ln T of one run by its contacts.

    Attributes:
        size: standard deviation times the root of N, long after t = 0.
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
    """Return the covariance of ln T by contacts, times N, which is 0 at the first time.

    Args:
        contacts: at some times, the first of which is t = 0.
        collisions: of a particle since t = 0, at these times.
    """
    passed = jnp.cumsum(jnp.diff(collisions, prepend=collisions[:1]) / contacts.memory)
    since = jnp.abs(passed[:, None] - passed[None])
    remembered = jnp.exp(-since) - jnp.exp(-passed[:, None] - passed[None])
    return jnp.outer(contacts.size, contacts.size) * remembered
