"""T(t) of particles whose positions are known in frames."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy  # which imports scipy.stats at its first use
from jaxtyping import Float

from jaxgran.data.curve import MIN_POINTS, CoolingCurve, from_arrays
from jaxgran.data.curve_checks import check_values
from jaxgran.data.displacements import CHANCE, MIN_TRACKS, Step, steps_of_tracks
from jaxgran.data.header_values import header_count, header_dimension, header_number
from jaxgran.data.track_positions import identities_of
from jaxgran.data.velocity_memory import Memory, fit_memory, free_flight_squares
from jaxgran.scene.gas import Gas

MAX_CORRECTION = 0.3
"""Largest share of T that impacts may take, or localisation may add, without a warning."""

MAX_SWAPPED = 2e-3
"""Largest share of identities that count as swapped without a warning; by chance up to 0.17 %, in a
plane."""

MAX_TAIL = 10.0
"""Largest number of too long displacements, over the expected one, without a warning."""

MAX_RATE_ERROR = 0.6
"""Largest relative difference from Enskog's rate without a warning."""

MAX_SONINE = 0.05
"""Largest relative difference of T by the median and by the mean that the tails of f(v) explain."""


class TrackedCurve(NamedTuple):
    """A curve from the positions of particles.

    Attributes:
        curve: T(t).
        header: of the file, without the keys of frames; T_from says how T was computed, and
            localisation_error what it was taken for.
        questions: about the accuracy of the curve.
    """

    curve: CoolingCurve
    header: dict[str, str]
    questions: list[str]


class _Remarks(NamedTuple):
    """What is said about a curve while it is computed: notes in T_from, and questions."""

    notes: list[str]
    questions: list[str]


def curve_of_tracks(
    columns: Mapping[str, np.ndarray],
    header: dict[str, str],
    lines: list[int],
    gas: Gas | None,
) -> TrackedCurve:
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
        header: in SI; with ``frame_rate``, frames per second, for frames without times.
        lines: line number of each row.
        gas: a gas with the header's eta, diameter and elements, if the header gives these.

    Returns:
        The curve, its header and questions about its accuracy.

    Raises:
        ValueError: for fewer than 3 particles or 4 frames, a particle twice in a frame, and
            positions that are wrapped into a box.
    """
    steps = steps_of_tracks(columns, header, lines)
    usable = [step for step in steps if len(step.ids) >= MIN_TRACKS]
    if len(usable) < MIN_POINTS:
        number = len(np.unique(identities_of(columns)))
        raise ValueError(
            f"line {lines[-1] if lines else 1}: the file ends after tracks of {number} particle(s) "
            f"in {len(steps) + 1} frames; at least {MIN_TRACKS} particles in {MIN_POINTS + 1} "
            "frames are needed to remove the drift and estimate errors"
        )
    remarks = _Remarks([], [])
    factor = _momentum_correction(usable, header, remarks)
    velocities = [step.displacement / step.duration for step in usable]
    T, error = np.transpose([_temperature_and_error(velocity) for velocity in velocities])
    _check_identities(steps, T, velocities, header, remarks)
    T = factor * T
    error = factor * error
    localisation_error = _given_localisation_error(header)
    memory = _memory(usable, T, gas, localisation_error, remarks)
    if memory.localisation_error is not None:
        localisation_error = memory.localisation_error
        header = header | {"localisation_error": repr(localisation_error)}
    duration = np.array([step.duration for step in usable])
    T = _without_localisation_error(T, duration, localisation_error, remarks)
    true = _without_impacts(T, duration, memory.rate, remarks)
    fields = {
        "times": jnp.asarray([step.time for step in usable]),
        "temperature": jnp.asarray(true),
        "temperature_error": jnp.asarray(error * true / T),
    }
    check_values(fields, place="T between frames {} and the next".format)
    header = {key: x for key, x in header.items() if key not in ("box_side", "frame_rate")}
    how = "; ".join(remarks.notes)
    header["T_from"] = f"T = <(u - <u>)^2>/d, u over neighbouring frames; {how}"
    return TrackedCurve(from_arrays(fields), header, remarks.questions)


def _momentum_correction(steps: list[Step], header: dict[str, str], remarks: _Remarks) -> float:
    """Return (N - 1)/N, or 1 if N is unknown or walls change the momentum."""
    n = max(len(step.ids) for step in steps)
    d = steps[0].displacement.shape[1]
    dimension = header_dimension(header)
    if d > dimension:
        raise ValueError(
            f"a gas of dimension {dimension} has no tracks with {d} coordinates; correct the "
            "header or leave out z"
        )
    N = header_count(header, "N")
    if N is not None and n > N:
        raise ValueError(f"the header gives N = {N}, but {n} particles are tracked; correct N")
    remarks.notes.append(f"drift of {n}{'' if N is None else f' of {N}'} particles removed")
    if d < dimension:
        remarks.notes.append("two of three coordinates, for isotropic velocities")
    return 1.0 if N is None or "container_side" in header else (N - 1) / N


def _temperature_and_error(velocity: Float[np.ndarray, "n d"]) -> tuple[float, float]:
    """Return the variance of a velocity component, drift removed, and its jackknife error."""
    n, d = velocity.shape
    square = np.sum((velocity - velocity.mean(axis=0)) ** 2, axis=1)
    # Without particle i the others have the mean -u_i/(n - 1), in the frame of all.
    left = (square.sum() - square * n / (n - 1)) / (d * (n - 2))
    return float(square.sum() / (d * (n - 1))), float(np.sqrt((n - 1) * np.var(left)))


def _check_identities(
    steps: list[Step],
    T: Float[np.ndarray, "steps"],
    velocities: list[np.ndarray],
    header: dict[str, str],
    remarks: _Remarks,
) -> None:
    """Add remarks on wrong identities; raise ValueError if positions are wrapped into a box."""
    difference, chance = _difference_from_median(T, velocities)
    percent = 100 * difference
    remarks.notes.append(f"{percent:+.2g} % from T by the median of the speeds")
    _check_left_out(steps, header, remarks)
    if abs(np.log1p(difference)) > 3 * chance + MAX_SONINE:
        remarks.questions.append(
            f"T by the mean square of the speeds is {percent:+.2g} % from T by their median: "
            "identities may be wrong, or the gas may consist of unequal parts"
        )


def _check_left_out(steps: list[Step], header: dict[str, str], remarks: _Remarks) -> None:
    too_long = sum(step.left_out.too_long for step in steps)
    folded = sum(step.left_out.folded for step in steps)
    exchanged = sum(step.left_out.exchanged for step in steps)
    if "box_side" not in header and 2 * folded > max(too_long, 4):
        raise ValueError(
            f"{folded} displacements are as long as the box: are the positions wrapped? Give its "
            f"side, {max(step.spread for step in steps):.3g} m or slightly more, in the header as "
            "'# box_side: ...', or unwrap them"
        )
    number = too_long + exchanged
    total = number + sum(len(step.ids) for step in steps)
    if not number:
        return
    left_out = f"{number} of {total} displacements left out because of wrong identities"
    remarks.notes.append(left_out)
    if too_long > 1 + MAX_TAIL * CHANCE * len(steps) or exchanged > MAX_SWAPPED * total:
        remarks.questions.append(
            f"{left_out}: {too_long} are longer than the distribution of speeds allows, and "
            f"{exchanged} shorter if two particles exchange their identities; check the tracks"
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


def _given_localisation_error(header: dict[str, str]) -> float | None:
    """Return the standard error of one coordinate of a position, m; None if it is not given."""
    if "localisation_error" not in header:
        return None
    error = header_number(header, "localisation_error")
    if error < 0:
        raise ValueError(f"header line localisation_error: must be >= 0, got {error:g}")
    return error


def _memory(
    steps: list[Step],
    T: Float[np.ndarray, "steps"],
    gas: Gas | None,
    localisation_error: float | None,
    remarks: _Remarks,
) -> Memory:
    """Return how fast the velocities are forgotten, after a comparison with Enskog's theory."""
    enskog = None
    if gas is not None:
        enskog = 2 / gas.dimension * float(gas.replace(temperature=1.0).collision_frequency)
    memory = fit_memory(steps, T, enskog, localisation_error)
    estimated = memory.localisation_error
    if estimated is not None:
        note = f"localisation_error not given, and estimated as {estimated:.2g} m"
        remarks.notes.append(note)
        remarks.questions.append(f"{note}; measure it and add it to the header")
    if memory.rate_ratio is not None and abs(memory.rate_ratio - 1) > MAX_RATE_ERROR:
        remarks.questions.append(
            f"velocities change {memory.rate_ratio:.2g} times as fast as impacts at this eta and "
            "diameter change them: check these and the tracks"
        )
    return memory


def _without_localisation_error(
    T: Float[np.ndarray, "steps"],
    duration: Float[np.ndarray, "steps"],
    error: float | None,
    remarks: _Remarks,
) -> Float[np.ndarray, "steps"]:
    """Return T less what errors of the positions add to it."""
    if error is None:
        remarks.notes.append("errors of positions not known (localisation_error)")
        return T
    added = 2 * (error / duration) ** 2
    if np.any(added >= T):
        k = int(np.argmax(added >= T))
        raise ValueError(
            f"between frames {k} and {k + 1} particles move no further than "
            f"localisation_error = {error:g} m; leave out this and later frames, or use frames "
            "further apart"
        )
    share = float(np.max(added / T))
    remarks.notes.append(f"localisation_error removed, at most {100 * share:.2g} % of T")
    if share > MAX_CORRECTION:
        remarks.questions.append(
            f"localisation_error adds up to {100 * share:.2g} % to T, too much for an accurate "
            "correction: leave out the last frames"
        )
    return T - added


def _without_impacts(
    T: Float[np.ndarray, "steps"],
    duration: Float[np.ndarray, "steps"],
    rate: float,
    remarks: _Remarks,
) -> Float[np.ndarray, "steps"]:
    """Return T as it would be if impacts between frames did not bend the paths.

    Args:
        T: by the displacements, m^2/s^2.
        duration: of the steps, s.
        rate: see `Memory`.
        remarks: to which a note is added.
    """
    if rate == 0:
        remarks.notes.append("impacts between frames not corrected (the velocities show none)")
        return T
    true = free_flight_squares(T, rate * duration)
    share = float(np.max(1 - T / true))
    remarks.notes.append(f"impacts between frames corrected, at most {100 * share:.2g} % of T")
    if share > MAX_CORRECTION:
        remarks.questions.append(
            f"impacts between frames take up to {100 * share:.2g} % from T, too much for an "
            "accurate correction: use frames closer together"
        )
    return true
