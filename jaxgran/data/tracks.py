"""T(t) of particles that are followed: from tracks, positions in frames, and from trajectories."""

from collections.abc import Mapping
from math import pi
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy  # which imports scipy.stats at its first use
from jaxtyping import Float, Int

from jaxgran.data.curve import MIN_POINTS, CoolingCurve, from_arrays
from jaxgran.data.curve_checks import check_values
from jaxgran.data.files import header_count, header_number, positive_number
from jaxgran.data.particle_file import GSD_DEFAULT, Frame, open_frames
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import sphere_mass

COORDINATES = ("x", "y", "z")
IDENTITIES = ("track_id", "id", "particle")
CLOCKS = ("t", "frame")
"""Names of columns of tracks, in order of preference; some are used by TrackMate and trackpy."""


TRAJECTORIES = (".gsd", ".xyz", ".extxyz", ".dump", ".lammpstrj")
"""Suffixes of files that give the velocities of all particles."""

MIN_TRACKS = 3
"""Particles needed for a scatter after the drift is removed and one particle is left out."""

MIN_JUDGED = 10
"""Particles needed to tell wrong identities from the distribution of the others."""

MAX_CORRECTION = 0.3
"""Largest share of T that impacts may take, or localisation may add, without a warning."""

NUM_ITERATIONS = 50
"""Iterations for T from the displacements, each of which reduces the error by 2 or more."""

CHANCE = 1e-3
"""Probability that one or more of the displacements of Maxwellian particles is left out."""

MIN_GAIN = 9.0
"""Least improvement of chi^2 by which two identities count as swapped.

With 0, 1 and 5 % of 300 identities swapped, T is then right within 2 % for particles that move up
to .3 of their mean distance between frames, in two and three dimensions.
"""

MAX_STEP = 0.3
"""Largest step, over the mean distance, at which identities are exchanged for a comparison."""

MAX_SWAPPED = 2e-3
"""Largest share of identities that count as swapped without a warning; by chance up to 0.17 %, in a
plane."""

MAX_TAIL = 10.0
"""Largest number of too long displacements, over the expected one, without a warning."""

MIN_SIGMAS = 5.0
"""Least significance of what the displacements show, the errors of which are correlated."""

ENSKOG_ERROR = 0.2
"""Relative standard error of Enskog's rate for a granular gas."""

MAX_RATE_ERROR = 0.6
"""Largest relative difference from Enskog's rate without a warning."""

MAX_SONINE = 0.05
"""Largest relative difference of T by the median and by the mean that the tails of f(v) explain."""


HEADER_TOLERANCE = 0.01
"""Largest relative difference of a number in a header from the trajectory."""


class Step(NamedTuple):
    """Displacements between two neighbouring frames.

    Attributes:
        time: the middle of the two times, s.
        duration: s.
        ids: of the particles in both frames, increasing.
        displacement: m, shape (n, d), without wrong identities.
        left_out: numbers of displacements that are longer than the distribution allows, of those
            among them that are usual but for the difference of the extreme positions, and of
            further ones, of exchanged identities.
        spread: largest difference of the extreme positions, m.
    """

    time: float
    duration: float
    ids: Int[np.ndarray, "n"]
    displacement: Float[np.ndarray, "n d"]
    left_out: tuple[int, int, int] = (0, 0, 0)
    spread: float = 0.0


def is_trajectory(path: Path) -> bool:
    """Return whether a file contains velocities of particles, by its name or its first word."""
    if Path(str(path).removesuffix(".gz")).suffix in TRAJECTORIES:
        return True
    try:
        # Not of a pipe, which can be read only once.
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(5) == b"ITEM:"
    except OSError:
        return False


def track_columns(names: list[str]) -> list[str]:
    """Return the columns of tracks that are read; further ones are ignored.

    Raises:
        ValueError: for a missing column, or two columns of one name.
    """
    chosen = [next((name for name in kind if name in names), None) for kind in (IDENTITIES, CLOCKS)]
    coordinates = [name for name in COORDINATES if name in names]
    if None in chosen or coordinates[:2] != ["x", "y"]:
        raise ValueError(
            f"the columns are {', '.join(names)}; tracks of particles have id,t,x,y and, where "
            "measured, z (or particle and frame, as trackpy names them; or TRACK_ID, "
            "POSITION_X, ..., as TrackMate does)"
        )
    columns = [*map(str, chosen), *coordinates]
    if twice := [name for name in columns if names.count(name) > 1]:
        raise ValueError(f"{names.count(twice[0])} columns are {twice[0]}: keep one")
    return columns


def curve_of_tracks(
    columns: Mapping[str, np.ndarray],
    header: dict[str, str],
    lines: list[int],
    gas: Gas | None,
) -> tuple[CoolingCurve, list[str]]:
    """Return T(t) of particles whose positions are known in frames.

    Velocities are differences over neighbouring frames, ``u = (x(t_2) - x(t_1))/(t_2 - t_1)``, of
    the particles in both frames, and belong to the middle of the two times, to second order in the
    share by which T falls meanwhile. The drift, the mean velocity of all tracked particles between
    the two frames, is removed: ``T = sum (u - <u>)^2 / (d (n - 1))`` for n particles and d
    coordinates. In a gas of N particles (header key N) without walls, whose true momentum is 0, T
    is multiplied by ``(N - 1)/N``. Two coordinates of a three-dimensional gas represent all three.

    Displacements of wrong identities are left out. They are of two kinds: displacements so long
    that fewer than `CHANCE` gases with Maxwellian velocities would show them, and displacements of
    two particles that are more probable, by `MIN_GAIN` in chi^2, if the two exchange their
    identities. T by the median of the speeds is compared with T by their mean square.

    Two biases of u^2 are removed if the header gives the necessary values. The standard error of
    one coordinate of a position, ``localisation_error``, adds ``2 error^2/(t_2 - t_1)^2`` to T; the
    jackknife error, which it widens, is not corrected. Impacts between frames bend the paths: with
    the velocity autocorrelation ``exp(-nu_v t)`` T is too small by the factor
    ``2 (exp(-x) - 1 + x)/x^2 = 1 - x/3 + ...``, ``x = nu_v (t_2 - t_1)``; nu_v is Enskog's value
    for elastic spheres, ``(2/d)`` of their collision frequency, from eta, diameter and T.

    T_err is the jackknife error over particles, which leaves out one at a time. It is the error of
    T of the gas from which these particles are a sample. Errors of neighbouring times are
    correlated, as the particles are the same.

    Args:
        columns: the columns that `track_columns` names, in SI; rows in any order. Positions
            continue when a particle leaves a periodic box, unless the header gives ``box_side``.
        header: in SI; with ``frame_rate``, frames per second, for frames without times. It is
            changed: T_from says how T was computed, and the keys of tracks are removed.
        lines: line number of each row.
        gas: a gas with the header's eta, diameter and elements, if the header gives these.

    Returns:
        The curve, and questions about its accuracy.

    Raises:
        ValueError: for fewer than 3 particles or 4 frames, a particle twice in a frame, and
            positions that are wrapped into a box.
    """
    steps = _steps(columns, header, lines)
    notes = []
    questions = []
    usable = [step for step in steps if len(step.ids) >= MIN_TRACKS]
    if len(usable) < MIN_POINTS:
        number = len(np.unique(_identities(columns)))
        raise ValueError(
            f"line {lines[-1] if lines else 1}: the file ends after tracks of {number} particle(s) "
            f"in {len(steps) + 1} frames; at least {MIN_TRACKS} particles in {MIN_POINTS + 1} "
            "frames are needed to remove the drift and estimate errors"
        )
    n = max(len(step.ids) for step in usable)
    d = usable[0].displacement.shape[1]
    factor = _momentum_correction(n, d, header, notes)
    velocities = [step.displacement / step.duration for step in usable]
    T, error = np.transpose([_temperature_and_error(velocity) for velocity in velocities])
    difference, chance = _difference_from_median(T, velocities)
    notes.append(f"{100 * difference:+.2g} % from T by the median of the speeds")
    _ask_about_identities(steps, header, notes, questions)
    if abs(np.log1p(difference)) > 3 * chance + MAX_SONINE:
        questions.append(
            f"T by the mean square of the speeds is {100 * difference:+.2g} % from T by their "
            "median: identities may be wrong, or the gas may consist of unequal parts"
        )
    T = factor * T
    error = factor * error
    rate = _fit_memory(usable, T, header, gas, notes, questions)
    duration = np.array([step.duration for step in usable])

    def note_correction(note: str, share: float, words: str, advice: str) -> None:
        percent = f"{100 * share:.2g} %"
        notes.append(f"{note}, at most {percent} of T")
        if share > MAX_CORRECTION:
            words = words.format(percent)
            questions.append(f"{words}, too much for an accurate correction: {advice}")

    if "localisation_error" in header:
        e = header_number(header, "localisation_error")
        added = 2 * (e / duration) ** 2
        if np.any(added >= T):
            k = int(np.argmax(added >= T))
            raise ValueError(
                f"between frames {k} and {k + 1} particles move no further than "
                f"localisation_error = {e:g} m; leave out this and later frames, or use frames "
                "further apart"
            )
        words = "localisation_error adds up to {} to T", "leave out the last frames"
        note_correction("localisation_error removed", np.max(added / T), *words)
        T = T - added
    else:
        notes.append("errors of positions not known (localisation_error)")
    true = T
    if rate == 0:
        notes.append("impacts between frames not corrected (the velocities show none)")
    else:
        for _ in range(NUM_ITERATIONS):
            true = T / _displacement_factor(rate * duration * np.sqrt(true))
        words = "impacts between frames take up to {} from T", "use frames closer together"
        note_correction("impacts between frames corrected", np.max(1 - T / true), *words)
    fields = {
        "times": jnp.asarray([step.time for step in usable]),
        "temperature": jnp.asarray(true),
        "temperature_error": jnp.asarray(error * true / T),
    }
    check_values(fields, place="T between frames {} and the next".format)
    curve = from_arrays(fields)
    header["T_from"] = f"T = <(u - <u>)^2>/d, u over neighbouring frames; {'; '.join(notes)}"
    for key in ("box_side", "frame_rate"):
        header.pop(key, None)
    return curve, questions


def _identities(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    return next(columns[name] for name in IDENTITIES if name in columns)


def positions_of_tracks(
    columns: Mapping[str, np.ndarray], header: dict[str, str], lines: list[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the particle, time and position of each row of tracks, sorted by time and particle.

    Raises:
        ValueError: for a particle without a number or twice in a frame, and frames without times.
    """
    ids = _identities(columns)
    coordinates = [name for name in COORDINATES if name in columns]
    if "z" in columns and np.ptp(columns["z"]) == 0:  # as TrackMate writes for pictures
        coordinates.remove("z")
    position = np.stack([columns[name] for name in coordinates], axis=1)
    if np.any(fractions := ids != np.round(ids)):
        i = int(np.argmax(fractions))
        raise ValueError(f"line {lines[i]}: id is {ids[i]:g}; number the particles")
    if "t" in columns:
        t = columns["t"]
    elif "frame_rate" in header:
        t = columns["frame"] / positive_number(header, "frame_rate")
    else:
        raise ValueError(
            "the tracks have frames without times; add '# frame_rate: ...', in frames per second, "
            "to the header (1 for T in m^2 per frame^2)"
        )
    order = np.lexsort((ids, t))
    repeated = (np.diff(t[order]) == 0) & (np.diff(ids[order]) == 0)
    if np.any(repeated):
        i, j = sorted(order[int(np.argmax(repeated)) :][:2])
        raise ValueError(
            f"line {lines[j]}: particle {ids[j]:g} at t = {t[j]:g} s is given again, after line "
            f"{lines[i]}; remove one"
        )
    return ids[order], t[order], position[order]


def _steps(
    columns: Mapping[str, np.ndarray], header: dict[str, str], lines: list[int]
) -> list[Step]:
    ids, t, position = positions_of_tracks(columns, header, lines)
    side = positive_number(header, "box_side") if "box_side" in header else np.inf
    frames = np.split(np.arange(t.size), np.flatnonzero(np.diff(t)) + 1)
    pairs = zip(frames, frames[1:], strict=False)
    return [_step(before, after, ids, t, position, side) for before, after in pairs]


def _step(
    before: np.ndarray,
    after: np.ndarray,
    ids: np.ndarray,
    t: np.ndarray,
    position: np.ndarray,
    side: float,
) -> Step:
    """Return the displacements of particles, without wrong identities.

    Args:
        before, after: rows of the two frames.
        ids, t, position: columns.
        side: of a box into which positions are wrapped, m; otherwise infinite.
    """
    shared, i, j = np.intersect1d(ids[before], ids[after], assume_unique=True, return_indices=True)
    start = position[before[i]]
    end = position[after[j]]
    lost = np.delete(position[before], i, axis=0)
    new = np.delete(position[after], j, axis=0)
    if side < np.inf:
        end = end - side * np.round((end - start) / side)
    first = float(t[before[0]])
    last = float(t[after[0]])
    step = Step((first + last) / 2, last - first, shared.astype(int), end - start)
    n, d = start.shape
    chi2 = scipy.stats.chi2
    drift = np.median(step.displacement, axis=0) if n else 0.0
    start = start + drift
    scale = np.median(np.sum((end - start) ** 2, axis=1)) / chi2.median(d) if n else 0.0
    if n < MIN_JUDGED or scale == 0:
        return step

    def chi_squared(moved: np.ndarray) -> np.ndarray:
        return np.sum(moved**2, axis=1) / scale

    moved = end - start
    own = chi_squared(moved)
    limit = chi2.isf(CHANCE / n, d)
    too_long = own > limit
    spread = np.ptp(np.concatenate([start, end]), axis=0)
    folded = too_long & (chi_squared(moved - spread * np.round(moved / spread)) < chi2.isf(0.05, d))
    wrong = too_long.copy()
    if scale**0.5 < MAX_STEP * (np.prod(spread) / n) ** (1 / d):
        reach = np.sqrt(scale * np.minimum(own, limit))
        near = scipy.spatial.KDTree(end).query_ball_point(start, reach)
        pairs = [(i, j) for i, ends in enumerate(near) for j in ends if i != j]
        i, j = np.array(pairs, int).reshape(-1, 2).T
        exchanged = chi_squared(end[j] - start[i]), chi_squared(end[i] - start[j])
        swapped = (own[i] + own[j] - sum(exchanged) > MIN_GAIN) & (np.maximum(*exchanged) < limit)
        wrong[i[swapped]] = wrong[j[swapped]] = True
        for others, here in ((lost + drift, end), (new, start)):
            if len(others):
                other = scipy.spatial.KDTree(others).query(here)[0] ** 2 / scale
                wrong |= own - other > MIN_GAIN
    return step._replace(
        ids=step.ids[~wrong],
        displacement=step.displacement[~wrong],
        left_out=(np.sum(too_long), np.sum(folded), np.sum(wrong & ~too_long)),
        spread=np.max(spread),
    )


def _ask_about_identities(
    steps: list[Step], header: dict[str, str], notes: list[str], questions: list[str]
) -> None:
    """Add a note and a question on displacements that were left out; raise if wrapped."""
    counts = [(*step.left_out, len(step.ids)) for step in steps]
    too_long, folded, swapped, kept = np.sum(counts, axis=0, dtype=int, initial=0).tolist()
    if "box_side" not in header and 2 * folded > max(too_long, 4):
        raise ValueError(
            f"{folded} displacements are as long as the box: are the positions wrapped? Give its "
            f"side, {max(step.spread for step in steps):.3g} m or slightly more, in the header as "
            "'# box_side: ...', or unwrap them"
        )
    total = too_long + swapped + kept
    if not too_long + swapped:
        return
    words = f"{too_long + swapped} of {total} displacements left out as those of wrong identities"
    notes.append(words)
    if too_long > 1 + MAX_TAIL * CHANCE * len(steps) or swapped > MAX_SWAPPED * total:
        questions.append(
            f"{words}: {too_long} are longer than the distribution of speeds allows, and {swapped} "
            "shorter if two particles exchange their identities; check the tracks"
        )


def _difference_from_median(T: np.ndarray, velocities: list[np.ndarray]) -> tuple[float, float]:
    """Return the relative difference of T from that by the median speed, and its size by chance."""
    d = velocities[0].shape[1]
    chi2 = scipy.stats.chi2
    squares = [np.sum((u - u.mean(axis=0)) ** 2, axis=1) for u in velocities]
    medians = [np.median(square) / chi2.median(d) for square in squares]
    share = float(np.mean(np.log(T / np.maximum(medians, np.finfo(float).tiny))))
    # Variances of a median and of a mean of squares of Maxwellian speeds; the latter is the least.
    of_median = 1 / (2 * chi2.median(d) * chi2.pdf(chi2.median(d), d))
    number = float(np.mean([len(u) for u in velocities]))
    return float(np.expm1(share)), float(np.sqrt((of_median**2 - 2 / d) / number))


def _temperature_and_error(velocity: Float[np.ndarray, "n d"]) -> tuple[float, float]:
    """Return the variance of a velocity component, drift removed, and its jackknife error."""
    n, d = velocity.shape
    square = np.sum((velocity - velocity.mean(axis=0)) ** 2, axis=1)
    # Without particle i the others have the mean -u_i/(n - 1), in the frame of all.
    left = (square.sum() - square * n / (n - 1)) / (d * (n - 2))
    return float(square.sum() / (d * (n - 1))), float(np.sqrt((n - 1) * np.var(left)))


def _momentum_correction(n: int, d: int, header: dict[str, str], notes: list[str]) -> float:
    """Return (N - 1)/N, or 1 if N is unknown or walls change the momentum; add notes on both."""
    dimension = header_count(header, "dimension") or 3
    if d > dimension:
        raise ValueError(
            f"a gas of dimension {dimension} has no tracks with {d} coordinates; correct the "
            "header or leave out z"
        )
    N = header_count(header, "N")
    if N is not None and n > N:
        raise ValueError(f"the header gives N = {N}, but {n} particles are tracked; correct N")
    notes.append(f"drift of {n}{'' if N is None else f' of {N}'} particles removed")
    if d < dimension:
        notes.append("two of three coordinates, for isotropic velocities")
    return 1.0 if N is None or "container_side" in header else (N - 1) / N


def _fit_memory(
    steps: list[Step],
    T: np.ndarray,
    header: dict[str, str],
    gas: Gas | None,
    notes: list[str],
    questions: list[str],
) -> float:
    """Return nu_v/sqrt(T), 1/m, from the correlations of displacements; add notes and questions.

    With the velocity autocorrelation ``exp(-nu_v t)`` and an error e of the positions

        <dx_k^2> = T f_k + 2 e^2,    <dx_k dx_l> = T h_k h_l exp(-nu_v gap) - e^2 (if they touch),

    where f and h are integrals over the intervals and gap is the time between these. Enskog's rate
    of elastic spheres, if the gas is known, has the error `ENSKOG_ERROR`. An e that the header
    lacks and that is significant is added to the header.
    """
    enskog = None
    if gas is not None:
        enskog = 2 / gas.dimension * float(gas.replace(temperature=1.0).collision_frequency)
    given = "localisation_error" in header
    e = header_number(header, "localisation_error") if given else 0.0
    if e < 0:
        raise ValueError(f"header line localisation_error: must be >= 0, got {e:g}")
    i, j, correlation, weight = _correlations(steps)
    if not (np.all(T > 0) and len(correlation)):
        return enskog or 0.0
    time, duration = np.transpose([(step.time, step.duration) for step in steps])
    D = T * duration**2
    unit = float(np.median(D))
    gap = np.maximum(time[j] - time[i] - (duration[j] + duration[i]) / 2, 0.0)
    touch = gap < 1e-6 * duration[i]
    prior = None if enskog is None else enskog * unit**0.5

    def residuals(parameters: np.ndarray) -> np.ndarray:
        rate, square = [*parameters, e**2 / unit][:2]
        moved = np.maximum(D / unit - 2 * square, 1e-3)
        x = rate * np.sqrt(moved)
        for _ in range(NUM_ITERATIONS):
            x = rate * np.sqrt(moved / _displacement_factor(x))
        h = np.sqrt(moved / _displacement_factor(x)) * scipy.special.exprel(-x)
        decay = np.exp(-gap * np.sqrt(x[i] / duration[i] * x[j] / duration[j]))
        model = unit * (h[i] * h[j] * decay - square * touch) / np.sqrt(D[i] * D[j])
        known = [] if prior is None else [(rate / prior - 1) / ENSKOG_ERROR]
        return np.concatenate([weight * (correlation - model), known])

    def fit(start: list[float]) -> tuple[np.ndarray, np.ndarray]:
        bounds = [0.0] * len(start), [max(20.0, 2 * start[0]), 0.49][: len(start)]
        found = scipy.optimize.least_squares(residuals, start, bounds=bounds)
        return found.x, np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))

    start = [prior or 0.1]
    found, error = fit(start)
    if not given:
        both, errors = fit([*start, 0.05])
        if both[1] > MIN_SIGMAS * errors[1]:
            found = both
            error = errors
            e = float(np.sqrt(both[1] * unit))
            header["localisation_error"] = repr(e)
            notes.append(f"localisation_error not given, and estimated as {e:.2g} m")
            questions.append(f"{notes[-1]}; measure it and add it to the header")
    if prior is None and found[0] < MIN_SIGMAS * error[0]:
        return 0.0
    if prior is not None and abs(found[0] / prior - 1) > MAX_RATE_ERROR:
        questions.append(
            f"velocities change {found[0] / prior:.2g} times as fast as impacts at this eta and "
            "diameter change them: check these and the tracks"
        )
    return found[0] / unit**0.5


def _correlations(steps: list[Step]) -> tuple[np.ndarray, ...]:
    """Return correlations of the displacements of two steps, their indices and 1/error."""
    rows = []
    for lag in (1, 2):
        for k, (one, two) in enumerate(zip(steps, steps[lag:], strict=False)):
            _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
            a, b = (x - x.mean(axis=0) for x in (one.displacement[i], two.displacement[j]))
            if len(i) >= MIN_TRACKS:
                correlation = np.sum(a * b) / np.sqrt(np.sum(a**2) * np.sum(b**2))
                rows.append((k, k + lag, correlation, np.sqrt(a.size)))
    first, second, correlation, weight = np.array(rows).reshape(-1, 4).T
    return first.astype(int), second.astype(int), correlation, weight


def _displacement_factor(x: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    """Return ``2 (exp(-x) - 1 + x)/x^2``, T from displacements over x relaxation times, over T."""
    small = x < 1e-3
    safe = np.where(small, 1.0, x)
    return np.where(small, 1 - x / 3, 2 * (np.expm1(-safe) + safe) / safe**2)


def curve_of_trajectory(
    path: Path, header: Mapping[str, str]
) -> tuple[CoolingCurve, dict[str, str]]:
    """Return T(t) of the frames of a file of particles.

    ``T = sum (v - <v>)^2 / (d N)`` in periodic boxes, and ``<v^2>/d`` between walls, which are at
    rest. With angular velocities w and a diameter ``T_rot = q sigma^2 <w^2>/(4 d_rot)``, where q is
    the header key reduced_inertia, by default 0.4. The standard errors are for N independent
    particles.

    Args:
        path: of a GSD, extended XYZ or LAMMPS file: see `jaxgran.read_particles`.
        header: in SI; with timestep, s, for files that count time steps, or frame_rate, 1/s, for
            files without times, and reduced_inertia and diameter for T_rot, unless the file gives
            the diameter.

    Returns:
        The curve, and the header with N, the dimension of disks and, as far as the file gives them,
        diameter, density and eta.

    Raises:
        ValueError: for a file or frame that `jaxgran.read_particles` refuses, and for frames
            without times.
    """
    header = dict(header)
    rows: list[dict[str, float]] = []
    for k, read in enumerate(open_frames(path)):
        try:
            frame = read(header_count(header, "dimension"))
            _add_to_header(header, frame)
            rows.append({"times": _time(k, frame, header), **_quantities(frame, header)})
        except ValueError as error:
            raise ValueError(f"frame {k}: {error}") from None
    if not rows:
        raise ValueError("it has no frames")
    fields = {name: jnp.asarray([row[name] for row in rows if name in row]) for name in rows[0]}
    check_values(fields, place="frame {}".format)
    curve = from_arrays(fields)
    if curve.times[0] == 0:
        header.setdefault("T0", repr(rows[0]["temperature"]))
    header["T_from"] = "T = <v^2>/d of the particles of each frame, in the frame at rest"
    return curve, {key: x for key, x in header.items() if key not in ("timestep", "frame_rate")}


def _add_to_header(header: dict[str, str], frame: Frame) -> None:
    """Add what a frame says of the gas; raise ValueError if the header contradicts it."""
    N, d = frame.position.shape
    equal = frame.equal
    from_file: dict[str, float] = {"N": N, "dimension": d}
    if "diameter" in equal or "radius" in equal:
        sigma = float(equal["diameter"][0] if "diameter" in equal else 2 * equal["radius"][0])
        if sigma != GSD_DEFAULT:
            from_file["diameter"] = sigma
            if "density" in equal:
                from_file["density"] = float(equal["density"][0])
            elif "mass" in equal:
                from_file["density"] = float(equal["mass"][0] / sphere_mass(sigma, 1.0))
            if frame.periodic:
                volume = float(np.prod(frame.sides))
                from_file["eta"] = N * (pi / 6 if d == 3 else pi / 4) * sigma**d / volume
    for key, value in from_file.items():
        tolerance = 0.0 if key in ("N", "dimension") else HEADER_TOLERANCE
        if abs(header_number(header, key) - value if key in header else 0.0) > tolerance * value:
            raise ValueError(f"{key} is {value:g}, but {header[key]} in the header or before")
        header.setdefault(key, repr(value))


def _time(k: int, frame: Frame, header: dict[str, str]) -> float:
    """Return the time of frame k, s."""
    if frame.time is not None:
        return frame.time
    if frame.step is not None and "timestep" in header:
        return frame.step * positive_number(header, "timestep")
    if "frame_rate" in header:
        return k / positive_number(header, "frame_rate")
    raise ValueError(
        "it has no time: write times into the file (LAMMPS: dump_modify ... time yes; XYZ: "
        "Time=...), or give header={'timestep': ...}, in s, or {'frame_rate': ...}, in 1/s"
    )


def _quantities(frame: Frame, header: dict[str, str]) -> dict[str, float]:
    """Return T and T_rot of a frame, and their errors, by the names of the fields of a curve."""
    velocity = frame.velocity
    if frame.periodic and "container_side" not in header:
        velocity = velocity - velocity.mean(axis=0)
    energies = {"temperature": np.mean(velocity**2, axis=1)}
    if frame.spin is not None and "diameter" in header:
        inertia = header_number({"reduced_inertia": "0.4"} | header, "reduced_inertia")
        square = inertia * header_number(header, "diameter") ** 2 / 4
        energies["rotational_temperature"] = square * np.mean(frame.spin**2, axis=1)
    values = {name: float(np.mean(each)) for name, each in energies.items()}
    scatter = {name: float(np.std(each, ddof=1)) for name, each in energies.items()}
    return values | {f"{name}_error": x / len(velocity) ** 0.5 for name, x in scatter.items()}
