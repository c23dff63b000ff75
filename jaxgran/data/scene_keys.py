"""Elements of a scene in the header of a curve: roughness, walls, drag and a drive."""

import warnings
from typing import Any

from jaxgran.data.header import header_number
from jaxgran.scene.elements import (
    SAME_VOLUME,
    Rough,
    StokesDrag,
    Walls,
    WhiteNoise,
    share_of_container,
)
from jaxgran.scene.friction import Frictional
from jaxgran.scene.gas import Gas

ROUGH_KEYS = ("beta_t", "reduced_inertia", "T_rot_0")
FRICTION_KEYS = ("tangential_damping", "friction")
WALL_KEYS = ("container_side", "wall_restitution", "wall_beta_t")
DRAG_KEYS = ("gamma",)
DRIVE_KEYS = ("drive_strength",)

REFUSED_KEYS = {
    "gravity": (
        0.0,
        "under gravity density and T change with height, and gases here are homogeneous",
    ),
    "polydispersity": (0.0, "grains of unequal masses have unequal temperatures, one T is too few"),
    "diameter_2": (None, "grains of a mixture have a temperature for each kind, one T is too few"),
    "density_2": (None, "grains of a mixture have a temperature for each kind, one T is too few"),
    "aspect_ratio": (
        1.0,
        "rods and ellipsoids meet at a rate that depends on how they lie, and turn at impacts that "
        "are smooth; here there are spheres",
    ),
    "cohesion": (0.0, "grains that stick lose all of their speed below some speed, and grow"),
    "surface_energy": (0.0, "grains that stick lose all of their speed below some speed, and grow"),
    "charge": (0.0, "charged grains are deflected without touching; here they fly freely"),
}
"""Keys of what no model here has: the value at which there is nothing of it, and the reason."""

OTHER_KEYS = ("N", "A", "dimension", "replicas", "T_from", "length_unit", "time_unit") + (
    "localisation_error",
)
"""Keys that say something besides the gas and its elements."""

PROVENANCE_KEYS = ("units", "points", "end_tau", "melt_tau", "steps_per_contact", "source")
"""Keys that say how a curve was made, and that nothing depends on."""


def read_elements(header: dict[str, str]) -> dict[str, Any]:
    """The elements that a header describes, as `jaxgran.Gas` takes them.

    Args:
        header: where spheres are rough beta_t and, if they are not .4 and 0, reduced_inertia,
            4 I/(m sigma^2), and T_rot_0, T_rot = I <w^2>/(d_rot m) at t = 0, m^2/s^2; where
            contacts last and rub tangential_damping and friction (`jaxgran.Frictional`, numbers
            without a unit) in place of beta_t; where there are walls container_side, of a cube, m,
            wall_restitution and, of rough ones, wall_beta_t; where there is drag gamma, 1/s, of
            dv/dt = -gamma v; where white noise drives the gas drive_strength, m^2/s^3, of
            dT/dt = drive_strength.

    Raises:
        ValueError: for a key that needs another one, a value outside its range, and for what no
            model here has: gravity, mixtures, rods, ellipsoids, cohesion and charges.
    """
    _refuse(header)
    found = {key: header_number(header, key) for key in header if key in ELEMENT_KEYS}
    elements: dict[str, Any] = {}
    surface = _surface(found)
    if surface is not None:
        elements["surface"] = surface
    if _whole(found, WALL_KEYS, needed=("container_side", "wall_restitution")):
        elements["container"] = Walls(
            found["container_side"],
            restitution=found["wall_restitution"],
            tangential_restitution=found.get("wall_beta_t"),
        )
    if "gamma" in found:
        elements["drag"] = StokesDrag(found["gamma"])
    if "drive_strength" in found:
        elements["drive"] = WhiteNoise(found["drive_strength"])
    return elements


def _surface(found: dict[str, float]) -> Rough | Frictional | None:
    inertia, rotation = found.get("reduced_inertia", 0.4), found.get("T_rot_0", 0.0)
    if _whole(found, FRICTION_KEYS, needed=FRICTION_KEYS):
        if "beta_t" in found:
            raise ValueError(
                "the header gives both beta_t, of impacts without duration, and friction, of "
                "contacts that last: leave beta_t out for SoftSpheres(N), friction and "
                "tangential_damping for the other models"
            )
        damping, friction = (found[key] for key in FRICTION_KEYS)
        return Frictional(damping, friction, inertia=inertia, rotational_temperature=rotation)
    if _whole(found, ROUGH_KEYS, needed=("beta_t",)):
        return Rough(found["beta_t"], inertia=inertia, rotational_temperature=rotation)
    return None


ELEMENT_KEYS = (*ROUGH_KEYS, *FRICTION_KEYS, *WALL_KEYS, *DRAG_KEYS, *DRIVE_KEYS)


def _refuse(header: dict[str, str]) -> None:
    for key, (nothing, reason) in REFUSED_KEYS.items():
        if key in header and (nothing is None or header_number(header, key) != nothing):
            advice = "" if nothing is None else f" (or {nothing:g}, where there is nothing of it)"
            raise ValueError(
                f"the header gives {key}: {reason}. No model of jaxgran takes it; fit a curve of "
                f"equal spheres without it, and leave {key} out{advice}"
            )


def check_volume(header: dict[str, str], gas: Gas) -> None:
    """Raise ValueError where N, eta, diameter and container_side of a header contradict."""
    if gas.container is None or "N" not in header:
        return
    number = header_number(header, "N")
    share = share_of_container(gas, number)
    if abs(share - 1) > SAME_VOLUME:
        raise ValueError(
            f"N, eta and container_side contradict: {number:g} spheres in this container have eta "
            f"= {float(gas.packing_fraction) * share:.4g}, the header gives "
            f"{float(gas.packing_fraction):.4g}"
        )


def _whole(found: dict[str, float], keys: tuple[str, ...], needed: tuple[str, ...]) -> bool:
    given = [key for key in keys if key in found]
    missing = [key for key in needed if key not in found]
    if given and missing:
        raise ValueError(f"the header gives {given[0]} without {missing[0]}; add {missing[0]}")
    return bool(given)


def warn_of_unknown_keys(header: dict[str, str], known: tuple[str, ...]) -> None:
    """Warn of header keys that nothing is made of. Comments that are no single word are not keys.

    Args:
        header: of a curve.
        known: keys of the gas and of its priors.
    """
    known = (*known, *ELEMENT_KEYS, *OTHER_KEYS, *PROVENANCE_KEYS, *REFUSED_KEYS)
    unknown = [key for key in header if key.isidentifier() and key not in known]
    if unknown:
        warnings.warn(
            f"the header key {unknown[0]!r} is not known, and nothing is made of it"
            + (f"; neither are {', '.join(unknown[1:])}" if unknown[1:] else "")
            + f": known are {', '.join(known)}",
            stacklevel=3,
        )
