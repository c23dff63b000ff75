"""Elements that a scene may have besides smooth spheres in free flight: roughness, walls, drag,
a drive.

Each is an optional field of `Gas`; a program of a scene without it does not contain it.

Friction of spheres whose contacts last: a tangential force with Coulomb's limit.

The gas before a wall that takes energy, which is not that in the middle of the box.
"""

from math import pi, sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.tracing import is_known
from jaxgran._utils.validation import FRACTION, NOT_NEGATIVE, POSITIVE, Domain, number
from jaxgran.scene.laws import ConstantRestitution, RestitutionLaw


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

    Measured, see `jaxgran.models.error_model.WALL_ERROR`: within 3.5 % for eps from .6 to .9 and Kn from .09
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


TANGENTIAL = Domain(-1.0, 1.0, low_allowed=True, high_allowed=True)
"""Coefficients of tangential restitution: -1 is a smooth surface, 1 a perfectly rough one."""

NUM_SPIN_COMPONENTS = {2: 1, 3: 3}
"""d_rot: components of the angular velocity by dimension."""

SAME_VOLUME = 0.02
"""Relative difference of volumes up to which a container is that of N spheres of a gas."""

if TYPE_CHECKING:
    UserWallLaw = RestitutionLaw | float
else:
    # A run-time type checker lets everything pass, so that a wrong type is reported in words.
    UserWallLaw = Any


def optional_element(*kinds: type) -> Any:
    """An optional field of a `Gas`; it refuses what is of none of the kinds."""

    def checked(value: Any) -> Any:
        if value is None or isinstance(value, kinds):
            return value
        allowed = ", ".join(f"a jaxgran.{kind.__name__}" for kind in kinds)
        raise ValueError(f"expected {allowed} or None, got {value!r}")

    return eqx.field(converter=checked, default=None, kw_only=True)


class Rough(eqx.Module):
    """Rough spheres, which rotate: the tangential velocity at contact is multiplied by -beta_t.

    The velocity at contact is ``u = v_i - v_j - (sigma/2) (w_i + w_j) x n`` with the unit vector n
    from j to i and angular velocities w. An impact changes its normal part by -eps(|u_n|) and its
    tangential part by -beta_t: with ``eta = q (1 + beta_t) / (2 (1 + q))``

        v_i -> v_i - (1 + eps)/2 u_n - eta u_t,    w_i -> w_i + (2 eta/(q sigma)) n x u_t,

    and v_j the opposite, w_j the same. The energy lost in tangential motion is
    ``(m/4) q/(1 + q) (1 - beta_t^2) u_t^2``.

    Args:
        tangential_restitution: beta_t, in [-1, 1], the same for all impacts; -1 is smooth.
        inertia: q = 4 I/(m sigma^2), in (0, 1]: 2/5 of a solid sphere, 2/3 of a hollow one, 1/2 of
            a disk.
        rotational_temperature: T_rot = I <w^2>/(d_rot m) at t = 0, m^2/s^2, >= 0, with d_rot = 3
            (1 in a plane).

    Raises:
        ValueError: for a value outside its range.

    Reference: Huthmann & Zippelius, Phys. Rev. E 56, R6275 (1997).

    >>> rough = dataclasses.replace(gas, surface=jaxgran.Rough(0.5, rotational_temperature=0.002))
    >>> float(rough.value("tangential_restitution"))
    0.5
    """

    tangential_restitution: Float[Array, ""] = eqx.field(converter=number)
    inertia: Float[Array, ""] = eqx.field(converter=number, default=0.4)
    rotational_temperature: Float[Array, ""] = eqx.field(converter=number, default=0.0)

    domains: ClassVar[dict[str, Domain]] = {
        "tangential_restitution": TANGENTIAL,
        "inertia": Domain(0.0, 1.0, high_allowed=True),
        "rotational_temperature": NOT_NEGATIVE,
    }

    def __check_init__(self):
        advice = {
            "tangential_restitution": "-1 is a smooth surface, 1 a perfectly rough one.",
            "inertia": "It is 4 I/(m sigma^2): 0.4 for solid spheres.",
            "rotational_temperature": "Give I <w^2>/(d_rot m) at t = 0 in m^2/s^2.",
        }
        for name, domain in self.domains.items():
            domain.check(name, getattr(self, name), advice[name])


def _wall_law(law: UserWallLaw) -> RestitutionLaw:
    if isinstance(law, RestitutionLaw):
        return law
    FRACTION.check("restitution of the walls", law, "Give a number or a law of restitution.")
    return ConstantRestitution(law)


def _number_or_none(value: Any) -> Array | None:
    return None if value is None else number(value)


class Walls(eqx.Module):
    """Flat walls around the gas, at rest: a cube (square), or a box of given sides.

    A wall reverses the normal velocity of a sphere, times its restitution. Of a viscoelastic law
    the effective mass and radius are those of a sphere on a flat wall of its own material.

    Args:
        side: of the cube, m, or d sides; the centres of the spheres have a diameter less.
        restitution: of impacts on the walls: a number in [0, 1], or a law of restitution.
        tangential_restitution: of rough spheres (`Rough`), in [-1, 1]; None is smooth walls.
        tangential_damping, friction: x_t and mu of contacts of rubbing spheres (`Frictional`) with
            the walls, >= 0, with l the distance of a centre from the wall; None is smooth walls.

    Raises:
        ValueError: for a value outside its range, or one of x_t and mu without the other.

    >>> boxed = dataclasses.replace(gas, container=jaxgran.Walls(0.05, restitution=0.9))
    >>> float(boxed.value("wall_side")), float(boxed.value("wall_coefficient"))
    (0.05, 0.9)
    """

    side: Float[Array, "..."] = eqx.field(converter=number)
    restitution: RestitutionLaw = eqx.field(converter=_wall_law, kw_only=True)
    tangential_restitution: Float[Array, ""] | None = eqx.field(
        converter=_number_or_none, default=None, kw_only=True
    )
    tangential_damping: Float[Array, ""] | None = eqx.field(
        converter=_number_or_none, default=None, kw_only=True
    )
    friction: Float[Array, ""] | None = eqx.field(
        converter=_number_or_none, default=None, kw_only=True
    )

    def __check_init__(self):
        for name, domain in self.domains.items():
            advice = "Give it in metres." if name == "side" else ""
            domain.check(f"{name} of the walls", getattr(self, name), advice)
        if (self.tangential_damping is None) != (self.friction is None):
            given, missing = "tangential_damping", "friction"
            if self.tangential_damping is None:
                given, missing = missing, given
            raise ValueError(
                f"the walls have {given} and no {missing}, and their tangential force needs both: "
                f"give {missing} too, or leave {given} out"
            )

    @property
    def domains(self) -> dict[str, Domain]:
        """Allowed range of each float that is not one of the law."""
        optional = {
            "tangential_restitution": TANGENTIAL,
            "tangential_damping": NOT_NEGATIVE,
            "friction": NOT_NEGATIVE,
        }
        given = {name: d for name, d in optional.items() if getattr(self, name) is not None}
        return {"side": POSITIVE} | given

    def more_collisions(self, diameter: Array, dimension: int) -> Float[Array, ""]:
        """Collision frequency over that of spheres without walls of the same mean density.

        ``prod_k L_k/W_k <prod_k (1 - |n_k| sigma/W_k)>`` over all directions n, with the width
        ``W_k = L_k - sigma`` that centres have: there is less room for them, and beside walls they
        meet others on one side only. Exact for a dilute gas.
        """
        widths = jnp.broadcast_to(self.side, (dimension,)) - diameter
        near = diameter / widths
        pairs = (jnp.sum(near) ** 2 - jnp.sum(near**2)) / 2
        room = jnp.prod(1 + near)
        if dimension == 2:
            return room * (1 - 2 / pi * jnp.sum(near) + pairs / pi)
        return room * (1 - jnp.sum(near) / 2 + 2 / (3 * pi) * pairs - jnp.prod(near) / (4 * pi))


class StokesDrag(eqx.Module):
    """Drag of a gas or liquid around the spheres, ``dv/dt = -gamma v``.

    Args:
        rate: gamma, 1/s, >= 0.
        rotational_rate: of ``dw/dt = -rate w`` of rough spheres, 1/s, >= 0; by Stokes' law
            ``4/(3 q)`` of gamma, 10/3 for solid spheres.

    Raises:
        ValueError: for a negative rate.

    >>> wet = dataclasses.replace(gas, drag=jaxgran.StokesDrag(0.1))
    >>> float(wet.value("drag_rate"))
    0.1
    """

    rate: Float[Array, ""] = eqx.field(converter=number)
    rotational_rate: Float[Array, ""] = eqx.field(converter=number, default=0.0)

    domains: ClassVar[dict[str, Domain]] = {"rate": NOT_NEGATIVE, "rotational_rate": NOT_NEGATIVE}

    def __check_init__(self):
        for name, domain in self.domains.items():
            domain.check(f"{name} of the drag", getattr(self, name), "Give it in 1/s.")


class WhiteNoise(eqx.Module):
    """A drive that heats the gas: each component of each velocity gets Gaussian white noise.

    ``dv_i/dt = xi_i(t)`` with ``<xi_i(t) xi_j(t')> = strength delta_ij delta(t - t')``, independent
    of each particle: T grows by ``dT/dt = strength``, and the velocities relax to a Maxwellian by
    ``da_2/dt = -2 a_2 strength/T``. Spins are not driven.

    `jaxgran.KineticTheory`, `jaxgran.DSMC` and `jaxgran.HardSpheres` take it; kicks keep the
    momentum where there are no walls. `jaxgran.steady_state` computes where it leads. In a steady
    state kinetic theory has steps of the length of the mean free time: 1e5 mean free times are
    within the default max_steps; for more use ``KineticTheory(solver=diffrax.Kvaerno5())``.

    Args:
        strength: xi_0^2, m^2/s^3, >= 0.

    Raises:
        ValueError: for a negative strength.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998).

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> float(driven.value("drive_strength"))
    0.001
    """

    strength: Float[Array, ""] = eqx.field(converter=number)

    domains: ClassVar[dict[str, Domain]] = {"strength": NOT_NEGATIVE}

    def __check_init__(self):
        advice = "Give the growth of T = <v^2>/d in time, m^2/s^3."
        NOT_NEGATIVE.check("strength of the drive", self.strength, advice)


class DrivenStart(eqx.Module):
    """A gas that white noise has driven into a steady state at T_0; at t = 0 it is switched off.

    The velocities are then not Maxwellian: a_2 begins at that of the steady state, in which
    ``da_2/dt = 0`` while the noise returns all that impacts, on walls too, take. Of rough spheres
    T_rot begins where ``dT_rot/dt = 0``, and their rotational_temperature is to be left out. Drag,
    where there is some, begins at t = 0.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998), for constant restitution.

    >>> gentle = dataclasses.replace(gas, preparation=jaxgran.DrivenStart())
    >>> type(gentle.preparation).__name__
    'DrivenStart'
    """


def share_of_container(gas: Any, num_particles: int | float) -> float:
    """Volume that N spheres of a gas have, over that of its container; 1 if they agree."""
    sides = np.broadcast_to(gas.container.side, (gas.dimension,))
    return float(num_particles / gas.number_density) / float(np.prod(sides))


def check_elements(gas: Any) -> None:
    """Raise ValueError for elements of a gas that do not go together, or not with its spheres."""
    if gas.preparation is not None and gas.surface is not None:
        rotation = gas.surface.rotational_temperature
        if is_known(rotation) and np.any(np.asarray(rotation) != 0):
            raise ValueError(
                "preparation=DrivenStart() determines T_rot at t = 0: leave rotational_temperature "
                f"or preparation out of the gas, got {np.asarray(rotation)} m^2/s^2"
            )
    if gas.drag is not None and gas.surface is None:
        rate = gas.drag.rotational_rate
        if is_known(rate) and np.any(np.asarray(rate) != 0):
            raise ValueError(
                "rotational_rate of the drag slows spins, which smooth spheres do not have, got "
                f"{np.asarray(rate)} 1/s: add surface=jaxgran.Rough(...), or leave it out"
            )
    if gas.container is not None:
        _check_walls(gas.container, gas.surface, gas.diameter, gas.dimension)


def _check_walls(walls: Walls, surface: Any, diameter: Array, dimension: int) -> None:
    """Raise ValueError for walls that cannot contain the spheres of a gas, or rub them."""
    if np.ndim(walls.side) > 0 and np.shape(walls.side) != (dimension,):
        raise ValueError(
            f"side of the walls must be one number or {dimension}, got shape {np.shape(walls.side)}"
        )
    least = Domain(low=2.1)
    least.check("side of the walls, over the diameter,", walls.side / diameter, "Enlarge it.")
    if walls.tangential_restitution is not None and not isinstance(surface, Rough):
        raise ValueError(
            "tangential_restitution of the walls needs rough spheres: add "
            "surface=jaxgran.Rough(...)"
        )
    if walls.friction is not None and (surface is None or isinstance(surface, Rough)):
        raise ValueError(
            "friction of the walls needs spheres that rub: add surface=jaxgran.Frictional(...), or "
            "use tangential_restitution with surface=jaxgran.Rough(...)"
        )
