"""Commands of LAMMPS that give spheres the contact law of a gas."""

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from jaxgran._utils.validation import POSITIVE
from jaxgran.scene.elements import Frictional, Rough
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import Viscoelastic
from jaxgran.scene.walls import Walls

STEPS_OF_CONTACT = 100
"""Time steps in the mean duration of a contact: eps is then right to 1e-3."""


def lammps_commands(gas: Gas, diameters: Sequence[float] | None = None) -> str:
    """Return the lines of a LAMMPS input that give spheres the contact law of a gas.

    The normal force is ``F = k sqrt(R_eff) xi^(3/2) + (3/2) A k sqrt(R_eff xi) dxi/dt`` with
    ``k = 2 Y/(3 (1 - nu^2))`` and ``1/R_eff = 1/R_i + 1/R_j``: ``hertz k eta`` with ``damping
    viscoelastic``, whose damping is ``eta m_eff sqrt(R_eff xi)``. So ``eta = (3/2) A k/m_eff``
    depends on the effective mass, ``m_i m_j/(m_i + m_j)`` of a pair and m_i of a sphere at a wall:
    each pair of sizes has a line of its own. With ``limit_damping`` the force never attracts:
    a contact ends where it vanishes, before the spheres part, as in jaxgran.

    Args:
        gas: its law must be viscoelastic; lasting friction (`jaxgran.Frictional`) and walls of a
            viscoelastic law have their lines, too.
        diameters: of atom types 1, 2, ..., m, at the density of the gas. By default one type of
            the diameter of the gas.

    Returns:
        Lines for ``units si`` and ``atom_style sphere``: pair_style, pair_coeff, fix wall/gran
        for walls at 0 and at the side of the container, and the time step, a hundredth of the
        shortest mean duration of a contact. ``newton off`` and ``comm_modify vel yes`` belong to
        them; box, atoms and an integrator are left to the user.

    Raises:
        ValueError: for another law, rough spheres in instantaneous impacts, other walls, several
            sizes at walls, and diameters out of range.

    Reference: LAMMPS documentation of pair_style granular (damping viscoelastic).

    >>> print(jaxgran.lammps_commands(gas).splitlines()[2])
    pair_style granular
    """
    gas.check_single()
    law = gas.law
    if not isinstance(law, Viscoelastic):
        raise ValueError(
            f"LAMMPS has no granular style for the law {type(law).__name__}: its viscoelastic "
            "contacts need jaxgran.Viscoelastic"
        )
    if isinstance(gas.surface, Rough):
        raise ValueError(
            "beta_t of instantaneous impacts has no counterpart in LAMMPS, whose contacts last: "
            "use jaxgran.Frictional(tangential_damping, friction), or leave out the surface"
        )
    sizes = [float(gas.diameter)] if diameters is None else [float(x) for x in diameters]
    if not sizes:
        raise ValueError("diameters must have at least one, got none")
    POSITIVE.check("diameters", np.asarray(sizes), "Give them in m.")
    masses = [float(gas.mass) * (x / float(gas.diameter)) ** 3 for x in sizes]
    lines = [
        "# F = k sqrt(R_eff) xi^(3/2) + eta m_eff sqrt(R_eff xi) dxi/dt, eta = (3/2) A k/m_eff;",
        "# contacts end at F = 0 (limit_damping)" if law.clipped else "# contacts end at xi = 0",
        "pair_style granular",
    ]
    for i, j in combinations_with_replacement(range(len(sizes)), 2):
        reduced = masses[i] * masses[j] / (masses[i] + masses[j])
        lines.append(f"pair_coeff {i + 1} {j + 1} {contact_law(law, reduced, gas.surface)}")
    lines += _wall_lines(gas, masses)
    # The duration grows in proportion to the diameter.
    shortest = float(gas.contact_duration) * min(sizes) / float(gas.diameter)
    lines.append(f"timestep {shortest / STEPS_OF_CONTACT:.6g}")
    return "\n".join(lines)


def contact_law(law: Viscoelastic, reduced_mass: float, surface: Frictional | Walls | None) -> str:
    """Return the contact law of a pair, or of a sphere and a wall, in the words of LAMMPS.

    Args:
        law: of the material.
        reduced_mass: m_eff, kg.
        surface: what has the tangential damping and the friction; None without.
    """
    k = float(2 * law.youngs_modulus / (3 * (1 - law.poisson_ratio**2)))
    eta = 1.5 * float(law.dissipative_constant) * k / reduced_mass
    damping = coefficient = 0.0
    if surface is not None and surface.friction is not None:
        assert surface.tangential_damping is not None  # which walls with friction have
        damping = float(surface.tangential_damping)
        coefficient = float(surface.friction)
    contact = (
        f"hertz {k!r} {eta!r} tangential linear_nohistory {damping!r} {coefficient!r} "
        "damping viscoelastic"
    )
    return f"{contact} limit_damping" if law.clipped else contact


def _wall_lines(gas: Gas, masses: list[float]) -> list[str]:
    """Return the walls of spheres of one mass, kg; ValueError for several."""
    walls = gas.container
    if walls is None:
        return []
    law = walls.restitution
    if not isinstance(law, Viscoelastic):
        raise ValueError(
            f"walls of the law {type(law).__name__} have no counterpart in LAMMPS' viscoelastic "
            "contacts: give the walls a jaxgran.Viscoelastic law"
        )
    if len(masses) > 1:
        raise ValueError(
            f"wall/gran has one damping for all spheres, and {len(masses)} sizes have different "
            "masses: give one diameter, or write a fix for the group of each size"
        )
    of_wall = contact_law(law, masses[0], walls)
    sides = np.broadcast_to(np.asarray(walls.side), (gas.dimension,))
    return [
        f"fix walls_{axis} all wall/gran granular {of_wall} {axis}plane 0 {float(side)!r}"
        for axis, side in zip("xyz", sides, strict=False)
    ]
