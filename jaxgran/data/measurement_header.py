"""What a header says of a measurement beside its gas: priors, absent effects, numbers of grains."""

import re
from typing import Any

from jaxgran.data.header_keys import ABSENT, GUESS, GUESSES, PRIOR_KEYS
from jaxgran.data.header_values import header_count, header_number
from jaxgran.scene.parameters import BY_SYMBOL

EXACT_DENSITY_ERROR = 1e-4
"""Relative error of the prior of a density without an error, where the diameter has one."""


def arguments_of_header(header: dict[str, str]) -> dict[str, Any]:
    """Return the arguments of `Measurement` that a header gives, but for the gas.

    Raises:
        ValueError: for a value that is not allowed.
    """
    return {
        "num_particles": header_count(header, "N"),
        "replicas": header_count(header, "replicas") or 1,
        "priors": priors_of_header(header),
        "absent": absent_of_header(header),
        "tracked": header_count(header, "tracked"),
        "ensemble_start": _choice(header, "T0_of", ("run", "ensemble")) == "ensemble",
        "calibration_error": header_number({"T_scale_err": "0"} | header, "T_scale_err"),
        "errors_measured": _choice(header, "errors", ("any", "measured")) == "measured",
        "of_energy": _choice(header, "T_of", ("velocity", "energy")) == "energy",
        "guesses": guesses_of_header(header),
        "header": tuple(header.items()),
    }


def priors_of_header(header: dict[str, str]) -> dict[str, tuple[float, float]]:
    """Return the standard errors of a header in the form of ``priors`` of `jaxgran.Measurement`.

    Where the diameter has an error and the density has none, the mass follows the diameter.

    Args:
        header: with some of eta_err, diameter_err, density_err, Y_err, nu_err, T0_err, t0_err,
            beta_t_err and so on, the standard errors of the other keys, in their units. The value
            of t0, the time at which the gas began to cool, is 0 unless the header gives it.

    Raises:
        ValueError: for an error without its value, or one that is not a positive number.

    >>> from jaxgran.data.measurement_header import priors_of_header
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
        error = header_number(header, key)
        if error <= 0:
            raise ValueError(
                f"header line {key}: must be a positive number, got {header[key]!r}; leave it out "
                f"if {value_key} is known exactly"
            )
        priors[name] = header_number({"t0": "0"} | header, value_key), error
    if "diameter" in priors and "density" not in priors:
        if "density" not in header:
            raise ValueError("the header gives diameter_err without density; add the density")
        density = header_number(header, "density")
        priors["density"] = (density, EXACT_DENSITY_ERROR * density)
    return priors


def absent_of_header(header: dict[str, str]) -> tuple[str, ...]:
    """Return the effects that a header declares absent.

    Args:
        header: with, for example, ``absent: walls, roughness``.

    Raises:
        ValueError: for an unknown effect, or one that the header describes by another key.

    >>> from jaxgran.data.measurement_header import absent_of_header
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


def guesses_of_header(header: dict[str, str]) -> tuple[str, ...]:
    """Return the names of the parameters whose value in a header is "guess"."""
    return tuple(BY_SYMBOL[key].name for key in GUESSES if header.get(key) == GUESS)


def _choice(header: dict[str, str], key: str, allowed: tuple[str, ...]) -> str:
    """Return one of some words, by default the first."""
    word = header.get(key, allowed[0])
    if word not in allowed:
        raise ValueError(f"header line {key}: must be {' or '.join(allowed)}, got {word!r}")
    return word
