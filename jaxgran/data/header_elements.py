"""Elements of a gas that the header of a file describes: roughness, walls, drag and a drive."""

import dataclasses
from typing import Any

from jaxgran.data.header_keys import GUESS, GUESSES, UNSUPPORTED_KEYS
from jaxgran.data.header_values import header_number, header_sides
from jaxgran.scene.elements import Frictional, Rough
from jaxgran.scene.gas import ELEMENTS
from jaxgran.scene.parameters import fields_of
from jaxgran.scene.walls import Walls


def elements_of_header(header: dict[str, str]) -> dict[str, Any]:
    """Return the elements that a header describes, as keyword arguments of `jaxgran.Gas`.

    The keys of an element, in SI:

    - rough spheres: beta_t; reduced_inertia, 4 I/(m sigma^2), if it is not 0.4; T_rot_0,
      T_rot = I <w^2>/(d_rot m) at t = 0, if it is not 0; friction, Coulomb's coefficient, if they
      slide;
    - spheres of lasting contacts with friction (`jaxgran.Frictional`): tangential_damping and
      friction in place of beta_t;
    - walls: container_side, of a cube, or "8 x 6 x 4 cm"; wall_restitution; wall_beta_t if they are
      rough;
    - drag: gamma of dv/dt = -gamma v;
    - a drive by white noise: drive_strength of dT/dt = drive_strength.

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


def _arguments(kind: type, header: dict[str, str]) -> dict[str, Any]:
    """Return the arguments of an element that a header gives, {} if it gives none."""
    keys = _keys_of_fields(kind)
    given = {field: key for field, key in keys.items() if key in header}
    if not given:
        return {}
    for field in dataclasses.fields(kind):
        if field.default is dataclasses.MISSING and field.name not in given:
            key = keys[field.name]
            guess = f", or the line '# {key}: guess' to fit it (--free {key})"
            raise ValueError(
                f"the header gives {next(iter(given.values()))} without {key}; add {key}"
                + (guess if key in GUESSES else "")
            )
    return {field: _value(header, key) for field, key in given.items()}


def _keys_of_fields(kind: type) -> dict[str, str]:
    """Return the header keys of an element, by the name of the field."""
    keys = {field: p.symbol for field, p in fields_of(kind.__name__).items() if p.symbol}
    if kind is Walls:
        keys["restitution"] = "wall_restitution"  # a law, of which a header gives the coefficient
    return keys


def _value(header: dict[str, str], key: str) -> Any:
    """Return the value of a key; of a guess, the value from which a fit starts."""
    if key == "container_side":
        return header_sides(header)
    if key in GUESSES and header[key] == GUESS:
        return GUESSES[key]
    return header_number(header, key)
