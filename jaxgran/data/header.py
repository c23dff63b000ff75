"""The gas that the header of a file describes, and questions about it."""

from collections.abc import Iterator, Mapping
from math import pi
from typing import Any

import numpy as np

from jaxgran.data.header_elements import elements_of_header
from jaxgran.data.header_keys import (
    GUESS,
    OPTIONAL_KEYS,
    PRIOR_KEYS,
    PROVENANCE_KEYS,
    UNSUPPORTED_KEYS,
    VISCOELASTIC_KEYS,
)
from jaxgran.data.header_values import header_dimension, header_number, header_sides
from jaxgran.data.units import UNIT_KEYS
from jaxgran.data.usual_values import ask_about_header
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import sphere_mass
from jaxgran.scene.laws import ConstantRestitution, RestitutionLaw, Viscoelastic
from jaxgran.scene.parameters import BY_SYMBOL, REQUIRED
from jaxgran.scene.walls import VOLUME_TOLERANCE, container_volume_ratio

MAX_DIFFERENCE = 0.01
"""Relative difference of a value in a header to the one that is used, above which is asked."""


def checked_header(header: Any) -> dict[str, str]:
    """Return the entries that a user gave for a header as texts.

    Raises:
        ValueError: unless they are a dictionary of texts and numbers.
    """
    kinds = str, int, float, np.number
    if not isinstance(header, dict) or not all(isinstance(x, kinds) for x in header.values()):
        raise ValueError(
            "header must be a dictionary of texts and numbers, as {'N': 250, 'diameter': '2 mm'}, "
            f"got {header!r:.60}"
        )
    return {str(key): str(value) for key, value in header.items()}


def gas_of_header(header: dict[str, str]) -> tuple[Gas, list[str]]:
    """Return the gas that the header of a file describes, and questions about unusual values.

    Args:
        header: in SI: eta (the packing fraction), diameter (m; the mean one), density (of the
            material, kg/m^3), Y (Pa), nu, T0 (m^2/s^2) and, if it is not 3, dimension; A (s), 0 by
            default; eps in place of Y, nu and A for a constant restitution; where sizes differ
            diameter_sd, their standard deviation (m); for rough spheres, walls, drag and a drive
            also the keys of `elements_of_header`.

    Returns:
        A gas, and a question for each value that is not usual in a granular
        gas, and for unknown keys.

    Raises:
        ValueError: for a missing key, a value that is not a number or outside its range, and for
            elements that `elements_of_header` does not support.

    >>> from jaxgran.data.header import gas_of_header
    >>> header = {"eta": "0.05", "diameter": "2e-3", "density": "2500", "T0": "0.01"}
    >>> header |= {"Y": "5e7", "nu": "0.22"}
    >>> float(gas_of_header(header)[0].packing_fraction)
    0.05
    """
    gas = make_gas(header)
    entries = dict(header)
    if "container_side" in header:
        entries["container_side"] = str(np.max(header_sides(header)))
    quantities = {*BY_SYMBOL, *PRIOR_KEYS}
    numbers = {
        key: header_number(entries, key)
        for key in header
        if key in quantities and header[key] != GUESS
    }
    return gas, [*ask_about_header(numbers), *_ask_about_unknown_keys(header)]


def ask_about_another_gas(header: dict[str, str], gas: Gas) -> list[str]:
    """Return questions about a header that describes another sphere than the gas that is used."""
    sphere = gas.parameters | {"density": 6 / pi * gas.mass / gas.diameter**3}
    questions = list(_ask_about_unknown_keys(header))
    for key in ("diameter", "density", "Y", "nu", "eps"):
        name = BY_SYMBOL[key].name
        if key not in header or name not in sphere:
            continue
        given = header_number(header, key)
        used = float(sphere[name])
        if abs(given - used) > MAX_DIFFERENCE * abs(used):
            questions.append(
                f"{key} is {given:g} in this header, but {used:.4g} in the gas that is used: "
                "impacts of other spheres need a header of all of them, read without this gas"
            )
    return questions


def _ask_about_unknown_keys(header: dict[str, str]) -> Iterator[str]:
    known = dict.fromkeys((*REQUIRED, *BY_SYMBOL, *OPTIONAL_KEYS, *UNIT_KEYS))
    others = {*known, *PRIOR_KEYS, *PROVENANCE_KEYS, *UNSUPPORTED_KEYS}
    # Comments that are no single word are not keys.
    unknown = [key for key in header if key.isidentifier() and key not in others]
    if unknown:
        yield (
            f"ignoring unknown header keys: {', '.join(unknown)}. Known keys are "
            f"{', '.join(known)}, and errors such as eta_err"
        )


def gas_or_none(header: dict[str, str]) -> Gas | None:
    """Return the gas of a header, or None if the header does not describe one."""
    try:
        return make_gas(header)
    except ValueError:  # `gas_of_header` says why
        return None


def make_gas(header: dict[str, str]) -> Gas:
    """Return the gas that a header describes: see `gas_of_header`."""
    d = header_dimension(header)
    if "eta" not in header and {"N", "container_side", "diameter"} <= header.keys():
        header = header | {"eta": repr(_packing_fraction_in_container(header, d))}
    missing = missing_keys(header)
    if missing:
        raise ValueError(
            f"the header lacks {', '.join(missing)}; add lines such as '# {missing[0]}: VALUE' "
            f"(needed: {', '.join(REQUIRED)}; in SI units, or with a unit behind the value; "
            "'# eps: VALUE', a constant restitution, replaces Y and nu)"
        )
    scene_keys = (key for key in REQUIRED if key not in VISCOELASTIC_KEYS)
    values = {key: header_number(header, key) for key in scene_keys}
    spread: Any = None
    if "diameter_sd" in header:
        spread = header_number(header, "diameter_sd")
    gas = Gas(
        law_of_header(header),
        diameter=values["diameter"],
        mass=sphere_mass(values["diameter"], values["density"]),
        packing_fraction=values["eta"],
        temperature=values["T0"],
        dimension=d,
        diameter_sd=spread,
        **elements_of_header(header),
    )
    if gas.container is not None and "N" in header:
        _check_number(gas, header_number(header, "N"))
    return gas


def _packing_fraction_in_container(header: dict[str, str], d: int) -> float:
    """Return the packing fraction of N spheres in a container of d dimensions."""
    size = header_number(header, "diameter")
    sphere = pi / 6 * size**3 if d == 3 else pi / 4 * size**2
    spread = header_number({"diameter_sd": "0"} | header, "diameter_sd") / size
    sphere *= 1 + (2 * d - 3) * spread**2
    volume = np.prod(np.broadcast_to(header_sides(header), d))
    return float(header_number(header, "N") * sphere / volume)


def _check_number(gas: Gas, number: float) -> None:
    """Raise ValueError unless a number of spheres has the gas's packing fraction in its walls."""
    eta = float(gas.packing_fraction)
    ratio = container_volume_ratio(gas, number)
    if abs(ratio - 1) > VOLUME_TOLERANCE:
        raise ValueError(
            f"N, eta and container_side contradict: {number:g} spheres in this container have "
            f"eta = {eta * ratio:.4g}, but the header gives {eta:.4g}; correct one of them"
        )


def missing_keys(header: Mapping[str, str]) -> list[str]:
    """Return the keys that a header must give and does not."""
    replaced = VISCOELASTIC_KEYS if "eps" in header else ()
    return [key for key in REQUIRED if key not in header and key not in replaced]


def law_of_header(header: dict[str, str]) -> RestitutionLaw:
    """Return the law of restitution: constant with the key eps, else of viscoelastic spheres.

    Raises:
        ValueError: for keys of both laws.
    """
    if "eps" not in header:
        entries = {"A": "0"} | header
        Y, nu, A = (header_number(entries, key) for key in VISCOELASTIC_KEYS)
        return Viscoelastic(Y, nu, A)
    if both := [key for key in VISCOELASTIC_KEYS if key in header]:
        raise ValueError(
            f"the header gives eps, a constant restitution, and {', '.join(both)} of viscoelastic "
            f"spheres: leave out eps or {', '.join(both)}"
        )
    return ConstantRestitution(header_number(header, "eps"))
