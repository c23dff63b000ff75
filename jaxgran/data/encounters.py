"""Encounters in tracks: spheres so near to each other, or to a wall, that they may have touched.

They are found by distances in single frames, before any line is known.
"""

from typing import NamedTuple

import numpy as np
import scipy  # which imports scipy.spatial at its first use
from jaxtyping import Bool, Float, Int

from jaxgran.data.drop_test import MAX_SIGMAS
from jaxgran.data.motion import Motion
from jaxgran.scene.gas import Gas

NUM_SIGMAS = 4.0
"""Standard errors by which a distance may be wrong in the search for encounters."""

FAST_STEP = 0.999
"""Quantile of the displacements between frames that counts as the largest one."""

MAX_GAP = 2
"""Largest number of frames from one frame of an encounter to the next."""

NUM_STEPS = 3
"""Number of frames over which a relative speed is estimated."""

WALL_TOLERANCE = 0.05
"""Largest difference of the extent of all positions, beyond their errors, from the side of the
container less a diameter, in diameters."""

WALL_NUMBER = -1
"""Stands for a wall where a particle has its number."""


class Encounters(NamedTuple):
    """Spheres that come near each other, or near a wall.

    The separation r of both partners is ``position of first - position of second - shift``, where
    the position of a wall is 0.

    Attributes:
        first: number of a particle.
        second: number of its partner, or `WALL_NUMBER`.
        shift: from a second sphere to its periodic image next to the first one, or from the origin
            to a point at the wall that the centre of a sphere reaches, m.
        normal: unit vector away from a wall; 0 for two spheres.
        time: time of the closest frame, s.
        half_width: frames on each side of this time that may be before or after the impact.
    """

    first: Int[np.ndarray, "n"]
    second: Int[np.ndarray, "n"]
    shift: Float[np.ndarray, "n d"]
    normal: Float[np.ndarray, "n d"]
    time: Float[np.ndarray, "n"]
    half_width: Float[np.ndarray, "n"]

    @property
    def is_wall(self) -> Bool[np.ndarray, "n"]:
        """Whether the partner is a wall."""
        return self.second == WALL_NUMBER


def find_encounters(motion: Motion, gas: Gas, error: float) -> Encounters:
    """Return the encounters of spheres with each other and with the walls of a container.

    Args:
        motion: motion of the spheres.
        gas: gas with their diameter and, if there are walls, a container.
        error: localisation error, the standard error of a coordinate, m.
    """
    found = [_encounters_of_spheres(motion, float(gas.diameter), error)]
    if gas.container is not None:
        found += _encounters_with_walls(motion, gas, error)
    return Encounters(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _encounters_of_spheres(motion: Motion, diameter: float, error: float) -> Encounters:
    """Return encounters of two spheres that may be impacts."""
    blur = 2**0.5 * error
    first, second = _near_rows(motion, diameter + _largest_step(motion) + NUM_SIGMAS * blur)
    apart = motion.position[first] - motion.position[second]
    shift = np.zeros_like(apart)
    if motion.side < np.inf:
        shift = motion.side * np.round(apart / motion.side)
    distance = np.linalg.norm(apart - shift, axis=1)
    pair = motion.particle[first] * (np.max(motion.particle) + 1) + motion.particle[second]
    chosen = _closest_frames(pair, motion.frame[first], distance)
    step = _relative_step(motion, first[chosen], second[chosen])
    # Between frames they come nearer than in the closest one, by up to half a step.
    may_touch = distance[chosen] <= diameter + step / 2 + NUM_SIGMAS * blur
    chosen = chosen[may_touch]
    return Encounters(
        first=motion.particle[first[chosen]],
        second=motion.particle[second[chosen]],
        shift=shift[chosen],
        normal=np.zeros_like(shift[chosen]),
        time=motion.time[first[chosen]],
        half_width=_half_width(step[may_touch], blur),
    )


def _largest_step(motion: Motion) -> float:
    """Return the largest displacement between frames, m."""
    same = motion.particle[1:] == motion.particle[:-1]
    steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=1)[same]
    if steps.size == 0:
        raise ValueError(
            "no particle occurs in two frames. Give each particle the same id in all frames"
        )
    return float(np.quantile(steps, FAST_STEP))


def _near_rows(
    motion: Motion, reach: float
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Return the rows of all pairs of particles that are nearer than `reach`, m, in a frame."""
    order = np.argsort(motion.frame, kind="stable")
    frames = np.split(order, np.flatnonzero(np.diff(motion.frame[order])) + 1)
    found = [np.zeros((0, 2), int)]
    for rows in frames:
        tree = _tree(motion.position[rows], motion.side)
        found.append(rows[tree.query_pairs(reach, output_type="ndarray")])
    first, second = np.sort(np.concatenate(found), axis=1).T
    return first, second


def _tree(position: Float[np.ndarray, "n d"], side: float) -> "scipy.spatial.KDTree":
    """Return a tree that finds neighbours, in a periodic box if its side is finite."""
    if side == np.inf:
        return scipy.spatial.KDTree(position)
    wrapped = np.mod(position, side)
    # The remainder of a small negative number is rounded to the side itself, which is outside.
    wrapped = np.where(wrapped >= side, 0.0, wrapped)
    return scipy.spatial.KDTree(wrapped, boxsize=side)


def _closest_frames(
    pair: Int[np.ndarray, "n"], frame: Int[np.ndarray, "n"], distance: Float[np.ndarray, "n"]
) -> Int[np.ndarray, "encounters"]:
    """Return the index of the closest frame of each encounter.

    Frames of one pair with gaps of up to `MAX_GAP` are one encounter.

    Args:
        pair: number of the pair of partners, one entry for each frame.
        frame: frame in which they are near each other.
        distance: distance in this frame, m.
    """
    order = np.lexsort((frame, pair))
    is_new_pair = np.diff(pair[order], prepend=-1) != 0
    is_later = np.diff(frame[order], prepend=0) > MAX_GAP
    encounter = np.empty(order.size, int)
    encounter[order] = np.cumsum(is_new_pair | is_later)
    by_distance = np.lexsort((distance, encounter))
    _, closest = np.unique(encounter[by_distance], return_index=True)
    return by_distance[closest]


def _relative_step(
    motion: Motion, first: Int[np.ndarray, "n"], second: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return how far particles move relative to each other between two frames, m.

    An impact changes the relative velocity: the faster one of before and after counts.

    Args:
        motion: motion of all particles.
        first, second: rows of both particles in one frame.
    """

    def speed(steps: int) -> Float[np.ndarray, "n"]:
        relative = _velocity(motion, first, steps) - _velocity(motion, second, steps)
        return np.linalg.norm(relative, axis=1)

    return np.maximum(speed(-NUM_STEPS), speed(NUM_STEPS)) * motion.frame_time


def _velocity(motion: Motion, row: Int[np.ndarray, "n"], steps: int) -> Float[np.ndarray, "n d"]:
    """Return the mean velocity over the next rows of a particle, or the last ones, m/s.

    Args:
        motion: motion of all particles.
        row: rows at which it begins or ends.
        steps: number of rows, < 0 for those before. At an end of a track there are fewer; without
            any the velocity is 0.
    """
    particle = motion.particle[row]
    begin = motion.first_rows(particle, np.zeros(row.size))
    end = motion.first_rows(particle, np.full(row.size, float(motion.num_frames)))
    other = np.clip(row + steps, begin, end - 1)
    elapsed = motion.time[other] - motion.time[row]
    moved = motion.position[other] - motion.position[row]
    return moved / np.where(other == row, np.inf, elapsed)[:, None]


def _half_width(step: Float[np.ndarray, "n"], error: float) -> Float[np.ndarray, "n"]:
    """Return how many frames around the closest one may lie on either side of an impact.

    Without errors of positions it is the closest frame alone.

    Args:
        step: relative displacement between frames, m.
        error: standard error of a distance, m.
    """
    return np.maximum(1.0, 3 * error / np.maximum(step, error))


def _encounters_with_walls(motion: Motion, gas: Gas, error: float) -> list[Encounters]:
    """Return encounters of spheres with each wall of the container."""
    assert gas.container is not None
    d = motion.num_coordinates
    diameter = float(gas.diameter)
    room = np.broadcast_to(np.asarray(gas.container.side), (d,)) - diameter
    low = motion.position.min(axis=0)
    high = motion.position.max(axis=0)
    _check_extent(high - low, room, WALL_TOLERANCE * diameter + 2 * MAX_SIGMAS * error)
    # The container is centred on the positions.
    lower = (low + high - room) / 2
    upper = (low + high + room) / 2
    rows = np.arange(motion.particle.size)
    velocities = [_velocity(motion, rows, steps) for steps in (-NUM_STEPS, NUM_STEPS)]
    # Between two frames a velocity may be reversed: their difference would depend on eps.
    step = np.max(np.abs(velocities), axis=0) * motion.frame_time
    found = []
    for axis in range(d):
        found.append(_encounters_with_wall(motion, step, axis, 1.0, lower[axis], error))
        found.append(_encounters_with_wall(motion, step, axis, -1.0, upper[axis], error))
    return found


def _check_extent(
    extent: Float[np.ndarray, "d"], room: Float[np.ndarray, "d"], allowed: float
) -> None:
    """Raise ValueError unless the positions extend as far as walls let the centres move, m."""
    if np.any(np.abs(extent - room) > allowed):
        raise ValueError(
            "the positions extend over "
            f"{' x '.join(f'{x:.4g}' for x in extent)} m, and walls at container_side leave "
            f"{' x '.join(f'{x:.4g}' for x in room)} m to the centres: impacts on walls need walls "
            "parallel to the coordinates, which some of the particles reach. Correct "
            "container_side, or leave it out to read the impacts of spheres alone"
        )


def _encounters_with_wall(
    motion: Motion,
    step: Float[np.ndarray, "rows d"],
    axis: int,
    sign: float,
    end: float,
    error: float,
) -> Encounters:
    """Return encounters of spheres with one wall.

    Args:
        motion: motion of the spheres.
        step: distance between two frames along each coordinate, m.
        axis: number of the coordinate normal to the wall.
        sign: 1 for the wall at the lower end of this axis, -1 at the upper end.
        end: coordinate of centres at the wall, m.
        error: localisation error, m.
    """
    height = sign * (motion.position[:, axis] - end)
    near = np.flatnonzero(height <= step[:, axis] / 2 + NUM_SIGMAS * error)
    row = near[_closest_frames(motion.particle[near], motion.frame[near], height[near])]
    shift = np.zeros((row.size, motion.num_coordinates))
    shift[:, axis] = end
    normal = np.zeros_like(shift)
    normal[:, axis] = sign
    return Encounters(
        first=motion.particle[row],
        second=np.full(row.size, WALL_NUMBER),
        shift=shift,
        normal=normal,
        time=motion.time[row],
        half_width=_half_width(step[row, axis], error),
    )
