"""What contacts of finite duration and overlap do to the cooling rate, to first order in X_T/sigma.

``X_T = (v^2/alpha)^(2/5)`` at the speed v = sqrt(2 T) is the length scale of the overlap.
"""

from math import gamma, pi, sqrt

from jaxtyping import Array, Float

from jaxgran.scene.contact import ELASTIC_CONTACT_TIME
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import contact_value_slopes, sphere_surface
from jaxgran.scene.restitution import ReducedLaw

MEAN_OVERLAP = 0.4**-0.4 / gamma(0.6)
"""``<xi sqrt(xi)>/<sqrt(xi)>`` over exp(-(2/5) xi^(5/2)), in X_T: where a contact loses energy."""

EXCLUDED = 0.4**-0.4 * gamma(1.4)
"""``int_0^inf exp(-(2/5) xi^(5/2)) dxi``, in X_T: by so much is the diameter of hard spheres that
exclude the same volume smaller than sigma (Barker & Henderson)."""

# c(beta)/(d - 1) over `MEAN_OVERLAP`, fitted by experiments/accuracy/derive_softness.py.
_NUMERATOR = (1.24185842, 0.02178437)
_DENOMINATOR = (1.75563384, 0.33641322)


def softness(beta: Float[Array, "..."], dimension: int) -> Float[Array, "..."]:
    """c(beta) in ``1 - c X_T/sigma``, by which two soft spheres lose less than hard ones.

    While two spheres touch, their tangential velocity w carries them around each other: the
    centrifugal acceleration w^2/sigma shortens the contact and lessens the overlap. To first order
    ``c = -(d - 1) int g^(9/5) e^(-g^2/2) l'(beta g^(1/5)) dg / int g^3 e^(-g^2/2) l(beta g^(1/5))
    dg`` with the loss l = 1 - eps^2 of a head-on impact and its derivative l' in an outward
    acceleration, in units of v^2/X. As beta -> 0 ``c = .96878 (d - 1)``, the mean overlap where
    energy is lost.

    Args:
        beta: of an impact at the speed sqrt(2 T), >= 0, any shape.
        dimension: d.

    Returns:
        c, same shape; in 3D 1.938, 1.847, 1.711, 1.607, 1.418 at beta = 0, .1, .3, .5, 1. The
        fit is good to 5e-4 for beta <= 8.
    """
    (p, p2), (q, q2) = _NUMERATOR, _DENOMINATOR
    fitted = (1 + beta * (p + p2 * beta)) / (1 + beta * (q + q2 * beta))
    return (dimension - 1) * MEAN_OVERLAP * fitted


def crowding(gas: Gas) -> Float[Array, ""]:
    """k in ``1/(1 + k X_T/sigma)``: what else finite contacts do at finite density.

    As beta -> 0 velocities are independent of positions, and the loss is that of the equilibrium
    fluid: proportional to ``int sqrt(xi) exp(-U/T) y(sigma - xi) dxi`` with the cavity function y
    of spheres whose excluded diameter is smaller by ``1.280 X_T``. Besides, contacts hold the
    energy ``U/K = (2/(5 d)) nu t_c``, which goes as T^(2/5) and is lost along with T:
    ``k = 1.280 d ln g_2/d ln sigma + (1.280 - .969) s + (7/5) (2/(5 d)) nu t_c sigma/X_T`` with the
    slope ``s = -d ln g/d ln r`` of the pair correlation at contact. 0 for a dilute gas.

    Args:
        gas: the scene.

    Returns:
        k; in 3D .91, 1.99, 4.8 at phi = .05, .1, .2.
    """
    d = gas.dimension
    by_diameter, by_distance = contact_value_slopes(gas.packing_fraction, d)
    meeting = sphere_surface(d) / sqrt(2 * pi) * gas.diameter / gas.path_length
    held = 1.4 * 0.4 / d * ELASTIC_CONTACT_TIME * 2**-0.1 * gamma(0.9) * meeting
    return EXCLUDED * by_diameter + (EXCLUDED - MEAN_OVERLAP) * by_distance + held


def is_soft(law: ReducedLaw) -> bool:
    """Whether contacts of this law overlap."""
    return type(law).impact_length is not ReducedLaw.impact_length


def softness_factor(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, ""]:
    """Factor ``1 - c X_T/sigma`` by which soft contacts of two spheres reduce the cooling rate.

    Args:
        law: law of restitution in units of the diameter and of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d.
    """
    return 1 - softness(law.dissipation(speed), dimension) * law.impact_length(speed)
