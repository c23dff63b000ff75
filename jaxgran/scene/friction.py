"""Friction of spheres whose contacts last: a tangential force with Coulomb's limit."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from jaxgran.checks.validation import NOT_NEGATIVE, Domain, number


class Frictional(eqx.Module):
    """Spheres that rotate, by a tangential force at contact: viscous, and at most Coulomb's.

    The surfaces slip with ``u_t``, the tangential part of
    ``u = v_i - v_j - l (w_i + w_j) x n`` with the unit vector n from j to i, angular velocities w
    and half the distance of the centres, ``l = (sigma - xi)/2``. The force on i is

        F_t = -min(x_t (3/2) A rho sqrt(xi) |u_t|, mu F_n) u_t/|u_t|

    with the normal force F_n of `jaxgran.contact_force`, and the torque on both spheres is
    ``-l n x F_t``: energy is lost at the rate ``|F_t| |u_t|``, and the angular momentum of a pair
    is conserved. There is no memory of the slip, and so no static friction.

    This is ``tangential linear_nohistory x_t mu`` of ``pair_style granular`` in LAMMPS, which
    however has sigma/2 in place of l in the slip: velocities differ by the share xi/sigma of those
    of rotation.

    `jaxgran.SoftSpheres` takes it. Models of instantaneous impacts have `jaxgran.Rough` instead.

    Args:
        tangential_damping: x_t, tangential over normal damping, >= 0.
        friction: mu, Coulomb's coefficient, >= 0.
        inertia: q = 4 I/(m sigma^2), in (0, 1]: 2/5 of a solid sphere, 2/3 of a hollow one, 1/2 of
            a disk.
        rotational_temperature: T_rot = I <w^2>/(d_rot m) at t = 0, m^2/s^2, >= 0, with d_rot = 3
            (1 in a plane).

    Raises:
        ValueError: for a value outside its range.

    Reference: Luding, Granular Matter 10, 235 (2008), without the tangential spring.

    >>> grains = jaxgran.Frictional(tangential_damping=0.5, friction=0.3)
    >>> rubbing = dataclasses.replace(gas, surface=grains)
    >>> float(rubbing.value("friction"))
    0.3
    """

    tangential_damping: Float[Array, ""] = eqx.field(converter=number)
    friction: Float[Array, ""] = eqx.field(converter=number)
    inertia: Float[Array, ""] = eqx.field(converter=number, default=0.4)
    rotational_temperature: Float[Array, ""] = eqx.field(converter=number, default=0.0)

    domains: ClassVar[dict[str, Domain]] = {
        "tangential_damping": NOT_NEGATIVE,
        "friction": NOT_NEGATIVE,
        "inertia": Domain(0.0, 1.0, high_allowed=True),
        "rotational_temperature": NOT_NEGATIVE,
    }

    def __check_init__(self):
        advice = {
            "tangential_damping": "It is over the normal damping: 0 to 1 is usual.",
            "friction": "It is Coulomb's coefficient: glass has 0.1 to 0.5.",
            "inertia": "It is 4 I/(m sigma^2): 0.4 for solid spheres.",
            "rotational_temperature": "Give I <w^2>/(d_rot m) at t = 0 in m^2/s^2.",
        }
        for name, domain in self.domains.items():
            domain.check(name, getattr(self, name), advice[name])
