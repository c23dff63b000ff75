"""Elements of a gas that the header of a file describes: roughness, walls, drag and a drive."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from jaxgran.data.header_keys import GUESS, GUESSES, UNSUPPORTED_KEYS
from jaxgran.data.header_values import header_number
from jaxgran.scene.elements import Frictional, Rough, Walls
from jaxgran.scene.gas import ELEMENTS
from jaxgran.scene.parameters import fields_of


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
    _check_supported(header)
    elements = {}
    for name, kinds in ELEMENTS.items():
        kind = _kind_of_surface(header) if name == "surface" else kinds[0]
        if arguments := _arguments(kind, header):
            elements[name] = kind(**arguments)
    return elements


def _kind_of_surface(header: dict[str, str]) -> type[Rough] | type[Frictional]:
    """Return the surface that a header describes, or could describe."""
    lasting = "tangential_damping" in header
    rough = "beta_t" in header
    if lasting and rough:
        raise ValueError(
            "the header gives both beta_t (instantaneous impacts) and tangential_damping (lasting "
            "contacts). Leave out beta_t for SoftSpheres(N), or tangential_damping for the other "
            "models"
        )
    if "friction" in header and not (lasting or rough):
        raise ValueError(
            "the header gives friction without tangential_damping; add tangential_damping (lasting "
            "contacts) or beta_t (instantaneous impacts; '# beta_t: guess' to fit it)"
        )
    return Frictional if lasting else Rough


def _check_supported(header: dict[str, str]) -> None:
    """Raise ValueError for a key of an effect that no model has."""
    for key, effect in UNSUPPORTED_KEYS.items():
        neutral = effect.neutral
        if key in header and (neutral is None or header_number(header, key) != neutral):
            advice = "" if neutral is None else f" or set it to {neutral:g}"
            raise ValueError(
                f"the header gives {key}: {effect.reason}. No model of jaxgran supports it; "
                f"fit a curve of equal spheres without it, and leave {key} out{advice}"
            )


def _arguments(kind: type, header: dict[str, str]) -> dict[str, Any]:
    """Return the arguments of an element that a header gives, {} if it gives none."""
    key_of_field = {field: p.symbol for field, p in fields_of(kind.__name__).items() if p.symbol}
    if kind is Walls:
        key_of_field["restitution"] = "wall_restitution"
    field_of_key = {key: field for field, key in key_of_field.items()}
    given = [key for key in header if key in field_of_key]
    if not given:
        return {}
    required = [
        key_of_field[field.name]
        for field in dataclasses.fields(kind)
        if field.default is dataclasses.MISSING
    ]
    if missing := [key for key in required if key not in header]:
        fitted = f", or the line '# {missing[0]}: guess' to fit it (--free {missing[0]})"
        raise ValueError(
            f"the header gives {given[0]} without {missing[0]}; add {missing[0]}"
            + (fitted if missing[0] in GUESSES else "")
        )
    values = header | {key: GUESSES[key] for key in GUESSES if header.get(key) == GUESS}
    arguments: dict[str, Any] = {}
    for key in given:
        field = field_of_key[key]
        if key == "container_side":
            arguments[field] = header_sides(values)
        else:
            arguments[field] = header_number(values, key)
    return arguments


def header_sides(header: Mapping[str, Any]) -> float | list[float]:
    """Return the side of a cubic or square container, or its d sides, m."""
    sides = [
        header_number({"container_side": part.strip()}, "container_side")
        for part in str(header["container_side"]).split("x")
    ]
    return sides if len(sides) > 1 else sides[0]
