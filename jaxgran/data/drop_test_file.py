"""Drop tests in files: columns of normal and oblique impacts, or velocities and spins themselves.

The names of the columns tell which kind of table it is.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import scipy  # which imports scipy.stats at its first use
from jaxtyping import Float

from jaxgran.data.drop_test import PARTNERS, DropTest
from jaxgran.data.header_values import header_number
from jaxgran.data.tables import Table

RESTITUTION = ("eps", "eps_err")
OF_SURFACES = ("eps_t", "eps_t_err")
OF_CENTRES = ("eps_t_center", "eps_t_center_err")
BEFORE = ("vx", "vy", "vz")
AFTER = tuple(f"{name}_after" for name in BEFORE)
NORMAL = ("nx", "ny", "nz")
SPINS = ("wx", "wy", "wz")
SPINS_AFTER = tuple(f"{name}_after" for name in SPINS)
"""Columns of velocities, unit vectors from the partner to the sphere, and angular velocities."""

EPS_RANGE = (0.0, 1.2)
"""Allowed eps, and |eps_t|, of a file; beyond 1 it is also compared with its error."""

MAX_TILT = 0.01
"""Largest difference of the length of a normal from 1."""

SIGN_LEVEL = 1e-3
"""Probability by chance of an eps_t that falls with v_t/v_n, below which its sign is asked for."""

MIN_JUDGED = 7
"""Least number of impacts for which such a fall is significant: 1/7! by chance."""

AMBIGUOUS_UNITS = ("", "Hz", "1/s", "s^-1")
"""Units of angular velocities that may be radians or revolutions."""

SPIN_BEFORE = "spin_before"
"""Header key: "0" if spheres do not rotate before their impacts."""


def is_drop_test(names: list[str]) -> bool:
    """Return whether columns belong to a drop test, of any kind."""
    known = {"eps", "beta_t", *OF_SURFACES, *OF_CENTRES, *AFTER}
    return not known.isdisjoint(names)


def drop_test_columns(names: list[str]) -> list[str]:
    """Return the columns of a drop test; raise ValueError if one is unknown, missing or repeated.

    >>> from jaxgran.data.drop_test_file import drop_test_columns
    >>> drop_test_columns(["v", "eps", "eps_err"])
    ['v', 'eps', 'eps_err']
    """
    if "beta_t" in names:
        raise ValueError(
            "a column beta_t has the sign of the model: write eps_t = -beta_t, the tangential "
            "velocity of the surfaces after over that before an impact, or eps_t_center of centres"
        )
    has_velocities = not {*AFTER, *BEFORE}.isdisjoint(names)
    kind = _kind_with_velocities(names) if has_velocities else _kind_with_restitution(names)
    is_complete = sorted({*names} - {*kind.optional}) == sorted(kind.required)
    if not is_complete or len({*names}) < len(names):
        optional = f", and where known {', '.join(kind.optional)}" if kind.optional else ""
        raise ValueError(
            f"the columns are {', '.join(names)}; a drop test needs {','.join(kind.required)}"
            f"{optional}, each once. Oblique impacts have v_n,v_t or v,angle with eps_t,eps_t_err, "
            "or velocities before and after"
        )
    return names


class _Kind(NamedTuple):
    """A kind of table, by its columns."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()


def _kind_with_restitution(names: list[str]) -> _Kind:
    both = {"eps_t", "eps_t_center"} & {*names}
    if len(both) > 1:
        raise ValueError(
            "eps_t and eps_t_center are two definitions of the tangential restitution: keep one, "
            "of the surfaces at contact or of the centres"
        )
    tangential = OF_CENTRES if "eps_t_center" in names else OF_SURFACES
    if not {"v_n", "v_t"}.isdisjoint(names):
        return _Kind(("v_n", "v_t", *RESTITUTION, *tangential), ("v_n_err", "v_t_err"))
    if "angle" in names:
        return _Kind(("v", "angle", *RESTITUTION, *tangential), ("v_err", "angle_err"))
    if both:
        raise ValueError(
            f"the columns have {both.pop()} without the tangential speed: give v_n,v_t, or v,angle "
            "with the angle from the normal in degrees"
        )
    return _Kind(("v", *RESTITUTION), ("v_err",))


def _kind_with_velocities(names: list[str]) -> _Kind:
    if missing := [name for name in NORMAL if name not in names]:
        raise ValueError(
            f"the velocities have no normal ({', '.join(missing)}): add nx,ny,nz, the unit vector "
            "from the partner (a plate, or the second sphere) to the sphere at contact"
        )
    wanted = (*NORMAL, *BEFORE, *AFTER, "v_err")
    if {*SPINS, *SPINS_AFTER}.isdisjoint(names):
        return _Kind(wanted)
    return _Kind((*wanted, *SPINS, *SPINS_AFTER, "w_err"))


def drop_test_of_table(table: Table) -> tuple[DropTest, list[str]]:
    """Return the drop test of a table, and questions about it.

    Args:
        table: with the columns of `drop_test_columns`. Velocities are of a sphere relative to its
            partner, spins the sum of both angular velocities (a plate has none), and the
            normal n points from the partner to the sphere. ``u = v - (sigma/2) w x n`` is then the
            velocity of the surfaces at contact; ``eps = -u_n'/u_n``, and eps_t is the part of u_t'
            along u_t, over |u_t|. The header has ``diameter`` where there are spins. Without
            spins, and with the header line ``spin_before: 0``, the velocities of the centres give
            eps_t_center; spheres that rotate before the impact need their spins. The standard
            error of a component of velocity is v_err, of angular velocity w_err. Speeds and angles
            have the errors v_err, v_n_err, v_t_err and angle_err where they were measured, too:
            then eps_err and eps_t_err are errors of the velocity after, over the one before. The
            header line ``eps_scatters: yes`` says that eps differs from impact to impact by more
            than its errors (`DropTest.scatters`).

    Raises:
        ValueError: naming the column and the line of a value out of its range.
    """
    columns = table.columns
    onto = table.header.get("onto", PARTNERS[0])
    if onto not in PARTNERS:
        raise ValueError(f"header line onto: must be one of {', '.join(PARTNERS)}, got {onto!r}")
    scatters = table.header.get("eps_scatters", "no")
    if scatters not in ("yes", "no"):
        raise ValueError(f"header line eps_scatters: must be yes or no, got {scatters!r}")
    if "vx" in columns:
        test = _of_velocities(table, onto)
        return dataclasses.replace(test, scatters=scatters == "yes"), []
    _check_column(table, "eps", *EPS_RANGE, "It is the normal speed after over that before.")
    speeds: dict[str, Any]
    if "angle" in columns:
        speeds = _speeds_of_angles(table)
    else:
        name = "v_n" if "v_n" in columns else "v"
        speeds = {"speed": columns[name], "speed_error": columns.get(f"{name}_err")}
    if "v_t" in columns:
        speeds["tangential_speed"] = columns["v_t"]
        speeds["tangential_speed_error"] = columns.get("v_t_err")
    questions: list[str] = []
    if "tangential_speed" in speeds:
        value, error = OF_CENTRES if "eps_t_center" in columns else OF_SURFACES
        speeds["tangential_restitution"] = columns[value]
        speeds["tangential_error"] = columns[error]
        limit = max(EPS_RANGE[1], 1 + np.max(columns[error]))
        _check_column(table, value, -limit, limit, "It is the velocity after over that before.")
        obliqueness = speeds["tangential_speed"] / speeds["speed"]
        questions += _ask_about_sign(value, columns[value], obliqueness)
    test = DropTest(
        restitution=columns["eps"],
        error=columns["eps_err"],
        onto=onto,
        of_centres="eps_t_center" in columns,
        scatters=scatters == "yes",
        **speeds,
    )
    return test, questions


def _speeds_of_angles(table: Table) -> dict[str, Any]:
    """Return normal and tangential speeds of a table of speeds and angles, with their errors."""
    columns = table.columns
    advice = "It is from the normal, in degrees: a grazing impact has nearly 90."
    _check_column(table, "angle", 0.0, 90.0, advice, ends=False)
    angle = np.deg2rad(columns["angle"])
    normal = columns["v"] * np.cos(angle)
    tangential = columns["v"] * np.sin(angle)
    speeds = {"speed": normal, "tangential_speed": tangential}
    if {"v_err", "angle_err"}.isdisjoint(columns):
        return speeds
    relative = columns.get("v_err", np.zeros_like(angle)) / columns["v"]
    turn = np.deg2rad(columns.get("angle_err", np.zeros_like(angle)))
    normal_error = np.hypot(normal * relative, tangential * turn)
    tangential_error = np.hypot(tangential * relative, normal * turn)
    product = normal_error * tangential_error
    covariance = normal * tangential * (relative**2 - turn**2)
    return speeds | {
        "speed_error": normal_error,
        "tangential_speed_error": tangential_error,
        "tangential_correlation": np.clip(
            covariance / np.where(product > 0, product, 1.0), -1.0, 1.0
        ),
    }


def _check_column(
    table: Table, name: str, low: float, high: float, advice: str, *, ends: bool = True
) -> None:
    values = table.columns[name]
    inside = (values >= low) & (values <= high) if ends else (values > low) & (values < high)
    if not np.all(inside):
        i = int(np.argmin(inside))
        raise ValueError(
            f"line {table.lines[i]}: {name} is {values[i]:g}, allowed are {low:g} to {high:g}. "
            f"{advice}"
        )


def _ask_about_sign(name: str, value: np.ndarray, obliqueness: np.ndarray) -> list[str]:
    """Return a question on a tangential restitution that falls with v_t/v_n.

    Coulomb's law makes it rise to 1 in grazing impacts.
    """
    if value.size < MIN_JUDGED:
        return []
    trend = scipy.stats.kendalltau(obliqueness, value, alternative="less")
    if not trend.pvalue < SIGN_LEVEL:
        return []
    return [
        f"{name} falls as impacts become more grazing, and Coulomb's law makes it rise to 1: is it "
        f"beta_t = -{name}? Then change its sign"
    ]


def _of_velocities(table: Table, onto: str) -> DropTest:
    """Return the drop test of velocities before and after impacts: see `drop_test_of_table`."""
    columns = table.columns
    normal = _normals(table)
    before = _vectors(table, BEFORE)
    after = _vectors(table, AFTER)
    error = columns["v_err"]
    error_of_surface = error
    has_spins = "wx" in columns
    if has_spins:
        _check_spins(table)
        radius = header_number(table.header, "diameter") / 2
        before = before - radius * np.cross(_vectors(table, SPINS), normal)
        after = after - radius * np.cross(_vectors(table, SPINS_AFTER), normal)
        error_of_surface = np.hypot(error, radius * columns["w_err"])
    elif table.header.get(SPIN_BEFORE) != "0":
        raise ValueError(
            "the velocities have no spins (wx,wy,wz,wx_after,...): if the spheres do not rotate "
            f"before their impacts, say so by the header line '# {SPIN_BEFORE}: 0'"
        )
    speed = -np.sum(before * normal, axis=1)
    speed_after = np.sum(after * normal, axis=1)
    if np.any(wrong := speed <= 0):
        i = int(np.argmax(wrong))
        raise ValueError(
            f"line {table.lines[i]}: vx,vy,vz lead away from the partner: reverse nx,ny,nz, "
            "which point from the partner to the sphere, or exchange the velocities before and "
            "after"
        )
    sideways = before + speed[:, None] * normal
    tangential = np.linalg.norm(sideways, axis=1)
    denominator = np.where(tangential > 0, tangential, 1.0)
    direction = sideways / denominator[:, None]
    return DropTest(
        speed=speed,
        restitution=speed_after / speed,
        error=error / speed,
        onto=onto,
        tangential_speed=tangential,
        tangential_restitution=np.sum(after * direction, axis=1) / denominator,
        tangential_error=error_of_surface / denominator,
        of_centres=not has_spins,
        speed_error=error,
        tangential_speed_error=error_of_surface,
    )


def _vectors(table: Table, names: tuple[str, ...]) -> Float[np.ndarray, "n 3"]:
    return np.stack([table.columns[name] for name in names], axis=1)


def _normals(table: Table) -> Float[np.ndarray, "n 3"]:
    """Return the unit vectors from the partner to the sphere; raise ValueError for others."""
    normal = _vectors(table, NORMAL)
    length = np.linalg.norm(normal, axis=1)
    if np.any(wrong := np.abs(length - 1) > MAX_TILT):
        i = int(np.argmax(wrong))
        raise ValueError(
            f"line {table.lines[i]}: the normal nx,ny,nz has the length {length[i]:g}; give a unit "
            "vector"
        )
    return normal / length[:, None]


def _check_spins(table: Table) -> None:
    """Raise ValueError for spins that lack a unit, or the diameter of the spheres."""
    for name in (*SPINS, *SPINS_AFTER, "w_err"):
        if table.units[name] in AMBIGUOUS_UNITS:
            raise ValueError(
                f"column {name} is an angular velocity without a unit that says whether it is "
                f"in radians or revolutions: write {name} (rad/s), (deg/s), (turn/s) or (rpm)"
            )
    if "diameter" not in table.header:
        raise ValueError("spins need the diameter of the spheres: add it to the header")
