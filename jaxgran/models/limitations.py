"""Limits of validity of models of instantaneous impacts and of a homogeneous gas."""

import numpy as np

from jaxgran.models.base import Limitation
from jaxgran.models.scales import scales_at
from jaxgran.scene.gas import Gas

CONTACT_LIMIT = 0.03
"""Contact duration over mean free time above which impacts are not instantaneous and binary."""

OVERLAP_LIMIT = 0.01
"""Mean overlap, in diameters, above which the first-order softness correction fails."""

CORRELATED_PACKING = {2: 0.4, 3: 0.25}
"""Packing fraction above which successive collisions are correlated, by dimension."""

CRYSTAL_PACKING = {2: 0.72, 3: 0.545}
"""Packing fraction above which hard disks and spheres are a crystal, by dimension."""

MAX_WALL_DISTANCE = 50.0
"""Distance of walls, in mean free paths, up to which theory was compared with hard spheres: the
error of the clock includes what was found (`jaxgran.models.error_model.WALL_ERROR`)."""

SOFT_SPHERES_NEEDED = "This scene needs soft spheres, which resolve every contact in time."
POSITIONS_NEEDED = "This scene needs particles with positions."


def limitations_of_instant_impacts(
    gas: Gas, consequence: str = "which instantaneous impacts leave out"
) -> tuple[Limitation, ...]:
    """Return the limitations of a model of instantaneous, binary impacts.

    Args:
        gas: the scene.
        consequence: the relative clause about overlaps that are not small.
    """
    effects = []
    scales = scales_at(gas)
    if scales.contact_fraction > CONTACT_LIMIT:
        effects.append(
            f"contacts last {scales.contact_fraction:.2g} of the mean free time, so three spheres "
            "are often in contact at once"
        )
    if scales.overlap > OVERLAP_LIMIT:
        effects.append(
            f"spheres overlap by {100 * scales.overlap:.2g} % of a diameter, {consequence}"
        )
    return tuple(Limitation(words, True, SOFT_SPHERES_NEEDED) for words in effects)


def limitations_of_homogeneity(gas: Gas, num_particles: int | None) -> tuple[Limitation, ...]:
    """Return the limitations of a model of a homogeneous, uncorrelated gas.

    Args:
        gas: the scene.
        num_particles: N of the gas, which determines its box; None if unknown.
    """
    effects = []
    phi = float(gas.packing_fraction)
    limit = CORRELATED_PACKING[gas.dimension]
    if phi > limit:
        effects.append(
            f"the packing fraction {phi:.2g} is above {limit:g}, where successive collisions are "
            "correlated"
        )
    scales = scales_at(gas)
    if gas.container is not None:
        side = float(np.min(gas.container.side) / scales.mean_free_path)
        if side > MAX_WALL_DISTANCE:
            effects.append(
                f"walls are {side:.2g} mean free paths apart, and the gas is taken as mixed, which "
                f"was compared with hard spheres up to {MAX_WALL_DISTANCE:g}"
            )
    elif num_particles is not None:
        diameter = float(gas.diameter)
        box = scales.box_side(num_particles, gas.dimension)
        critical = float(scales.critical_box)
        if box > critical:
            effects.append(
                f"the box, {box / diameter:.3g} diameters, is above "
                f"L_c = {critical / diameter:.3g}: a flow grows, and clusters after it"
            )
    limitations = [Limitation(words, False, POSITIONS_NEEDED) for words in effects]
    limit = CRYSTAL_PACKING[gas.dimension]
    if phi > limit:
        words = (
            f"packing_fraction {phi:.3g} is above {limit:g}, where spheres form a crystal or a "
            "glass, and the contact value holds for a fluid"
        )
        limitations.append(Limitation(words, True, POSITIONS_NEEDED))
    return tuple(limitations)


def describe_walls(gas: Gas, num_particles: int) -> str:
    """Compare the box of N spheres with the mean free path, and estimate the effect of walls.

    A sphere of mean speed <v> meets walls ``2 d/L <|v_x|>/2`` times a second, with
    ``<|v_x|>/<v> = 1/2`` (2/pi in a plane).
    """
    scales = scales_at(gas)
    path = float(scales.mean_free_path)
    if gas.container is not None:
        apart = float(np.min(gas.container.side)) / path
        return f"has walls, {apart:.2g} mean free paths apart"
    length = scales.box_side(num_particles, gas.dimension) / path
    often = gas.dimension / length * {2: 2 / np.pi, 3: 0.5}[gas.dimension]
    return (
        f"is {length:.2g} mean free paths long: if it has walls, spheres meet them {often:.2g} "
        "times as often as each other, and the gas needs container=Walls(...)"
    )
