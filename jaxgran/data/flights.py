"""Free flights between impacts, and the straight lines through their positions."""

from typing import NamedTuple

import numpy as np
import scipy  # which imports scipy.stats at its first use
from jaxtyping import Bool, Float, Int

from jaxgran.data.motion import Motion

MIN_FRAMES = 3
"""Fewest frames of a free flight: two for the line, and one more for the scatter about it."""

UNKNOWN_VARIANCE = 1e6
"""Variance of a position on a line through less than two frames, over the squared localisation
error."""

TINY = 1e-300
"""Keeps denominators from 0."""

NOBODY = -2
"""Number that no particle has, and no wall."""


class Lines(NamedTuple):
    """Straight lines of least squares through the positions of free flights.

    Variances are of one coordinate, and over the squared localisation error.

    Attributes:
        count: number of frames; infinite for a wall, whose place has no error.
        time: mean time of these frames, s.
        position: mean position, m.
        velocity: m/s; 0 with less than two frames.
        square: sum of squares of the times about their mean, s^2.
        scatter: sum of squares of the positions about the line, m^2.
    """

    count: Float[np.ndarray, "n"]
    time: Float[np.ndarray, "n"]
    position: Float[np.ndarray, "n d"]
    velocity: Float[np.ndarray, "n d"]
    square: Float[np.ndarray, "n"]
    scatter: Float[np.ndarray, "n"]

    def at(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n d"]:
        """Return the positions at some times, m."""
        return self.position + self.velocity * (time - self.time)[:, None]

    def variance_at(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the variances of the positions at some times."""
        is_known = self.count >= 2
        lever = (time - self.time) ** 2 / np.where(is_known, self.square, 1.0)
        return np.where(is_known, self.variance_of_mean + lever, UNKNOWN_VARIANCE)

    @property
    def variance_of_mean(self) -> Float[np.ndarray, "n"]:
        """Variance of the mean position."""
        return 1 / np.maximum(self.count, 1)

    @property
    def variance_of_velocity(self) -> Float[np.ndarray, "n"]:
        """Variance of the velocity, 1/s^2; 0 with less than two frames."""
        return 1 / np.where(self.count >= 2, self.square, np.inf)

    @property
    def degrees_of_freedom(self) -> Float[np.ndarray, "n"]:
        """Number of coordinates less the two parameters of a line in each direction."""
        return (self.count - 2) * self.position.shape[1]

    def are_straight(self, error: float, level: float) -> Bool[np.ndarray, "n"]:
        """Return whether the scatter about the lines can be localisation errors: a chi^2 test.

        Args:
            error: localisation error, m.
            level: probability by chance below which it cannot.
        """
        degrees = np.maximum(self.degrees_of_freedom, self.position.shape[1])
        return scipy.stats.chi2.sf(self.scatter / error**2, degrees) > level

    def with_walls(self, is_wall: Bool[np.ndarray, "n"]) -> "Lines":
        """Return the lines with some replaced by walls: at rest at the origin, without errors."""
        return Lines(
            count=np.where(is_wall, np.inf, self.count),
            time=np.where(is_wall, 0.0, self.time),
            position=np.where(is_wall[:, None], 0.0, self.position),
            velocity=np.where(is_wall[:, None], 0.0, self.velocity),
            square=np.where(is_wall, np.inf, self.square),
            scatter=np.where(is_wall, 0.0, self.scatter),
        )


def fit_lines(motion: Motion, begin: Int[np.ndarray, "n"], end: Int[np.ndarray, "n"]) -> Lines:
    """Return the lines through the rows of a particle from `begin` to before `end`."""
    sums = motion.sums(begin, end)
    mean_time = sums.t / np.maximum(sums.count, 1)
    mean = sums.x / np.maximum(sums.count, 1)
    square = sums.t_squared - sums.t * mean_time
    is_known = sums.count >= 2
    velocity = (sums.tx - mean_time * sums.x) / np.where(is_known, square, np.inf)
    about_mean = sums.x_squared - sums.count * np.sum(mean**2, axis=1, keepdims=True)
    explained = np.where(is_known, square, 0.0) * np.sum(velocity**2, axis=1, keepdims=True)
    return Lines(
        count=sums.count[:, 0],
        time=(mean_time + sums.start)[:, 0],
        position=mean + sums.origin,
        velocity=velocity,
        square=square[:, 0],
        scatter=np.maximum(about_mean - explained, 0.0)[:, 0],
    )


class LinePairs(NamedTuple):
    """Lines of the first and of the second partner of each encounter."""

    first: Lines
    second: Lines

    @property
    def velocity(self) -> Float[np.ndarray, "n d"]:
        """Velocity g of the first partner relative to the second one, m/s."""
        return self.first.velocity - self.second.velocity

    @property
    def count(self) -> Float[np.ndarray, "n"]:
        """Number of frames of the shorter line."""
        return np.minimum(self.first.count, self.second.count)

    def separation_at(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n d"]:
        """Return the vectors from the second partner to the first one at some times, m."""
        return self.first.at(time) - self.second.at(time)

    def variance_at(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the variances of these vectors, see `Lines`."""
        return self.first.variance_at(time) + self.second.variance_at(time)

    def are_straight(self, error: float, level: float) -> Bool[np.ndarray, "n"]:
        """Return whether both flights are straight, see `Lines.are_straight`."""
        return self.first.are_straight(error, level) & self.second.are_straight(error, level)


class Flights(NamedTuple):
    """Free flights of both partners of each encounter.

    Attributes:
        before: lines until the encounter.
        after: lines from the encounter on.
        through: lines through both flights, as if the encounter changed no velocity.
        time: time of the encounter, s.
    """

    before: LinePairs
    after: LinePairs
    through: LinePairs
    time: Float[np.ndarray, "n"]

    def with_walls(self, is_wall: Bool[np.ndarray, "n"]) -> "Flights":
        """Return the flights with some second partners replaced by walls, see `Lines`."""
        before, after, through = (
            LinePairs(lines.first, lines.second.with_walls(is_wall))
            for lines in (self.before, self.after, self.through)
        )
        return Flights(before, after, through, self.time)


class Breaks(NamedTuple):
    """Ends of free flights, by encounters.

    Attributes:
        time: time of the encounter, s.
        half_width: frames on each side of this time that belong to no flight.
        ends_others: whether the flights of the same particles before and after other encounters end
            here: not if the encounter changed no velocity.
    """

    time: Float[np.ndarray, "n"]
    half_width: Float[np.ndarray, "n"]
    ends_others: Bool[np.ndarray, "n"]


def flights_between(
    motion: Motion, first: Int[np.ndarray, "n"], second: Int[np.ndarray, "n"], breaks: Breaks
) -> Flights:
    """Return the flights before and after each break, to the neighbouring breaks.

    Args:
        motion: motion of all particles.
        first: number of the first partner in each encounter.
        second: number of the second one. Walls, with negative numbers, have no rows: see
            `Flights.with_walls`.
        breaks: one for each encounter.
    """
    particle = np.concatenate([first, second])
    frame = np.tile(np.interp(breaks.time, motion.times, np.arange(motion.num_frames)), 2)
    width = np.tile(breaks.half_width, 2)
    ends_others = np.tile(breaks.ends_others, 2)
    since, until = _free_frames(particle, frame, width, ends_others, motion.num_frames)

    def rows(frame: Float[np.ndarray, "m"]) -> Int[np.ndarray, "m"]:
        return motion.first_rows(particle, frame)

    def lines(begin: Int[np.ndarray, "m"], end: Int[np.ndarray, "m"]) -> LinePairs:
        of_first, of_second = zip(np.split(begin, 2), np.split(end, 2), strict=True)
        return LinePairs(fit_lines(motion, *of_first), fit_lines(motion, *of_second))

    begin = rows(np.ceil(since))
    end = rows(np.floor(until) + 1)
    before = lines(begin, rows(np.floor(frame - width) + 1))
    after = lines(rows(np.ceil(frame + width)), end)
    return Flights(before, after, lines(begin, end), breaks.time)


def _free_frames(
    particle: Int[np.ndarray, "m"],
    frame: Float[np.ndarray, "m"],
    width: Float[np.ndarray, "m"],
    ends_others: Bool[np.ndarray, "m"],
    num_frames: int,
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Return the end of the last break before each frame, and the begin of the next one after it.

    Args:
        particle: number of the particle.
        frame: frame of its break.
        width: frames on each side of this one that belong to no flight.
        ends_others: whether the break ends flights that begin or end at others.
        num_frames: number of frames.

    Returns:
        Two frames, 0 and `num_frames` where there is no other break of the particle.
    """
    key = particle * (num_frames + 1) + frame  # sorts by particle, then by time
    order = np.flatnonzero(ends_others)[np.argsort(key[ends_others])]
    # The last entry, of nobody, is found where no break precedes or follows.
    owner = np.append(particle[order], NOBODY)
    begin = np.append((frame - width)[order], np.inf)
    end = np.append((frame + width)[order], -np.inf)
    preceding = np.searchsorted(key[order], key, side="left") - 1
    following = np.searchsorted(key[order], key, side="right")
    since = np.where(owner[preceding] == particle, end[preceding], -np.inf)
    until = np.where(owner[following] == particle, begin[following], np.inf)
    return np.maximum(since, 0), np.minimum(until, num_frames)


def error_by_scatter(lines: LinePairs) -> float | None:
    """Return the localisation error by the scatter of positions about lines, m.

    Returns:
        None if no line has more than `MIN_FRAMES` frames.
    """
    squares = []
    for partner in lines:
        is_long = partner.count > MIN_FRAMES
        expected = scipy.stats.chi2.median(partner.degrees_of_freedom[is_long])
        squares.append(partner.scatter[is_long] / expected)
    squares = np.concatenate(squares)
    if squares.size == 0:
        return None
    # The median ignores flights that an impact bends.
    return max(float(np.sqrt(np.median(squares))), TINY)
