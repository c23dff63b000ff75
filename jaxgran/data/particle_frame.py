"""Particles of one frame of a file, in SI, whatever the format of the file."""

from typing import NamedTuple

import numpy as np

FLOAT32_TOLERANCE = 1e-6
"""Largest relative difference of equal sizes and masses, which GSD files store as float32."""

UNITS = {
    "si": (1.0, 1.0, 1.0),
    "cgs": (1e-2, 1.0, 1e-3),
    "micro": (1e-6, 1e-6, 1e-15),
    "nano": (1e-9, 1e-9, 1e-21),
    "metal": (1e-10, 1e-12, 1.66053906660e-27),
    "real": (1e-10, 1e-15, 1.66053906660e-27),
}
"""Units of length (m), time (s) and mass (kg), by their names in LAMMPS."""

DENSITY_UNITS = {"metal": 1e3, "real": 1e3}
"""Units of density (kg/m^3), where they are not a mass over a length cubed."""

POSITIONS = (("xu", "yu", "zu"), ("x", "y", "z"), ("xs", "ys", "zs"), ("xsu", "ysu", "zsu"))
"""Accepted names of columns of positions, in order of preference; s stands for scaled ones."""

VELOCITY = ("vx", "vy", "vz")
SPIN = ("omegax", "omegay", "omegaz")
"""Names of columns of velocities and angular velocities."""

EQUAL = {
    **dict.fromkeys(("type", "element", "species", "Z", "q", "shapex", "shapey", "shapez")),
    **dict.fromkeys(("diameter", "radius"), "length"),
    **dict.fromkeys(("mass", "masses"), "mass"),
    "density": "density",
}
"""Columns that must be equal for all particles, as gases of jaxgran consist of equal spheres, and
the kind of unit of their numbers."""


class Frame(NamedTuple):
    """Particles of one frame of a file, in SI, in the d dimensions of their gas.

    Attributes:
        position: m, shape (N, d), relative to the low corner of the box.
        velocity: m/s, shape (N, d).
        sides: of the box, m, shape (d,).
        spin: angular velocity, 1/s, or None.
        equal: columns that are equal for all particles, by name.
        periodic: whether the box is periodic.
        time: s, or None if the file gives no time.
        step: number of the time step, or None.
    """

    position: np.ndarray
    velocity: np.ndarray
    sides: np.ndarray
    spin: np.ndarray | None
    equal: dict[str, np.ndarray]
    periodic: bool
    time: float | None
    step: int | None


def frame_of_columns(
    columns: dict[str, np.ndarray],
    low: np.ndarray,
    sides: np.ndarray,
    dimension: int | None,
    *,
    units: str = "si",
    periodic: tuple[bool, ...] = (True, True, True),
    time: float | None = None,
    step: int | None = None,
) -> Frame:
    """Return a frame in SI, sorted by id.

    Args:
        columns: of text or numbers, by name, each of shape (N,).
        low: low corner of the box, shape (3,).
        sides: of the box, shape (3,).
        dimension: 2 or 3; None for 3, unless the particles move in one plane.
        units: a name of `UNITS`.
        periodic: whether the box is periodic along each axis.
        time: of the frame, or None.
        step: number of the time step, or None.

    Raises:
        ValueError: for values, boxes and particles that `read_particles` does not support.
    """
    if units.lower() not in UNITS:
        raise ValueError(
            f"its units are {units!r}, without a size in m: convert it to SI. Known units are "
            f"{', '.join(UNITS)}"
        )
    length, second, kilogram = UNITS[units.lower()]
    columns = _sorted_by_id(columns)
    d = dimension or 3
    position = _first_vector(columns, POSITIONS)
    velocity = _first_vector(columns, (VELOCITY,))
    spin = _first_vector(columns, (SPIN,) if SPIN[0] in columns else (SPIN[-1:],))
    if position is None:
        raise ValueError(f"it has no columns {' or '.join(map(' '.join, POSITIONS))}")
    if velocity is None:
        raise ValueError(
            "it has no velocities in this frame: write the columns vx vy vz (LAMMPS), velo (XYZ; "
            "not momenta), or particles/velocity into every frame (GSD; HOOMD needs "
            "dynamic=['property', 'momentum'] for it)"
        )
    if _first_vector(columns, POSITIONS[:2]) is None:  # scaled
        position = low + position * sides
    sides = length * sides[:d]
    low = length * low[:d]
    position = length * position[:, :d] - low
    velocity = length / second * velocity
    density = DENSITY_UNITS.get(units.lower(), kilogram / length**3)
    equal = _equal_columns(columns, {"length": length, "mass": kilogram, "density": density})
    is_periodic = all(periodic[:d])
    if any(periodic[:d]) and not is_periodic:
        raise ValueError(
            "its box is periodic in some directions only; boxes of jaxgran are periodic, or have "
            "walls, on all sides"
        )
    _check_places(position, velocity, sides, is_periodic)
    if dimension is None and _is_in_plane(position, velocity):
        raise ValueError("all its particles move in one plane: give dimension=2 for disks, or 3")
    if is_periodic:
        position = np.mod(position, sides)
        position = np.where(position < sides, position, 0.0)  # rounding may give a side
    if spin is not None:
        spin = (spin if d == 3 else spin[:, -1:]) / second
    time = None if time is None else second * time
    return Frame(position, velocity[:, :d], sides, spin, equal, is_periodic, time, step)


def _check_places(
    position: np.ndarray, velocity: np.ndarray, sides: np.ndarray, is_periodic: bool
) -> None:
    """Raise ValueError for numbers that are not finite, and for particles outside of their box."""
    if not all(np.all(np.isfinite(x)) for x in (position, velocity, sides)):
        raise ValueError("some of its positions, velocities or sides are not finite numbers")
    if np.any(sides <= 0):
        raise ValueError(f"its box has the sides {sides}, which must be positive")
    if np.any((position < 0) | (position > sides)) and not is_periodic:
        raise ValueError("some particles are outside of its box, which is not periodic")


def _sorted_by_id(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    if "id" not in columns:
        return columns
    ids = columns["id"].astype(int)
    if len(set(ids)) < len(ids):
        raise ValueError("it has an id twice; remove one of its particles")
    order = np.argsort(ids)
    return {name: column[order] for name, column in columns.items()}


def _first_vector(
    columns: dict[str, np.ndarray], choices: tuple[tuple[str, ...], ...]
) -> np.ndarray | None:
    """Return the columns of the first choice that is complete, shape (N, columns), or None."""
    for names in choices:
        known = [columns[name].astype(float) for name in names if name in columns]
        if len(known) == len(names):
            return np.stack(known, axis=1)
    return None


def _equal_columns(
    columns: dict[str, np.ndarray], units: dict[str, float]
) -> dict[str, np.ndarray]:
    """Return the columns of `EQUAL` in SI; raise ValueError if the particles differ in one.

    Args:
        columns: by name.
        units: of length, mass and density, SI.
    """
    equal = {}
    different = []
    for name in (x for x in EQUAL if x in columns):
        unit = EQUAL[name]
        values = columns[name]
        if unit is None:
            is_equal = len(set(values)) <= 1
        else:
            values = units[unit] * values.astype(float)
            is_equal = np.ptp(values) <= FLOAT32_TOLERANCE * np.max(np.abs(values))
        equal[name] = values
        if not is_equal:
            different.append(name)
    if different:
        raise ValueError(
            f"its particles differ in {', '.join(different)}, but gases of jaxgran consist of "
            "equal spheres; give a file of one kind of particles"
        )
    return equal


def _is_in_plane(position: np.ndarray, velocity: np.ndarray) -> bool:
    """Return whether particles in three dimensions move, and all of them in one plane."""
    moving = np.any(velocity, axis=0)
    d = position.shape[1]
    return bool(d == 3 and any(moving) and not moving[2] and np.ptp(position[:, 2]) == 0)
