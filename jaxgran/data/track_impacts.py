"""Single impacts from tracks of particles: speeds before and after, with their errors.

Between impacts a particle moves in a straight line. Lines through the positions of the free flights
before an impact give when and where two spheres meet, and lines after it how they part. All of it
works on arrays of all impacts at once.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy  # which imports scipy.spatial at its first use
from jaxtyping import Bool, Float, Int

from jaxgran._utils.formatting import text_table
from jaxgran.data import files, tracks
from jaxgran.data.curve_file import CSV_FILE
from jaxgran.data.drop_test import MAX_SIGMAS, SPHERE, WALL, DropTest
from jaxgran.data.header import checked_header, gas_of_header, priors_of_header
from jaxgran.data.measurement import Measurement
from jaxgran.data.tables import header_in_si, read_table
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import MATERIAL, PARAMETERS

MIN_FRAMES = 3
"""Least number of frames of a free flight: two for the line, and one that tells its error."""

MIN_TIMED = 2
"""Least number of frames by which the time of an impact is known."""

TIME_ERRORS = 2.0
"""Frames nearer to an impact than this many errors of its time belong to no flight."""

MARGIN = 1.5
"""Distance of the impact parameter from the diameter, in its standard errors, below which two
spheres may have passed each other. False impacts are then .2 % of all."""

MISSED = 3.0
"""Distance beyond the diameter, in standard errors, from which on two spheres did not meet."""

NUM_PASSES = 3
"""Number of times that flights are delimited by the impacts found before."""

BENT_LEVEL = 1e-4
"""Probability by chance below which positions are not on a straight line."""

THROUGH_LEVEL = 0.05
"""The same of the two flights of an encounter together, above which it changed no velocity."""

WALL_TOLERANCE = 0.05
"""Largest difference of the extent of all positions, beyond their errors, from the side of the
container less a diameter, in diameters."""

MAX_GAP = 2
"""Largest number of frames between two frames of one encounter."""

NUM_STEPS = 3
"""Number of frames over which a relative speed is estimated."""

UNKNOWN_VARIANCE = 1e6
"""Variance of a position that no line gives, over the squared localisation error."""

TINY = 1e-300

FAST_STEP = 0.999
"""Quantile of the displacements between frames that counts as the largest one."""


class Impacts(NamedTuple):
    """Impacts that tracks show.

    Attributes:
        spheres: impacts of two spheres; None without any.
        walls: impacts on the walls of the container; None without any.
        counts: numbers of encounters of spheres and of walls that were "used", or left out because
            they were "grazing" (they may have missed), had "few frames" (other impacts overlap or
            follow, or a track ends), were "bent" (a flight is not straight), or "impossible" (eps
            outside [0, 1] by 5 errors: wrong identities, or no impact).
        places: of the impacts of spheres: the numbers of both particles, in increasing order of
            their identities from 0 on, and the times, s.
        localisation_error: standard error of one coordinate, m, as given or as the scatter about
            the lines shows.
        header: of the file, in SI.
        gas: that the header describes.

    >>> jaxgran.Impacts(None, None, {"used": 0}, ([], [], []), 4e-5, {}, gas).measurements
    {}
    """

    spheres: DropTest | None
    walls: DropTest | None
    counts: dict[str, int]
    places: tuple[np.ndarray, np.ndarray, np.ndarray]
    localisation_error: float
    header: dict[str, str]
    gas: Gas

    @property
    def measurements(self) -> dict[str, Measurement]:
        """The drop tests with their gas, by the labels "impacts" and "wall impacts"."""
        found = {"impacts": self.spheres, "wall impacts": self.walls}
        counts = ", ".join(f"{count} {name}" for name, count in self.counts.items())
        header = tuple((self.header | {"impacts_from": f"tracks: {counts}"}).items())
        priors = {
            name: known
            for name, known in priors_of_header(self.header).items()
            if name in self.gas.domains and PARAMETERS[name].belongs_to == MATERIAL
        }
        return {
            label: Measurement(self.gas, test, priors=priors, header=header)
            for label, test in found.items()
            if test is not None
        }

    def __repr__(self) -> str:
        rows = [(name, str(count)) for name, count in self.counts.items()]
        rows.append(("localisation error", f"{self.localisation_error:.3g} m"))
        return text_table("Impacts", rows)


def read_impacts(path: str | Path, header: dict[str, Any] | None = None) -> Impacts:
    """Read the single impacts of spheres, and of spheres with walls, from tracks of particles.

    Two spheres that come near each other are an impact if the straight lines of their flights
    before it pass at less than a diameter, by `MARGIN` standard errors. The lines touch at the time
    t* with the unit vector n between the centres; with the relative velocities g and g' by the
    lines before and after t*,

        v_n = -g.n,    v_n' = g'.n,    eps = v_n'/v_n.

    Impacts are chosen by the flights before them, and never by eps. Errors of v_n and v_n', and
    their correlation by n, follow from the localisation error and the number of frames of each
    flight; a fit takes both for measured (`DropTest.speed_error`), and finds the width by which eps
    scatters in addition (`DropTest.scatters`). Tangential velocities contain spins, which positions
    do not show: roughness and friction cannot be known from tracks.

    Impacts and T(t) of the same tracks share their grains, but hardly their errors: an impact is
    compared with eps at its own speed, whatever the speeds of others are.

    Args:
        path: CSV file of tracks, see `jaxgran.read_measurement`. Particles keep their identity
            during impacts.
        header: further entries of the header of the file. Needed are the keys of a gas, and
            frame_rate for frames without times; box_side unwraps positions; localisation_error is
            estimated without it; container_side and wall_restitution lead to impacts on walls,
            which must be parallel to the coordinates.

    Returns:
        `Impacts`; ``jaxgran.fit({"curve": measurement, **impacts.measurements})`` fits them with
        T(t).

    Raises:
        ValueError: for two coordinates of a gas in three dimensions, trajectories and curves,
            tracks without impacts, and whatever the header says that no model has, such as rods.

    >>> t = jnp.arange(40) / 500  # s; the first sphere flies at .1 m/s and hits the second one
    >>> x = jnp.stack([jnp.where(t < 0.04, 0.1 * t, 0.004 + 0.005 * (t - 0.04)),
    ...     0.006 + jnp.where(t < 0.04, 0.0, 0.095 * (t - 0.04))])
    >>> rows = [f"{i},{t[k]},{x[i, k]},0,{1e-9 * k}" for k in range(40) for i in range(2)]
    >>> with open("tracks.csv", "w") as file:
    ...     _ = file.write("\\n".join(["id,t,x,y,z", *rows]))
    >>> known = {"eta": 0.05, "diameter": "2 mm", "density": 2387, "Y": 5e7, "nu": 0.22, "T0": 0.01}
    >>> known |= {"localisation_error": 1e-6}
    >>> impacts = jaxgran.read_impacts("tracks.csv", known)
    >>> impacts.counts["used"], round(float(impacts.spheres.restitution[0]), 3)
    (1, 0.9)
    """
    path = files.checked_path(path, CSV_FILE)
    given = {} if header is None else checked_header(header)
    with files.name_in_errors(path):
        if tracks.is_trajectory(path) or path.suffix == ".npz":
            raise ValueError(
                "impacts are read from CSV files of tracks (id,t,x,y,z), frame by frame; a file of "
                "velocities at few times does not show them"
            )
        table = read_table(path, "id,t,x,y,z", tracks.track_columns, given, tracks.IDENTITIES)
        entries = header_in_si(table.header)
        gas, _ = gas_of_header(entries)
        motion = _Motion.of_columns(table.columns, entries, table.lines, gas)
        return _impacts_of(motion, gas, entries)


class _Motion(NamedTuple):
    """Positions of particles, sorted by particle and time.

    Attributes:
        particle: number of the particle of each row, from 0.
        frame: number of the frame of each row, from 0.
        time: s.
        position: m, continued where a particle leaves a periodic box, shape (rows, d).
        error: standard error of a coordinate, m.
        side: of a periodic box, m; infinite without one.
        num_frames: number of frames.
        frame_time: typical time between frames, s.
        terms: 1, t, t^2, x, t x and x^2 from the origin, and a last row of zeros, shape (rows + 1,
            4 + 2 d).
        origin: time, s, and position, m, of the first row of each particle, shape (rows, 1 + d).
    """

    particle: Int[np.ndarray, "rows"]
    frame: Int[np.ndarray, "rows"]
    time: Float[np.ndarray, "rows"]
    position: Float[np.ndarray, "rows d"]
    error: float
    side: float
    num_frames: int
    frame_time: float
    terms: Float[np.ndarray, "more terms"]
    origin: Float[np.ndarray, "rows e"]

    @classmethod
    def of_columns(
        cls,
        columns: Mapping[str, np.ndarray],
        header: dict[str, str],
        lines: list[int],
        gas: Gas,
    ) -> "_Motion":
        """Return the motion that the columns of tracks describe."""
        ids, time, position = tracks.positions_of_tracks(columns, header, lines)
        if position.shape[1] < gas.dimension:
            raise ValueError(
                f"the tracks have {position.shape[1]} coordinates of a gas of dimension "
                f"{gas.dimension}: in a projection neither the normal of an impact nor its speed "
                "along it can be known. Film all three coordinates, or give `dimension: 2` for "
                "spheres that move in a plane"
            )
        _, particle = np.unique(ids, return_inverse=True)
        times, frame = np.unique(time, return_inverse=True)
        order = np.lexsort((frame, particle))
        particle, frame, time, position = (x[order] for x in (particle, frame, time, position))
        if times.size < 2 * MIN_FRAMES:
            raise ValueError(
                f"the tracks have {times.size} frames; impacts need {MIN_FRAMES} before and "
                f"{MIN_FRAMES} after each"
            )
        side = files.header_number(header, "box_side") if "box_side" in header else np.inf
        same = particle[1:] == particle[:-1]
        if side < np.inf:
            crossed = np.round(np.diff(position, axis=0) / side) * same[:, None]
            images = np.concatenate([np.zeros((1, position.shape[1])), np.cumsum(crossed, axis=0)])
            position = position - side * images
        if "localisation_error" in header:
            error = files.header_number(header, "localisation_error")
            if not error > 0:
                raise ValueError(
                    f"localisation_error must be > 0 m, got {error:g}. Leave it out, and it is "
                    "estimated from the tracks"
                )
        else:
            error = _scatter_of_second_differences(particle, position)
        first = np.flatnonzero(np.append(True, ~same))
        begin = first[np.cumsum(np.append(True, ~same)) - 1]
        origin = np.column_stack([time, position])[begin]
        t = time - origin[:, 0]
        x = position - origin[:, 1:]
        terms = np.column_stack([np.ones_like(t), t, t**2, x, t[:, None] * x, np.sum(x**2, axis=1)])
        terms = np.concatenate([terms, np.zeros((1, terms.shape[1]))])
        frame_time = float(np.median(np.diff(times)))
        return cls(
            particle, frame, time, position, error, side, times.size, frame_time, terms, origin
        )

    def rows_from(self, particle: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Return the first row of each particle from a frame on."""
        keys = self.particle * self.num_frames + self.frame
        return np.searchsorted(
            keys, particle * self.num_frames + np.clip(frame, 0, self.num_frames)
        )

    def _sums(self, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return sums of the terms over rows from `begin` to before `end`.

        Each is summed by itself: differences of sums over all rows would lose digits.
        """
        order = np.argsort(begin, kind="stable")
        bounds = np.stack([begin, np.maximum(begin, end)], axis=1)[order]
        sums = np.empty((len(begin), self.terms.shape[1]))
        if len(begin):
            sums[order] = np.add.reduceat(self.terms, bounds.ravel(), axis=0)[::2]
        return np.where((end > begin)[:, None], sums, 0.0)

    def lines(self, begin: np.ndarray, end: np.ndarray) -> "_Lines":
        """Return the lines of least squares through rows from `begin` to before `end`."""
        d = self.position.shape[1]
        count, t, t2, *rest = self._sums(begin, end).T
        x = np.stack(rest[:d], axis=1)
        tx = np.stack(rest[d : 2 * d], axis=1)
        safe = np.maximum(count, 1)
        middle = t / safe
        mean = x / safe[:, None]
        square = t2 - t * middle
        weight = np.where(count >= 2, square, np.inf)
        velocity = (tx - middle[:, None] * x) / weight[:, None]
        scatter = rest[2 * d] - count * np.sum(mean**2, axis=1)
        scatter = scatter - np.where(count >= 2, square, 0.0) * np.sum(velocity**2, axis=1)
        origin = self.origin[np.minimum(begin, self.origin.shape[0] - 1)]
        return _Lines(
            count.astype(int),
            middle + origin[:, 0],
            mean + origin[:, 1:],
            velocity,
            square,
            np.maximum(scatter, 0.0),
        )


class _Lines(NamedTuple):
    """Straight lines through the positions of free flights.

    Attributes:
        count: number of frames.
        time: their mean, s.
        position: mean position, m.
        velocity: m/s.
        square: sum of squares of the times about their mean, s^2.
        scatter: sum of squares of the positions about the line, m^2.
    """

    count: Int[np.ndarray, "n"]
    time: Float[np.ndarray, "n"]
    position: Float[np.ndarray, "n d"]
    velocity: Float[np.ndarray, "n d"]
    square: Float[np.ndarray, "n"]
    scatter: Float[np.ndarray, "n"]

    def at(self, time: np.ndarray) -> np.ndarray:
        """Return the position at a time."""
        return self.position + self.velocity * (time - self.time)[:, None]

    def variance_at(self, time: np.ndarray) -> np.ndarray:
        """Return the variance of a coordinate at a time, over the squared localisation error."""
        known = self.count >= 2
        lever = (time - self.time) ** 2 / np.where(known, self.square, 1.0)
        return np.where(known, 1 / np.maximum(self.count, 1) + lever, UNKNOWN_VARIANCE)

    def of_events(self, size: int) -> "tuple[_Lines, _Lines]":
        """Return the lines of the first and of the second partners of events."""
        return _Lines(*(x[:size] for x in self)), _Lines(*(x[size:] for x in self))


def _scatter_of_second_differences(particle: np.ndarray, position: np.ndarray) -> float:
    """Return the error of a coordinate by the median of second differences, which impacts leave."""
    same = particle[2:] == particle[:-2]
    second = (position[2:] - 2 * position[1:-1] + position[:-2])[same]
    scale = 1.4826 * np.median(np.abs(second)) / 6**0.5 if second.size else 0.0
    return float(max(scale, 1e-9 * np.ptp(position)))


class _Events(NamedTuple):
    """Encounters of spheres with each other, or with walls.

    Attributes:
        first: numbers of the particles.
        second: numbers of their partners; -1 of walls.
        shift: image of the second particle, m, added to its position, or the point of a wall that
            the centre reaches, shape (n, d).
        normal: unit vector away from a wall, shape (n, d); 0 of spheres.
        time: of the encounter, s.
        half_width: frames on each side of this time that may lie on the other side of the impact.
        tolerance: largest difference of the times of an impact and of its encounter, s.
        is_break: whether it may have changed the velocities.
    """

    first: Int[np.ndarray, "n"]
    second: Int[np.ndarray, "n"]
    shift: Float[np.ndarray, "n d"]
    normal: Float[np.ndarray, "n d"]
    time: Float[np.ndarray, "n"]
    half_width: Float[np.ndarray, "n"]
    tolerance: Float[np.ndarray, "n"]
    is_break: Bool[np.ndarray, "n"]

    def where(self, mask: np.ndarray) -> "_Events":
        """Return some of the encounters."""
        return _Events(*(x[mask] for x in self))


class _Meeting(NamedTuple):
    """Where lines before encounters meet, and how lines after them part.

    Attributes:
        time: of the impact, by the lines before and after it, s.
        time_error: s.
        meets: whether the lines before touch by `MARGIN` errors, near the time of the encounter.
        misses: whether they pass at more than a diameter by `MISSED` errors, or do not meet and
            the flights are not bent.
        speed: v_n, m/s.
        speed_after: v_n', m/s.
        covariance: variances of both and their covariance, m^2/s^2, shape (3, n).
        count_before: least number of frames of the flights before.
        count: the same of all flights.
        is_straight: whether the flights are straight.
    """

    time: Float[np.ndarray, "n"]
    time_error: Float[np.ndarray, "n"]
    meets: Bool[np.ndarray, "n"]
    misses: Bool[np.ndarray, "n"]
    speed: Float[np.ndarray, "n"]
    speed_after: Float[np.ndarray, "n"]
    covariance: Float[np.ndarray, "3 n"]
    count_before: Int[np.ndarray, "n"]
    count: Int[np.ndarray, "n"]
    is_straight: Bool[np.ndarray, "n"]


def _impacts_of(motion: _Motion, gas: Gas, header: dict[str, str]) -> Impacts:
    """Return the impacts that a motion shows: see `read_impacts`."""
    diameter = float(gas.diameter)
    found = [_encounters_of_spheres(motion, diameter)]
    if gas.container is not None:
        found.append(_encounters_with_walls(motion, gas))
    events = _Events(*(np.concatenate(x) for x in zip(*found, strict=True)))
    first = events
    meeting = _meeting(motion, events, first.time, diameter)
    for _ in range(NUM_PASSES):
        known = (meeting.count_before >= MIN_TIMED) & meeting.is_straight
        timed = known & meeting.meets
        frames_off = TIME_ERRORS * meeting.time_error / motion.frame_time
        events = events._replace(
            time=np.where(timed, meeting.time, first.time),
            half_width=np.where(timed, np.minimum(frames_off, first.half_width), first.half_width),
            is_break=~(known & meeting.misses & (meeting.count_before >= MIN_FRAMES)),
        )
        motion = motion._replace(error=_scatter_about_lines(motion, events, header))
        meeting = _meeting(motion, events, first.time, diameter)
    return _summary(motion, events, meeting, gas, header)


def _encounters_of_spheres(motion: _Motion, diameter: float) -> _Events:
    """Return encounters of two spheres that may be impacts, by their least distance."""
    same = motion.particle[1:] == motion.particle[:-1]
    steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=1)[same]
    if steps.size == 0:
        raise ValueError(
            "no particle occurs in two frames. Give each particle the same id in all frames"
        )
    blur = 2**0.5 * motion.error
    reach = diameter + float(np.quantile(steps, FAST_STEP)) + 4 * blur
    a, b = _near_rows(motion, reach)
    apart = motion.position[a] - motion.position[b]
    shift = np.zeros_like(apart)
    if motion.side < np.inf:
        shift = motion.side * np.round(apart / motion.side)
    distance = np.linalg.norm(apart - shift, axis=1)
    pair = motion.particle[a] * (np.max(motion.particle) + 1) + motion.particle[b]
    frame = motion.frame[a]
    order = np.lexsort((frame, pair))
    is_new = (np.diff(pair[order], prepend=-1) != 0) | (np.diff(frame[order], prepend=0) > MAX_GAP)
    group = np.empty(order.size, int)
    group[order] = np.cumsum(is_new)
    by_distance = np.lexsort((distance, group))
    nearest = by_distance[np.flatnonzero(np.diff(group[by_distance], prepend=0))]
    a = a[nearest]
    b = b[nearest]
    shift = shift[nearest]
    distance = distance[nearest]
    speed = np.maximum(_relative_speed(motion, a, b, -1), _relative_speed(motion, a, b, 1))
    moved = speed * motion.frame_time
    close = distance <= diameter + moved / 2 + 4 * blur
    half_width = _half_width(moved, blur)
    return _Events(
        motion.particle[a],
        motion.particle[b],
        shift,
        np.zeros_like(shift),
        motion.time[a],
        half_width,
        (half_width + 1) * motion.frame_time,
        np.ones(a.size, bool),
    ).where(close)


def _half_width(moved: np.ndarray, error: float) -> np.ndarray:
    """Return the frames around the closest one that may lie on either side of an impact.

    Without errors of positions it is the closest frame alone.

    Args:
        moved: relative displacement between frames, m.
        error: of a distance, m.
    """
    return np.maximum(1.0, 3 * error / np.maximum(moved, error))


def _near_rows(motion: _Motion, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of all pairs of particles nearer than a distance in one frame."""
    order = np.argsort(motion.frame, kind="stable")
    periodic = motion.side < np.inf
    found = [np.zeros((0, 2), int)]
    for rows in np.split(order, np.flatnonzero(np.diff(motion.frame[order])) + 1):
        position = motion.position[rows]
        if periodic:
            position = np.mod(position, motion.side)
            position = np.where(position >= motion.side, 0.0, position)
        tree = scipy.spatial.KDTree(position, boxsize=motion.side if periodic else None)
        found.append(rows[tree.query_pairs(reach, output_type="ndarray")])
    a, b = np.sort(np.concatenate(found), axis=1).T
    return a, b


def _relative_speed(motion: _Motion, a: np.ndarray, b: np.ndarray, sense: int) -> np.ndarray:
    """Return the relative speed of two rows over some frames before (-1) or after (1) them, m/s."""

    def neighbour(row: np.ndarray) -> np.ndarray:
        other = np.clip(row + sense * NUM_STEPS, 0, motion.particle.size - 1)
        return np.where(motion.particle[other] == motion.particle[row], other, row)

    moved = [motion.position[neighbour(row)] - motion.position[row] for row in (a, b)]
    return np.linalg.norm(moved[0] - moved[1], axis=1) / (NUM_STEPS * motion.frame_time)


def _encounters_with_walls(motion: _Motion, gas: Gas) -> _Events:
    """Return encounters of spheres with the walls of the container."""
    d = motion.position.shape[1]
    assert gas.container is not None
    room = np.broadcast_to(np.asarray(gas.container.side), (d,)) - float(gas.diameter)
    low = motion.position.min(axis=0)
    high = motion.position.max(axis=0)
    allowed = WALL_TOLERANCE * float(gas.diameter) + 2 * MAX_SIGMAS * motion.error
    if np.any(np.abs(high - low - room) > allowed):
        raise ValueError(
            "the positions extend over "
            f"{' x '.join(f'{x:.4g}' for x in high - low)} m, and walls at container_side leave "
            f"{' x '.join(f'{x:.4g}' for x in room)} m to the centres: impacts on walls need walls "
            "parallel to the coordinates, which some of the particles reach. Correct "
            "container_side, or leave it out to read the impacts of spheres alone"
        )
    found = []
    for axis in range(d):
        for sign, end in ((1, (low + high - room)[axis] / 2), (-1, (low + high + room)[axis] / 2)):
            height = sign * (motion.position[:, axis] - end)
            moved = np.abs(np.diff(height, append=height[-1:]))
            row = np.flatnonzero(height <= moved / 2 + 4 * motion.error)
            pair = motion.particle[row]
            is_new = (np.diff(pair, prepend=-1) != 0) | (
                np.diff(motion.frame[row], prepend=0) > MAX_GAP
            )
            group = np.cumsum(is_new)
            by_height = np.lexsort((height[row], group))
            nearest = row[by_height[np.flatnonzero(np.diff(group[by_height], prepend=0))]]
            n = nearest.size
            shift = np.zeros((n, d))
            shift[:, axis] = end
            normal = np.zeros((n, d))
            normal[:, axis] = sign
            step = np.maximum(moved[nearest], motion.error)
            half_width = _half_width(step, motion.error)
            found.append(
                _Events(
                    motion.particle[nearest],
                    np.full(n, -1),
                    shift,
                    normal,
                    motion.time[nearest],
                    half_width,
                    (half_width + 1) * motion.frame_time,
                    np.ones(n, bool),
                )
            )
    return _Events(*(np.concatenate(x) for x in zip(*found, strict=True)))


def _flights(motion: _Motion, events: _Events) -> tuple[_Lines, _Lines, _Lines]:
    """Return lines before, after and through events, of first partners and then of second ones."""
    of_frame = np.unique(motion.time)
    frame = np.interp(events.time, of_frame, np.arange(of_frame.size))
    particle = np.concatenate([events.first, events.second])
    frame = np.concatenate([frame, frame])
    width = np.concatenate([events.half_width, events.half_width])
    key = particle * (motion.num_frames + 1) + frame
    is_break = np.concatenate([events.is_break, events.is_break])
    order = np.flatnonzero(is_break)[np.argsort(key[is_break])]
    known = key[order]
    # Bounds of the flights of each particle before and after each break, and at both ends.
    until = np.append((frame - width)[order], np.inf)
    since = np.append((frame + width)[order], -np.inf)
    of_break = np.append(particle[order], -2)
    next_break = np.searchsorted(known, key, side="right")
    last_break = np.searchsorted(known, key, side="left")
    after = np.where(of_break[next_break] == particle, until[next_break], np.inf)
    before = np.where(of_break[last_break - 1] == particle, since[last_break - 1], -np.inf)
    after = np.minimum(after, motion.num_frames)
    before = np.maximum(before, 0)
    particle = np.maximum(particle, 0)

    def rows(bound: np.ndarray) -> np.ndarray:
        return motion.rows_from(particle, bound.astype(int))

    begin = rows(np.ceil(before))
    end = rows(np.floor(after) + 1)
    earlier = motion.lines(begin, rows(np.floor(frame - width) + 1))
    later = motion.lines(rows(np.ceil(frame + width)), end)
    return earlier, later, motion.lines(begin, end)


def _meeting(
    motion: _Motion, events: _Events, encountered: Float[np.ndarray, "n"], diameter: float
) -> _Meeting:
    """Return where the lines of encounters meet, and how they part.

    Args:
        motion: of the particles.
        events: with the times at which flights are divided.
        encountered: times of the closest frames, s.
        diameter: m.
    """
    size = events.first.size
    is_wall = events.second < 0
    earlier, later, through = _flights(motion, events)
    i, j = earlier.of_events(size)
    i_after, j_after = later.of_events(size)
    to_second = np.where(is_wall, 0.0, 1.0)[:, None]
    g = i.velocity - to_second * j.velocity
    g_after = i_after.velocity - to_second * j_after.velocity
    r = i.at(events.time) - to_second * j.at(events.time) - events.shift
    square = np.maximum(np.sum(g**2, axis=1), TINY)
    nearest = -np.sum(r * g, axis=1) / square
    passing = r + g * nearest[:, None]
    parameter = np.linalg.norm(passing, axis=1)
    depth = np.maximum(diameter**2 - parameter**2, 0.0)
    # A wall is met where the height is 0, and two spheres where they are a diameter apart.
    fall = -np.sum(g * events.normal, axis=1)
    height = np.sum(r * events.normal, axis=1)
    to_wall = height / np.where(np.abs(fall) > 0, fall, np.inf)
    elapsed = np.where(is_wall, to_wall, nearest - np.sqrt(depth / square))
    time = events.time + elapsed
    at_contact = r + g * elapsed[:, None]
    length = np.maximum(np.linalg.norm(at_contact, axis=1), TINY)
    normal = np.where(is_wall[:, None], events.normal, at_contact / length[:, None])
    speed = -np.sum(g * normal, axis=1)
    speed_after = np.sum(g_after * normal, axis=1)
    # Changes of both by the separation at the time of contact, which turns the normal.
    slope = np.where(np.abs(speed) > 0, -1 / np.where(speed == 0, 1.0, speed), 0.0)
    turned = np.where(is_wall, 0.0, 1 / diameter)[:, None]

    def by_separation(u: np.ndarray) -> np.ndarray:
        normal_change = np.sum(u * g, axis=1) * slope
        return turned * (u - normal * normal_change[:, None])

    D = -by_separation(g)
    C = by_separation(g_after)
    variance = motion.error**2
    of_speed = np.zeros(size)
    of_after = np.zeros(size)
    both = np.zeros(size)
    of_place = np.zeros(size)
    of_place_after = np.zeros(size)
    for line, line_after, counts in ((i, i_after, 1.0), (j, j_after, to_second[:, 0])):
        delay = (time - line.time)[:, None]
        weight = counts / np.maximum(line.count, 1)
        of_velocity = counts / np.where(line.count >= 2, line.square, np.inf)
        by_velocity = -normal + D * delay
        of_speed += weight * np.sum(D**2, axis=1) + of_velocity * np.sum(by_velocity**2, axis=1)
        of_after += weight * np.sum(C**2, axis=1) + of_velocity * np.sum((C * delay) ** 2, axis=1)
        both += weight * np.sum(C * D, axis=1)
        both += of_velocity * np.sum(C * delay * by_velocity, axis=1)
        of_after += counts / np.where(line_after.count >= 2, line_after.square, np.inf)
        of_place += counts * line.variance_at(time)
        of_place_after += counts * line_after.variance_at(time)
    place_error = motion.error * np.sqrt(of_place)
    speed_error = np.sqrt(variance * of_speed)
    slowest = motion.error / np.ptp(motion.time)
    time_error = place_error / np.maximum(speed, speed_error + slowest)
    r_after = i_after.at(time) - to_second * j_after.at(time) - events.shift
    parted = _time_of_parting(r_after, g_after, events, diameter)
    after_error = motion.error * np.sqrt(of_place_after)
    after_error = after_error / np.maximum(speed_after, np.sqrt(variance * of_after) + slowest)
    agrees = np.abs(parted) < MISSED * np.hypot(time_error, after_error)
    share = np.where(agrees, time_error**2 / (time_error**2 + after_error**2 + TINY), 0.0)
    margin = diameter - parameter
    is_near = np.abs(time - encountered) <= events.tolerance
    meets = np.where(is_wall, speed > MARGIN * speed_error, margin > MARGIN * place_error) & is_near
    misses = ~is_wall & (margin < -MISSED * place_error)
    count_before = np.where(is_wall, i.count, np.minimum(i.count, j.count))
    count_after = np.where(is_wall, i_after.count, np.minimum(i_after.count, j_after.count))
    straight = _are_straight(motion, earlier, is_wall) & _are_straight(motion, later, is_wall)
    return _Meeting(
        time + share * parted,
        time_error * np.sqrt(1 - share),
        meets,
        misses | (~meets & _are_straight(motion, through, is_wall, THROUGH_LEVEL)),
        speed,
        speed_after,
        variance * np.stack([of_speed, of_after, both]),
        count_before,
        np.minimum(count_before, count_after),
        straight,
    )


def _are_straight(
    motion: _Motion, lines: _Lines, is_wall: np.ndarray, level: float = BENT_LEVEL
) -> Bool[np.ndarray, "n"]:
    """Return whether the positions of both partners of encounters lie on their lines."""
    degrees = np.maximum(lines.count - 2, 1) * motion.position.shape[1]
    chance = scipy.stats.chi2.sf(lines.scatter / motion.error**2, degrees)
    of_first, of_second = np.split(chance > level, 2)
    return of_first & (of_second | is_wall)


def _time_of_parting(
    r: np.ndarray, g: np.ndarray, events: _Events, diameter: float
) -> Float[np.ndarray, "n"]:
    """Return the time after which lines with separation r and velocity g part, s."""
    is_wall = events.second < 0
    square = np.maximum(np.sum(g**2, axis=1), TINY)
    nearest = -np.sum(r * g, axis=1) / square
    parameter = np.linalg.norm(r + g * nearest[:, None], axis=1)
    rise = np.sum(g * events.normal, axis=1)
    height = np.sum(r * events.normal, axis=1)
    from_wall = -height / np.where(np.abs(rise) > 0, rise, np.inf)
    chord = np.sqrt(np.maximum(diameter**2 - parameter**2, 0.0) / square)
    return np.where(is_wall, from_wall, nearest + chord)


def _scatter_about_lines(motion: _Motion, events: _Events, header: dict[str, str]) -> float:
    """Return the localisation error, from the header or the scatter about straight flights."""
    if "localisation_error" in header:
        return motion.error
    lines = _flights(motion, events)[0]
    long = lines.count > MIN_FRAMES
    if not np.any(long):
        return motion.error
    degrees = (lines.count - 2) * motion.position.shape[1]
    # The median leaves flights out that an impact bends.
    ratio = lines.scatter[long] / scipy.stats.chi2.median(degrees[long])
    return float(np.sqrt(max(np.median(ratio), 0.0)) + TINY)


def _summary(
    motion: _Motion, events: _Events, meeting: _Meeting, gas: Gas, header: dict[str, str]
) -> Impacts:
    """Return the impacts among encounters, with the reasons why others are left out."""
    of_speed, of_after, both = meeting.covariance
    safe = np.where(meeting.speed > 0, meeting.speed, 1.0)
    eps = meeting.speed_after / safe
    error = np.sqrt(of_after + eps**2 * of_speed - 2 * eps * both) / safe
    possible = (eps > -MAX_SIGMAS * error) & (eps < 1 + MAX_SIGMAS * error)
    left = np.ones(eps.size, bool)
    counts = {}
    for name, passes in (
        ("few frames", meeting.count >= MIN_FRAMES),
        ("bent", meeting.is_straight),
        ("grazing", meeting.meets),
        ("impossible", possible),
    ):
        counts[name] = int(np.sum(left & ~passes))
        left &= passes
    counts = {"used": int(np.sum(left))} | counts
    is_wall = events.second < 0

    def test_of(mask: np.ndarray, onto: str) -> DropTest | None:
        if not np.any(mask):
            return None
        after = np.sqrt(of_after[mask])
        speed_error = np.sqrt(of_speed[mask])
        return DropTest(
            safe[mask],
            eps[mask],
            after / safe[mask],
            onto,
            speed_error=speed_error,
            correlation=both[mask] / (after * speed_error),
            scatters=True,
        )

    spheres = test_of(left & ~is_wall, SPHERE)
    walls = test_of(left & is_wall, WALL)
    if spheres is None and walls is None:
        reasons = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise ValueError(
            f"the tracks show no impact with {MIN_FRAMES} frames before and after it ({reasons}): "
            "film at a higher rate, and check diameter and length_unit"
        )
    of_spheres = left & ~is_wall
    first = events.first
    second = events.second
    times = meeting.time
    places = first[of_spheres], second[of_spheres], times[of_spheres]
    return Impacts(spheres, walls, counts, places, motion.error, header, gas)
