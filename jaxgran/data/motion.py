"""Motion of particles in tracks: positions in frames, and sums over consecutive frames."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxgran.data.header_values import positive_number
from jaxgran.data.track_positions import positions_of_tracks

NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


class Sums(NamedTuple):
    """Sums over rows of one particle, whose first row is the origin of time and position.

    Attributes:
        count: number of rows, shape (n, 1).
        t: sum of the times, s, shape (n, 1).
        t_squared: sum of their squares, s^2, shape (n, 1).
        x: sum of the positions, m, shape (n, d).
        tx: sum of the products of time and position, m s, shape (n, d).
        x_squared: sum of the squared distances from the origin, m^2, shape (n, 1).
        start: time of the origin, s, shape (n, 1).
        origin: position of the origin, m, shape (n, d).
    """

    count: Float[np.ndarray, "n 1"]
    t: Float[np.ndarray, "n 1"]
    t_squared: Float[np.ndarray, "n 1"]
    x: Float[np.ndarray, "n d"]
    tx: Float[np.ndarray, "n d"]
    x_squared: Float[np.ndarray, "n 1"]
    start: Float[np.ndarray, "n 1"]
    origin: Float[np.ndarray, "n d"]


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions of particles. A row is one particle in one frame.

    Attributes:
        particle: number of the particle, from 0. Rows are sorted by particle, then by frame.
        frame: number of the frame, from 0.
        position: m, continued where a particle leaves a periodic box.
        times: time of each frame, s.
        side: side of the periodic box, m; infinite without one.
    """

    particle: Int[np.ndarray, "rows"]
    frame: Int[np.ndarray, "rows"]
    position: Float[np.ndarray, "rows d"]
    times: Float[np.ndarray, "frames"]
    side: float

    @classmethod
    def from_columns(
        cls, columns: Mapping[str, np.ndarray], header: dict[str, str], lines: list[int]
    ) -> "Motion":
        """Return the motion in a file of tracks.

        Args:
            columns: columns of `track_positions.track_columns`, in SI.
            header: header of the file, in SI.
            lines: line number of each row, for errors.
        """
        ids, time, position = positions_of_tracks(columns, header, lines)
        _, particle = np.unique(ids, return_inverse=True)
        times, frame = np.unique(time, return_inverse=True)
        order = np.lexsort((frame, particle))
        particle = particle[order]
        position = position[order]
        side = np.inf
        if "box_side" in header:
            side = positive_number(header, "box_side")
            position = _unwrapped(particle, position, side)
        return cls(particle, frame[order], position, times, side)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.times.size

    @property
    def num_coordinates(self) -> int:
        """Number of coordinates of a position."""
        return self.position.shape[1]

    @property
    def time(self) -> Float[np.ndarray, "rows"]:
        """Time of each row, s."""
        return self.times[self.frame]

    @cached_property
    def frame_time(self) -> float:
        """Typical time between two frames, s."""
        return float(np.median(np.diff(self.times)))

    @property
    def duration(self) -> float:
        """Time from the first to the last frame, s."""
        return float(np.ptp(self.times))

    def first_rows(
        self, particle: Int[np.ndarray, "n"], frame: Float[np.ndarray, "n"]
    ) -> Int[np.ndarray, "n"]:
        """Return the first row of each particle from a frame on, a whole number."""
        keys = self.particle * self.num_frames + self.frame
        frame = np.clip(frame.astype(int), 0, self.num_frames)
        return np.searchsorted(keys, particle * self.num_frames + frame)

    def sums(self, begin: Int[np.ndarray, "n"], end: Int[np.ndarray, "n"]) -> Sums:
        """Return sums over the rows from `begin` to before `end`.

        Each is summed by itself: differences of cumulative sums would lose digits.
        """
        # `reduceat` also sums from each end to the next begin. In the order of `begin` these sums,
        # which are dropped, extend over few rows.
        order = np.argsort(begin, kind="stable")
        bounds = np.stack([begin, np.maximum(begin, end)], axis=1)[order]
        sums = np.empty((len(begin), self._terms.shape[1]))
        sums[order] = np.add.reduceat(self._terms, bounds.ravel(), axis=0)[::2]
        sums = np.where((end > begin)[:, None], sums, 0.0)
        d = self.num_coordinates
        origin = self._origin[np.minimum(begin, len(self._origin) - 1)]
        count, t, t_squared, x, tx, x_squared = np.split(sums, [1, 2, 3, 3 + d, 3 + 2 * d], axis=1)
        return Sums(count, t, t_squared, x, tx, x_squared, origin[:, :1], origin[:, 1:])

    @cached_property
    def _origin(self) -> Float[np.ndarray, "rows e"]:
        """Time, s, and position, m, in the first row of the same particle."""
        is_first = np.append(True, self.particle[1:] != self.particle[:-1])
        first = np.flatnonzero(is_first)[np.cumsum(is_first) - 1]
        return np.column_stack([self.time, self.position])[first]

    @cached_property
    def _terms(self) -> Float[np.ndarray, "more terms"]:
        """1, t, t^2, x, t x and |x|^2 of each row; a row of zeros follows, where sums may end."""
        t = self.time - self._origin[:, 0]
        x = self.position - self._origin[:, 1:]
        square = np.sum(x**2, axis=1)
        terms = np.column_stack([np.ones_like(t), t, t**2, x, t[:, None] * x, square])
        return np.concatenate([terms, np.zeros((1, terms.shape[1]))])


def _unwrapped(
    particle: Int[np.ndarray, "rows"], position: Float[np.ndarray, "rows d"], side: float
) -> Float[np.ndarray, "rows d"]:
    """Return positions that continue where particles leave a periodic box."""
    is_same = particle[1:] == particle[:-1]
    crossed = np.round(np.diff(position, axis=0) / side) * is_same[:, None]
    images = np.concatenate([np.zeros((1, position.shape[1])), np.cumsum(crossed, axis=0)])
    return position - side * images


def error_by_second_differences(motion: Motion) -> float:
    """Return a first estimate of the localisation error, m.

    The distance of a position from the straight line between its neighbours in time is an error of
    positions alone. The median ignores the few rows next to impacts.
    """
    x = motion.position
    t = motion.time
    is_same = motion.particle[2:] == motion.particle[:-2]
    is_next = motion.frame[2:] - motion.frame[:-2] == 2
    rows = np.flatnonzero(is_same & is_next)
    if not rows.size:
        return float(1e-9 * np.ptp(x))
    share = ((t[rows + 1] - t[rows]) / (t[rows + 2] - t[rows]))[:, None]
    beside = x[rows + 1] - (1 - share) * x[rows] - share * x[rows + 2]
    scatter = np.sqrt(1 + (1 - share) ** 2 + share**2)  # over the error of one position
    error = NORMAL_MAD * np.median(np.abs(beside) / scatter)
    return float(max(error, 1e-9 * np.ptp(x)))
