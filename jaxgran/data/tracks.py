"""Tracks of particles, as a camera gives them, to a cooling curve."""

import warnings
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxgran.data.curve import MIN_POINTS, CoolingCurve
from jaxgran.data.header import header_count, header_number
from jaxgran.data.quantities import in_si
from jaxgran.data.scene_keys import read_elements
from jaxgran.data.table import Table
from jaxgran.scene.gas import Gas
from jaxgran.scene.restitution import ConstantRestitution

COORDINATES = ("x", "y", "z")

FEWEST = 3
"""Particles that leave a scatter where the drift is removed and one of them is left out."""

LARGEST_SHARE = 0.3
"""Share of T that may be missing by impacts, or added by localisation, without a warning."""

STEPS = 50
"""Of the iteration for T from the displacements, which gains a factor of 2 or more in each."""


class Tracks(NamedTuple):
    """Positions of the same particles in every frame.

    Attributes:
        times: of the frames, s, increasing.
        positions: m, shape (frames, particles, coordinates).
    """

    times: Float[np.ndarray, "frames"]
    positions: Float[np.ndarray, "frames particles coordinates"]


def check_track_names(path: Path, i: int, names: list[str]) -> None:
    """ValueError unless the columns in line i are id, t, x, y and, in three dimensions, z."""
    wanted = [["id", "t", *COORDINATES[:d]] for d in (2, 3)]
    if sorted(names) not in [sorted(each) for each in wanted]:
        raise ValueError(
            f"{path}, line {i}: the columns are {', '.join(names)}; tracks of particles have "
            f"{' or '.join(','.join(each) for each in wanted)}, each once"
        )


def curve_of_tracks(path: Path, table: Table) -> tuple[CoolingCurve, dict[str, str]]:
    """T(t) of particles whose positions are known in frames.

    Velocities are differences over neighbouring frames, ``u = (x(t_2) - x(t_1))/(t_2 - t_1)``, and
    belong to the middle of the two times, to second order in the share by which T falls meanwhile.
    The drift, the mean velocity of all tracked particles between the two frames, is removed:
    ``T = sum (u - <u>)^2 / (d (n - 1))`` of n particles and d coordinates, which is times
    ``(N - 1)/N`` in a gas of N particles (header key N) without walls, whose momentum is 0 in
    truth. Two coordinates of a three-dimensional gas stand for all three.

    Two biases of u^2 are removed where the header says enough. The standard error of one coordinate
    of a position, ``localisation_error``, adds ``2 error^2/(t_2 - t_1)^2`` to T; the error itself
    is not corrected in the jackknife, which it widens. Impacts between frames bend the paths: with
    the velocity autocorrelation ``exp(-nu_v t)`` T is too small by
    ``2 (exp(-x) - 1 + x)/x^2 = 1 - x/3 + ...``, ``x = nu_v (t_2 - t_1)``; nu_v is Enskog's of
    elastic spheres, ``(2/d)`` of their collision frequency, from eta, diameter and T.

    T_err is the jackknife error over particles, which leaves out one at a time. It is that of T of
    the gas from which these particles are a sample; those of neighbouring times are correlated, as
    the particles are the same.

    Args:
        path: of the file, for messages.
        table: its columns id, t, x, y and z; rows in any order in which the times of each particle
            increase. Positions are unwrapped: a particle that leaves a periodic box goes on.

    Returns:
        The curve, and the header, whose entry T_from says how T was computed.

    Raises:
        ValueError: for fewer than 3 particles or 4 frames, for times that do not increase, a
            particle twice in a frame, or one that is missing in a frame: naming the line.
    """
    try:
        columns, header = in_si(table.columns, table.header)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    tracks = _tracks(path, columns, table.lines)
    duration = np.diff(tracks.times)
    velocity = np.diff(tracks.positions, axis=0) / duration[:, None, None]
    share, notes = _share_of_all(path, tracks, header)
    T, error = _temperature_and_error(velocity)
    T, error = share * T, share * error
    T, words = _without_localisation(path, T, duration, header)
    notes += words
    T_true, words = _without_impacts(path, T, duration, header)
    notes += words
    curve = CoolingCurve(
        times=jnp.asarray((tracks.times[1:] + tracks.times[:-1]) / 2),
        temperature=jnp.asarray(T_true),
        temperature_error=jnp.asarray(error * T_true / T),
    )
    header["T_from"] = f"T = <(u - <u>)^2>/d, u over neighbouring frames; {'; '.join(notes)}"
    curve.check(f"{path}: T between frames {{0}} and the next".format)
    return curve, header


def _tracks(path: Path, columns: dict[str, np.ndarray], lines: list[int]) -> Tracks:
    """The positions by frame and particle."""
    t, names = columns["t"], [name for name in COORDINATES if name in columns]
    whole = columns["id"] == np.round(columns["id"])
    if not np.all(whole):
        i = int(np.argmin(whole))
        raise ValueError(
            f"{path}, line {lines[i]}: id is {columns['id'][i]:g}; number the particles"
        )
    ids, particle = np.unique(columns["id"].astype(int), return_inverse=True)
    times, frame = np.unique(t, return_inverse=True)
    if len(ids) < FEWEST:
        raise ValueError(
            f"{path}, line {lines[-1] if lines else 1}: the tracks end, of {len(ids)} particle(s); "
            f"at least {FEWEST} are needed to remove their drift and estimate errors"
        )
    if len(times) <= MIN_POINTS:
        raise ValueError(
            f"{path}, line {lines[-1]}: the tracks end, of {len(times)} frames; at least "
            f"{MIN_POINTS + 1} are needed: record for longer"
        )
    row = _rows(path, particle, frame, (ids, times), lines)
    _check_order(path, particle, t, ids, lines)
    positions = np.stack([columns[name] for name in names], axis=1)
    return Tracks(times, positions[row])


def _rows(
    path: Path,
    particle: np.ndarray,
    frame: np.ndarray,
    values: tuple[np.ndarray, np.ndarray],
    lines: list[int],
) -> np.ndarray:
    """The row of each particle in each frame, shape (frames, particles); each stands once."""
    ids, times = values
    row = np.full((len(times), len(ids)), len(lines))
    np.minimum.at(row, (frame, particle), np.arange(len(lines)))  # the first of several
    again = row[frame, particle] != np.arange(len(lines))
    if np.any(again):
        i = int(np.argmax(again))
        raise ValueError(
            f"{path}, line {lines[i]}: particle {ids[particle[i]]} at t = {times[frame[i]]:g} s is "
            f"given again, after line {lines[row[frame[i], particle[i]]]}; remove one"
        )
    missing = row == len(lines)
    if np.any(missing):
        k, j = (int(index[0]) for index in np.nonzero(missing))
        near = row[k - 1, j] if k else row[:, j].min()
        raise ValueError(
            f"{path}, line {lines[near]}: particle {ids[j]} stands here, and is missing in the "
            f"frame at t = {times[k]:g} s; remove its track, or keep the frames that all particles "
            "share"
        )
    return row


def _check_order(
    path: Path, particle: np.ndarray, t: np.ndarray, ids: np.ndarray, lines: list[int]
) -> None:
    """ValueError unless the times of each particle increase down the file."""
    order = np.argsort(particle, kind="stable")
    back = (np.diff(t[order]) < 0) & (np.diff(particle[order]) == 0)
    if np.any(back):
        i = int(order[1:][back].min())
        raise ValueError(
            f"{path}, line {lines[i]}: t is {t[i]:g} s, earlier than that of particle "
            f"{ids[particle[i]]} before; sort the rows of each particle by time"
        )


def _temperature_and_error(
    velocity: Float[np.ndarray, "times n d"],
) -> tuple[Float[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """The variance of a velocity component, drift removed, and its jackknife error."""
    _, n, d = velocity.shape
    centred = velocity - velocity.mean(axis=1, keepdims=True)
    square = np.sum(centred**2, axis=2)
    # Without particle i the others have the mean -u_i/(n - 1), in the frame of all.
    left = square.sum(axis=1, keepdims=True) - square * n / (n - 1)
    each = left / (d * (n - 2))
    error = np.sqrt((n - 1) * np.var(each, axis=1))
    return square.sum(axis=1) / (d * (n - 1)), error


def _share_of_all(path: Path, tracks: Tracks, header: dict[str, str]) -> tuple[float, list[str]]:
    """(N - 1)/N where N is known and momentum is conserved, and words for what was taken."""
    n, d = tracks.positions.shape[1:]
    dimension = header_count(header, "dimension") or 3
    if d > dimension:
        raise ValueError(
            f"{path}: a gas of dimension {dimension} has no tracks with {d} coordinates; correct "
            "the header or leave out z"
        )
    projected = ["two of three coordinates, of isotropic velocities"] if d < dimension else []
    N = header_count(header, "N")
    if N is None:
        return 1.0, [f"drift of {n} particles removed", *projected]
    if n > N:
        raise ValueError(f"{path}: the header gives N = {N}, but {n} particles are tracked")
    free = "container_side" not in header
    return (N - 1) / N if free else 1.0, [f"drift of {n} of {N} particles removed", *projected]


def _without_localisation(
    path: Path, T: Float[np.ndarray, "times"], duration: np.ndarray, header: dict[str, str]
) -> tuple[Float[np.ndarray, "times"], list[str]]:
    """T without the scatter of measured positions, and words for it."""
    if "localisation_error" not in header:
        return T, ["errors of positions not known (localisation_error)"]
    error = header_number(header, "localisation_error")
    if error < 0:
        raise ValueError(f"{path}: header line localisation_error: must be >= 0, got {error:g}")
    added = 2 * (error / duration) ** 2
    if np.any(added >= T):
        k = int(np.argmax(added >= T))
        raise ValueError(
            f"{path}: between frames {k} and {k + 1} particles move no further than "
            f"localisation_error = {error:g} m; leave out the frames from there on, or take frames "
            "further apart"
        )
    share = float(np.max(added / T))
    _warn(path, share, "leave out the last frames", "localisation_error adds", "to")
    return T - added, [f"localisation_error removed, at most {100 * share:.2g} % of T"]


def _without_impacts(
    path: Path, T: Float[np.ndarray, "times"], duration: np.ndarray, header: dict[str, str]
) -> tuple[Float[np.ndarray, "times"], list[str]]:
    """T with what impacts between frames took from it, and words for it."""
    if not {"eta", "diameter"} <= header.keys():
        return T, ["impacts between frames not corrected (eta and diameter are not given)"]
    gas = Gas(
        ConstantRestitution(1.0),
        diameter=header_number(header, "diameter"),
        mass=1.0,
        packing_fraction=header_number(header, "eta"),
        temperature=1.0,
        dimension=header_count(header, "dimension") or 3,
        **read_elements(header),
    )
    rate = 2 / gas.dimension * float(gas.collision_frequency) * duration
    true = T
    for _ in range(STEPS):
        true = T / _kept(rate * np.sqrt(true))
    share = float(np.max(1 - T / true))
    _warn(path, share, "take frames closer together", "impacts between frames take", "from")
    return true, [f"impacts between frames corrected, at most {100 * share:.2g} % of T"]


def _kept(x: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    """``2 (exp(-x) - 1 + x)/x^2``, the share of T in displacements over x relaxation times."""
    small = x < 1e-3
    safe = np.where(small, 1.0, x)
    return np.where(small, 1 - x / 3, 2 * (np.expm1(-safe) + safe) / safe**2)


def _warn(path: Path, share: float, advice: str, what: str, where: str) -> None:
    if share > LARGEST_SHARE:
        warnings.warn(
            f"{path}: {what} up to {100 * share:.2g} % {where} T, which a correction makes up for "
            f"roughly only: {advice}",
            stacklevel=6,
        )
