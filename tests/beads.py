"""The gas of most tests."""

import jaxgran


def glass_beads(beta: float = 0.15, dimension: int = 3, **values) -> jaxgran.Gas:
    """A gas of 2 mm beads whose impacts at the thermal speed have a given beta."""
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(5e7, 0.22, 1e-6),
        diameter=0.002,
        mass=jaxgran.sphere_mass(0.002, 2500.0),
        packing_fraction=0.05,
        temperature=0.01,
        dimension=dimension,
    )
    return gas.replace(dissipative_constant=1e-6 * beta / gas.thermal_beta).replace(**values)
