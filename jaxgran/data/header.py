"""The gas that the header of a file describes: its keys, elements, priors and declared absences."""

import dataclasses
import re
from collections.abc import Iterator, Mapping
from math import pi
from typing import Any

import numpy as np

from jaxgran.data import files, tracks
from jaxgran.data.questions import ask_about_header
from jaxgran.data.tables import UNIT_KEYS
from jaxgran.scene.elements import (
    VOLUME_TOLERANCE,
    Frictional,
    Rough,
    Walls,
    container_volume_ratio,
)
from jaxgran.scene.gas import ELEMENTS, Gas
from jaxgran.scene.geometry import sphere_mass
from jaxgran.scene.laws import ConstantRestitution, RestitutionLaw, Viscoelastic
from jaxgran.scene.parameters import BY_SYMBOL, REQUIRED, fields_of

OPTIONAL_KEYS = (
    "N",
    "dimension",
    "replicas",
    "absent",
    "tracked",
    "T0_of",
    "T_scale_err",
    "errors",
    "onto",
    "eps_scatters",
    "spin_before",
    "T_from",
    "T_of",
    *tracks.TRACK_KEYS,
)
"""Further known header keys, neither of the gas nor of its elements."""

PROVENANCE_KEYS = ("units", "points", "end_tau", "melt_tau", "steps_per_contact", "source")
"""Keys that document the origin of a curve, and that no result depends on."""

PRIOR_KEYS = {f"{symbol}_err": p.name for symbol, p in BY_SYMBOL.items() if symbol != "A"}
"""Header keys of standard errors, and the names of their priors in `jaxgran.fit`."""

MAX_DIFFERENCE = 0.01
"""Relative difference of a value in a header to the one that is used, above which is asked."""

GUESS = "guess"
GUESSES = {
    "beta_t": 0.0,
    "friction": 0.3,
    "gamma": 0.0,
    "wall_restitution": 1.0,
    "wall_beta_t": 0.0,
}
"""Header keys whose value may be "guess", and the values from which a fit then starts."""

ABSENT = {
    "walls": ("container_side", "wall_restitution"),
    "roughness": ("beta_t",),
    "drag": ("gamma",),
    "friction": ("friction",),
}
"""Effects that the header key ``absent`` may name, and the keys that describe them."""

MEASURED = "measured"
"""Value of the header key ``errors``: T_err is the error of the measurement, whatever its size."""

VISCOELASTIC_KEYS = ("Y", "nu", "A")
"""Header keys of the law of viscoelastic spheres, which eps replaces."""

ANY_GAS = {"eta": "0.1", "T0": "0.01"}
"""Header keys that single impacts do not depend on."""

EXACT_DENSITY_ERROR = 1e-4
"""Relative error of the prior of a density without an error, where the diameter has one."""

_MIXTURE = (
    "grains of a mixture have a temperature for each kind, and one T is too few; diameters with a "
    "standard deviation of at most a fifth of their mean have the key diameter_sd"
)
_STICKING = "grains that stick lose all of their speed below some speed, and grow"

UNSUPPORTED_KEYS = {
    "gravity": (0.0, "under gravity density and T change with height, but gases are homogeneous"),
    "polydispersity": (
        0.0,
        "grains of unequal masses have unequal temperatures, and sizes have the key diameter_sd, "
        "the standard deviation of the diameters in m",
    ),
    "diameter_2": (None, _MIXTURE),
    "density_2": (None, _MIXTURE),
    "aspect_ratio": (1.0, "rods and ellipsoids collide at another rate and rotate"),
    "cohesion": (0.0, _STICKING),
    "surface_energy": (0.0, _STICKING),
    "charge": (0.0, "charged grains are deflected without touching, but grains fly freely"),
}
"""Keys of effects that no model has: the value that means "no effect" (or None), and the reason."""


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
    quantities = {*BY_SYMBOL, *PRIOR_KEYS}
    sides = {key: str(np.max(header_sides(header))) for key in header if key == "container_side"}
    numbers = {
        key: files.header_number(header | sides, key)
        for key in header
        if key in quantities and header[key] != GUESS
    }
    return gas, [*ask_about_header(numbers), *_ask_about_unknown_keys(header)]


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


def ask_about_another_gas(header: dict[str, str], gas: Gas) -> list[str]:
    """Return questions about a header that describes another sphere than the gas that is used."""
    sphere = gas.parameters | {"density": 6 / pi * gas.mass / gas.diameter**3}
    questions = list(_ask_about_unknown_keys(header))
    for key in ("diameter", "density", "Y", "nu", "eps"):
        name = BY_SYMBOL[key].name
        if key not in header or name not in sphere:
            continue
        given = files.header_number(header, key)
        used = float(sphere[name])
        if abs(given - used) > MAX_DIFFERENCE * abs(used):
            questions.append(
                f"{key} is {given:g} in this header, but {used:.4g} in the gas that is used: "
                "impacts of other spheres need a header of all of them, read without this gas"
            )
    return questions


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


def gas_or_none(header: dict[str, str]) -> Gas | None:
    """Return the gas of a header, or None if the header does not describe one."""
    try:
        return make_gas(header)
    except ValueError:  # `gas_of_header` says why
        return None


def make_gas(header: dict[str, str]) -> Gas:
    """Return the gas that a header describes: see `gas_of_header`."""
    d = files.header_count(header, "dimension") or 3
    if "eta" not in header and {"N", "container_side", "diameter"} <= header.keys():
        size = files.header_number(header, "diameter")
        sphere = pi / 6 * size**3 if d == 3 else pi / 4 * size**2
        spread = files.header_number({"diameter_sd": "0"} | header, "diameter_sd") / size
        sphere *= 1 + (2 * d - 3) * spread**2
        volume = np.prod(np.broadcast_to(header_sides(header), d))
        header = header | {"eta": repr(float(files.header_number(header, "N") * sphere / volume))}
    missing = missing_keys(header)
    if missing:
        raise ValueError(
            f"the header lacks {', '.join(missing)}; add lines such as '# {missing[0]}: VALUE' "
            f"(needed: {', '.join(REQUIRED)}; in SI units, or with a unit behind the value; "
            "'# eps: VALUE', a constant restitution, replaces Y and nu)"
        )
    scene_keys = (key for key in REQUIRED if key not in VISCOELASTIC_KEYS)
    values = {key: files.header_number(header, key) for key in scene_keys}
    sizes: dict[str, Any] = {}
    if "diameter_sd" in header:
        sizes["diameter_sd"] = files.header_number(header, "diameter_sd")
    gas = Gas(
        law_of_header(header),
        diameter=values["diameter"],
        mass=sphere_mass(values["diameter"], values["density"]),
        packing_fraction=values["eta"],
        temperature=values["T0"],
        dimension=d,
        **sizes,
        **elements_of_header(header),
    )
    if gas.container is not None and "N" in header:
        number = files.header_number(header, "N")
        eta = float(gas.packing_fraction)
        ratio = container_volume_ratio(gas, number)
        if abs(ratio - 1) > VOLUME_TOLERANCE:
            raise ValueError(
                f"N, eta and container_side contradict: {number:g} spheres in this container have "
                f"eta = {eta * ratio:.4g}, but the header gives {eta:.4g}; correct one of them"
            )
    return gas


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
        Y, nu, A = (files.header_number(entries, key) for key in VISCOELASTIC_KEYS)
        return Viscoelastic(Y, nu, A)
    if both := [key for key in VISCOELASTIC_KEYS if key in header]:
        raise ValueError(
            f"the header gives eps, a constant restitution, and {', '.join(both)} of viscoelastic "
            f"spheres: leave out eps or {', '.join(both)}"
        )
    return ConstantRestitution(files.header_number(header, "eps"))


def elements_of_header(header: dict[str, str]) -> dict[str, Any]:
    """Return the elements that a header describes, as keyword arguments of `jaxgran.Gas`.

    Args:
        header: for rough spheres beta_t and, if they are not 0.4 and 0, reduced_inertia,
            4 I/(m sigma^2), and T_rot_0, T_rot = I <w^2>/(d_rot m) at t = 0, m^2/s^2, and, if they
            slide, Coulomb's coefficient friction; for lasting contacts with friction
            tangential_damping and friction (`jaxgran.Frictional`, numbers without a unit) in place
            of beta_t; for walls container_side, of a cube, m, or "8 x 6 x 4 cm",
            wall_restitution and, for rough walls, wall_beta_t; for drag gamma, 1/s, of
            dv/dt = -gamma v; for a drive by white noise drive_strength, m^2/s^3, of
            dT/dt = drive_strength.

    Raises:
        ValueError: for a key that needs another one, a value outside its range, and for effects
            that no model has: gravity, mixtures, rods, ellipsoids, cohesion and charges.
    """
    for key, (neutral, reason) in UNSUPPORTED_KEYS.items():
        if key in header and (neutral is None or files.header_number(header, key) != neutral):
            advice = "" if neutral is None else f" or set it to {neutral:g}"
            raise ValueError(
                f"the header gives {key}: {reason}. No model of jaxgran supports it; fit a curve "
                f"of equal spheres without it, and leave {key} out{advice}"
            )
    lasting = "tangential_damping" in header
    rough = "beta_t" in header
    if lasting and rough:
        raise ValueError(
            "the header gives both beta_t (instantaneous impacts) and tangential_damping (lasting "
            "contacts). Leave out beta_t for SoftSpheres(N), or tangential_damping for the other "
            "models"
        )
    unused = Rough if lasting or ("friction" in header and not rough) else Frictional
    elements = {}
    for name, kind in ((name, kind) for name, kinds in ELEMENTS.items() for kind in kinds):
        symbols = {field: p.symbol for field, p in fields_of(kind.__name__).items() if p.symbol}
        symbols |= {"restitution": "wall_restitution"} if kind is Walls else {}
        fields = {symbol: field for field, symbol in symbols.items()}
        given = [key for key in header if key in fields]
        if not given or kind is unused:
            continue
        required = (x.name for x in dataclasses.fields(kind) if x.default is dataclasses.MISSING)
        if missing := [symbols[x] for x in required if symbols[x] not in header]:
            fitted = f", or the line '# {missing[0]}: guess' to fit it (--free {missing[0]})"
            raise ValueError(
                f"the header gives {given[0]} without {missing[0]}; add {missing[0]}"
                + (fitted if missing[0] in GUESSES else "")
            )
        values = header | {key: GUESSES[key] for key in GUESSES if header.get(key) == GUESS}
        arguments: dict[str, Any] = {}
        for key in given:
            if key == "container_side":
                arguments[fields[key]] = header_sides(values)
            else:
                arguments[fields[key]] = files.header_number(values, key)
        elements[name] = kind(**arguments)
    return elements


def header_sides(header: Mapping[str, Any]) -> float | list[float]:
    """Return the side of a cubic or square container, or its d sides, m."""
    sides = [
        files.header_number({"container_side": part.strip()}, "container_side")
        for part in str(header["container_side"]).split("x")
    ]
    return sides if len(sides) > 1 else sides[0]


def priors_of_header(header: dict[str, str]) -> dict[str, tuple[float, float]]:
    """Return the standard errors of a header in the form of ``priors`` of `jaxgran.Measurement`.

    Where the diameter has an error and the density has none, the mass follows the diameter.

    Args:
        header: with some of eta_err, diameter_err, density_err, Y_err, nu_err, T0_err, t0_err,
            beta_t_err and so on, the standard errors of the other keys, in their units. The value
            of t0, the time at which the gas began to cool, is 0 unless the header gives it.

    Raises:
        ValueError: for an error without its value, or one that is not a positive number.

    >>> from jaxgran.data.header import priors_of_header
    >>> priors_of_header({"eta": "0.05", "eta_err": "0.002"})
    {'packing_fraction': (0.05, 0.002)}
    """
    priors = {}
    if "t0" in header and "t0_err" not in header:
        raise ValueError(
            "the header gives t0 without t0_err; add its error, or subtract t0 from the times"
        )
    for key, name in PRIOR_KEYS.items():
        if key not in header:
            continue
        value_key = key.removesuffix("_err")
        if value_key not in header and value_key != "t0":
            raise ValueError(f"the header gives {key} without {value_key}; add the value itself")
        error = files.header_number(header, key)
        if error <= 0:
            raise ValueError(
                f"header line {key}: must be a positive number, got {header[key]!r}; leave it out "
                f"if {value_key} is known exactly"
            )
        priors[name] = files.header_number({"t0": "0"} | header, value_key), error
    if "diameter" in priors and "density" not in priors:
        if "density" not in header:
            raise ValueError("the header gives diameter_err without density; add the density")
        density = files.header_number(header, "density")
        priors["density"] = (density, EXACT_DENSITY_ERROR * density)
    return priors


def header_choice(header: dict[str, str], key: str, allowed: tuple[str, ...]) -> str:
    """Return one of some words, by default the first."""
    word = header.get(key, allowed[0])
    if word not in allowed:
        raise ValueError(f"header line {key}: must be {' or '.join(allowed)}, got {word!r}")
    return word


def guesses_of_header(header: dict[str, str]) -> tuple[str, ...]:
    """Return the names of the parameters whose value in a header is "guess"."""
    return tuple(BY_SYMBOL[key].name for key in GUESSES if header.get(key) == GUESS)


def absent_of_header(header: dict[str, str]) -> tuple[str, ...]:
    """Return the effects that a header declares absent.

    Args:
        header: with, for example, ``absent: walls, roughness``.

    Raises:
        ValueError: for an unknown effect, or one that the header describes by another key.

    >>> from jaxgran.data.header import absent_of_header
    >>> absent_of_header({"absent": "walls, drag"})
    ('walls', 'drag')
    """
    names = tuple(filter(None, re.split(r"[\s,;]+", header.get("absent", ""))))
    for name in names:
        if name not in ABSENT:
            raise ValueError(
                f"header line absent: {name!r} is not known; give some of {', '.join(ABSENT)}"
            )
        if given := [key for key in ABSENT[name] if key in header]:
            raise ValueError(f"the header declares {name} absent and gives {given[0]}; remove one")
    return names
