"""Optional elements of a scene: rough or frictional surfaces, drag, a drive.

Each element is an optional field of `Gas`. The compiled program of a gas without an element does
not contain it. Walls are in `jaxgran.scene.walls`.
"""

from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.tracing import is_known
from jaxgran._utils.validation import Domain
from jaxgran.scene.geometry import MIN_BOX
from jaxgran.scene.parameters import (
    ADVICE,
    Parameter,
    fields_of,
    number_named,
    optional_number_named,
)

NUM_SPIN_COMPONENTS = {2: 1, 3: 3}
"""Number of components of the angular velocity, d_rot, by dimension."""


class Element(eqx.Module):
    """Base class of the elements, whose parameters have ranges in `jaxgran.scene.parameters`."""

    part: ClassVar[str] = ""
    """End of the names of fields in messages, as " of the walls"."""

    @property
    def domains(self) -> dict[str, Domain]:
        """Allowed range of each float that is given."""
        return {name: p.domain for name, p in self._parameters.items()}

    @property
    def _parameters(self) -> dict[str, Parameter]:
        known = fields_of(type(self).__name__)
        return {name: p for name, p in known.items() if getattr(self, name) is not None}

    def __check_init__(self):
        for name, p in self._parameters.items():
            p.domain.check(f"{name}{self.part}", getattr(self, name), ADVICE.get(p.name, ""))


class Rough(Element):
    """Rough spheres, which rotate: the tangential velocity at contact is multiplied by -beta_t.

    The velocity at contact is ``u = v_i - v_j - (sigma/2) (w_i + w_j) x n`` with the unit vector n
    from j to i and angular velocities w. An impact changes its normal part by -eps(|u_n|) and its
    tangential part by -beta_t: with ``eta = q (1 + beta_t) / (2 (1 + q))``

        v_i -> v_i - (1 + eps)/2 u_n - eta u_t,    w_i -> w_i + (2 eta/(q sigma)) n x u_t.

    v_j changes by the opposite of the change of v_i, and w_j by the same amount as w_i. The energy
    lost in the tangential motion is ``(m/4) q/(1 + q) (1 - beta_t^2) u_t^2``.

    With `friction` Coulomb's limit holds: the tangential impulse is at most mu times the normal
    one. Where ``eta |u_t|`` exceeds ``mu (1 + eps)/2 |u_n|`` the spheres slide, and ``eta u_t`` is
    shortened to this length; in steeper impacts they stick. Impacts on rough walls have the mu of
    the spheres.

    Args:
        tangential_restitution: beta_t, in [-1, 1], equal for all impacts; -1 is smooth.
        inertia: q = 4 I/(m sigma^2), in (0, 1]: 2/5 for a solid sphere, 2/3 for a hollow sphere,
            1/2 for a disk.
        rotational_temperature: T_rot = I <w^2>/(d_rot m) at t = 0, m^2/s^2, >= 0, with d_rot = 3
            (1 in a plane).
        friction: mu, Coulomb's coefficient, >= 0; None for no limit.

    Raises:
        ValueError: for a value outside its range.

    Reference: Huthmann & Zippelius, Phys. Rev. E 56, R6275 (1997). The law with friction is by
    Walton (1993), as Foerster, Louge, Chang & Allia measured it on beads, Phys. Fluids 6, 1108
    (1994).

    >>> rough = dataclasses.replace(gas, surface=jaxgran.Rough(0.5, rotational_temperature=0.002))
    >>> float(rough.value("tangential_restitution"))
    0.5
    """

    tangential_restitution: Float[Array, ""] = eqx.field(
        converter=number_named("tangential_restitution")
    )
    inertia: Float[Array, ""] = eqx.field(converter=number_named("inertia"), default=0.4)
    rotational_temperature: Float[Array, ""] = eqx.field(
        converter=number_named("rotational_temperature"), default=0.0
    )
    friction: Float[Array, ""] | None = eqx.field(
        converter=optional_number_named("friction"), default=None
    )


class Frictional(Element):
    """Frictional spheres, which rotate: a viscous tangential force with Coulomb's upper limit.

    The slip velocity ``u_t`` is the tangential part of ``u = v_i - v_j - l (w_i + w_j) x n`` with
    the unit vector n from j to i, angular velocities w and half the distance of the centres,
    ``l = (sigma - xi)/2``. The force on i is

        F_t = -min(x_t (3/2) A rho sqrt(xi) |u_t|, mu F_n) u_t/|u_t|

    with the normal force F_n of `jaxgran.contact_force`, and the torque on both spheres is
    ``-l n x F_t``: energy is lost at the rate ``|F_t| |u_t|``, and the angular momentum of a pair
    is conserved. The force does not depend on the history of the slip; hence there is no static
    friction.

    This is ``tangential linear_nohistory x_t mu`` of ``pair_style granular`` in LAMMPS, except that
    LAMMPS uses sigma/2 instead of l in the slip velocity, a relative difference of xi/sigma in the
    contribution of rotation.

    `jaxgran.SoftSpheres` supports it. Models of instantaneous impacts use `jaxgran.Rough` instead.

    Args:
        tangential_damping: x_t, ratio of tangential to normal damping, >= 0.
        friction: mu, Coulomb's coefficient, >= 0.
        inertia: q = 4 I/(m sigma^2), in (0, 1]: 2/5 for a solid sphere, 2/3 for a hollow sphere,
            1/2 for a disk.
        rotational_temperature: T_rot = I <w^2>/(d_rot m) at t = 0, m^2/s^2, >= 0, with d_rot = 3
            (1 in a plane).

    Raises:
        ValueError: for a value outside its range.

    Reference: Luding, Granular Matter 10, 235 (2008), without the tangential spring.

    >>> grains = jaxgran.Frictional(tangential_damping=0.5, friction=0.3)
    >>> frictional = dataclasses.replace(gas, surface=grains)
    >>> float(frictional.value("friction"))
    0.3
    """

    tangential_damping: Float[Array, ""] = eqx.field(converter=number_named("tangential_damping"))
    friction: Float[Array, ""] = eqx.field(converter=number_named("friction"))
    inertia: Float[Array, ""] = eqx.field(converter=number_named("inertia"), default=0.4)
    rotational_temperature: Float[Array, ""] = eqx.field(
        converter=number_named("rotational_temperature"), default=0.0
    )


class StokesDrag(Element):
    """Drag of a gas or liquid around the spheres, ``dv/dt = -gamma v``.

    Args:
        rate: gamma, 1/s, >= 0.
        rotational_rate: rate in ``dw/dt = -rate w`` of spheres that rotate, 1/s, >= 0; by Stokes'
            law it is ``4/(3 q)`` gamma, that is 10/3 gamma for solid spheres.

    Raises:
        ValueError: for a negative rate.

    >>> wet = dataclasses.replace(gas, drag=jaxgran.StokesDrag(0.1))
    >>> float(wet.value("drag_rate"))
    0.1
    """

    rate: Float[Array, ""] = eqx.field(converter=number_named("rate of the drag"))
    rotational_rate: Float[Array, ""] = eqx.field(
        converter=number_named("rotational_rate of the drag"), default=0.0
    )

    part: ClassVar[str] = " of the drag"


class WhiteNoise(Element):
    """A drive that heats the gas: Gaussian white noise on each component of each velocity.

    ``dv_i/dt = xi_i(t)`` with ``<xi_i(t) xi_j(t')> = strength delta_ij delta(t - t')``, independent
    for each particle: T grows by ``dT/dt = strength``, and the velocities relax to a Maxwellian by
    ``da_2/dt = -2 a_2 strength/T``. Spins are not driven.

    `jaxgran.KineticTheory`, `jaxgran.DSMC` and `jaxgran.HardSpheres` support it. The kicks conserve
    the total momentum if there are no walls. `jaxgran.steady_state` computes the steady state. In a
    steady state the steps of kinetic theory are as long as the mean free time: the default
    max_steps suffices for 1e5 mean free times; for more use
    ``KineticTheory(solver=diffrax.Kvaerno5())``.

    Args:
        strength: xi_0^2, m^2/s^3, >= 0.

    Raises:
        ValueError: for a negative strength.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998).

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> float(driven.value("drive_strength"))
    0.001
    """

    strength: Float[Array, ""] = eqx.field(converter=number_named("strength of the drive"))

    part: ClassVar[str] = " of the drive"


def check_elements(gas: Any) -> None:
    """Raise ValueError for elements of a gas that cannot be combined."""
    if gas.drag is not None and gas.surface is None:
        rate = gas.drag.rotational_rate
        if is_known(rate) and np.any(np.asarray(rate) != 0):
            raise ValueError(
                "rotational_rate of the drag needs spheres that rotate, got a rate of "
                f"{np.asarray(rate)} 1/s. Add surface=jaxgran.Rough(...), or leave it out."
            )
    if gas.container is not None:
        _check_walls(gas)


def _check_walls(gas: Any) -> None:
    walls = gas.container
    surface = gas.surface
    dimension = gas.dimension
    if np.ndim(walls.side) > 0 and np.shape(walls.side) != (dimension,):
        raise ValueError(
            f"side of the walls must be one number or {dimension} numbers, got shape "
            f"{np.shape(walls.side)}"
        )
    sides = Domain(low=MIN_BOX)
    sides.check("side of the walls / diameter", walls.side / gas.diameter, "Enlarge the box.")
    if walls.tangential_restitution is not None and not isinstance(surface, Rough):
        raise ValueError(
            "tangential_restitution of the walls needs rough spheres: add "
            "surface=jaxgran.Rough(...)"
        )
    if walls.friction is not None and (surface is None or isinstance(surface, Rough)):
        raise ValueError(
            "friction of the walls needs frictional spheres: add surface=jaxgran.Frictional(...), "
            "or use tangential_restitution with surface=jaxgran.Rough(...)"
        )
