"""Gases of several experiments."""

import jaxgran


def beads(
    packing_fraction: float,
    beta: float,
    contact_fraction: float | None = None,
    dimension: int = 3,
) -> jaxgran.Gas:
    """Return viscoelastic beads of 2 mm with T = 0.01 m^2/s^2.

    Args:
        packing_fraction: phi.
        beta: dissipation of an impact at the speed sqrt(2 T), `jaxgran.Gas.thermal_beta`.
        contact_fraction: contact duration over mean free time; fixes Y. None for Y = 1e7 Pa.
        dimension: 2 or 3.
    """
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(1e7, 0.22, 1e-6),
        diameter=2e-3,
        mass=jaxgran.sphere_mass(2e-3, 2500.0),
        packing_fraction=packing_fraction,
        temperature=0.01,
        dimension=dimension,
    )
    if contact_fraction is not None:
        stiffer = (float(gas.contact_fraction) / contact_fraction) ** 2.5
        gas = gas.replace(youngs_modulus=stiffer * gas.value("youngs_modulus"))
    return gas.replace(dissipative_constant=1e-6 * beta / float(gas.thermal_beta))


def hard_beads(packing_fraction: float, restitution: float, dimension: int = 3) -> jaxgran.Gas:
    """Return the beads of `beads`, with a constant coefficient of restitution."""
    return jaxgran.Gas(
        jaxgran.ConstantRestitution(restitution),
        diameter=2e-3,
        mass=jaxgran.sphere_mass(2e-3, 2500.0),
        packing_fraction=packing_fraction,
        temperature=0.01,
        dimension=dimension,
    )
