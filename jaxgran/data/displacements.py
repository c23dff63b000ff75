"""Displacements of tracked particles between neighbouring frames, without wrong identities."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy  # which imports scipy.stats at its first use
from jaxtyping import Bool, Float, Int

from jaxgran.data.header_values import positive_number
from jaxgran.data.track_positions import Positions, positions_of_tracks

MIN_TRACKS = 3
"""Particles needed for a scatter after the drift is removed and one particle is left out."""

MIN_JUDGED = 10
"""Particles needed to tell wrong identities from the distribution of the others."""

CHANCE = 1e-3
"""Probability that one or more of the displacements of Maxwellian particles is left out."""

MIN_GAIN = 9.0
"""Least improvement of chi^2 by which two identities count as swapped.

With 0, 1 and 5 % of 300 identities swapped, T is then right within 2 % for particles that move up
to .3 of their mean distance between frames, in two and three dimensions.
"""

MAX_STEP = 0.3
"""Largest step, over the mean distance, at which identities are exchanged for a comparison."""


class LeftOut(NamedTuple):
    """Numbers of displacements that belong to wrong identities.

    Attributes:
        too_long: longer than the distribution of speeds allows.
        folded: those among them that are usual but for the difference of the extreme positions.
        exchanged: further ones, more probable if two particles exchange their identities.
    """

    too_long: int = 0
    folded: int = 0
    exchanged: int = 0


class Step(NamedTuple):
    """Displacements between two neighbouring frames.

    Attributes:
        time: the middle of the two times, s.
        duration: s.
        ids: of the particles in both frames, increasing.
        displacement: m, shape (n, d), without wrong identities.
        left_out: numbers of displacements that were left out.
        spread: largest difference of the extreme positions, m.
    """

    time: float
    duration: float
    ids: Int[np.ndarray, "n"]
    displacement: Float[np.ndarray, "n d"]
    left_out: LeftOut = LeftOut()
    spread: float = 0.0


def steps_of_tracks(
    columns: Mapping[str, np.ndarray], header: dict[str, str], lines: list[int]
) -> list[Step]:
    """Return the displacements between all neighbouring frames of tracks.

    Args:
        columns: columns of `track_columns`, in SI.
        header: in SI; with ``box_side`` if positions are wrapped into a box.
        lines: line number of each row, for errors.
    """
    positions = positions_of_tracks(columns, header, lines)
    side = positive_number(header, "box_side") if "box_side" in header else np.inf
    frames = positions.frames()
    return [_step(before, after, side) for before, after in zip(frames, frames[1:], strict=False)]


def _step(before: Positions, after: Positions, side: float) -> Step:
    """Return the displacements of the particles in two frames, without wrong identities."""
    shared, i, j = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    start = before.position[i]
    end = after.position[j]
    if side < np.inf:
        end = end - side * np.round((end - start) / side)
    first = float(before.time[0])
    last = float(after.time[0])
    step = Step((first + last) / 2, last - first, shared.astype(int), end - start)
    n, d = start.shape
    drift = np.median(step.displacement, axis=0) if n else 0.0
    start = start + drift
    chi2 = scipy.stats.chi2
    scale = np.median(np.sum((end - start) ** 2, axis=1)) / chi2.median(d) if n else 0.0
    if n < MIN_JUDGED or scale == 0:
        return step
    moved = end - start
    own = _squared(moved) / scale
    limit = chi2.isf(CHANCE / n, d)
    too_long = own > limit
    spread = np.ptp(np.concatenate([start, end]), axis=0)
    by_images = _squared(moved - spread * np.round(moved / spread)) / scale
    folded = too_long & (by_images < chi2.isf(0.05, d))
    wrong = too_long.copy()
    if scale**0.5 < MAX_STEP * (np.prod(spread) / n) ** (1 / d):
        lost = np.delete(before.position, i, axis=0)
        new = np.delete(after.position, j, axis=0)
        wrong |= _is_exchanged(start, end, scale, limit)
        wrong |= _is_nearer(lost + drift, end, own, scale)
        wrong |= _is_nearer(new, start, own, scale)
    return step._replace(
        ids=step.ids[~wrong],
        displacement=step.displacement[~wrong],
        left_out=LeftOut(
            too_long=int(np.sum(too_long)),
            folded=int(np.sum(folded)),
            exchanged=int(np.sum(wrong & ~too_long)),
        ),
        spread=np.max(spread),
    )


def _squared(vectors: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
    return np.sum(vectors**2, axis=1)


def _is_exchanged(
    start: Float[np.ndarray, "n d"], end: Float[np.ndarray, "n d"], scale: float, limit: float
) -> Bool[np.ndarray, "n"]:
    """Return which of the particles move more probably if two exchange their identities.

    Args:
        start: positions in the first frame, drift added, m.
        end: positions in the second frame, m.
        scale: variance of one coordinate of a displacement, m^2.
        limit: largest chi^2 of a right identity.
    """
    own = _squared(end - start) / scale
    reach = np.sqrt(scale * np.minimum(own, limit))
    near = scipy.spatial.KDTree(end).query_ball_point(start, reach)
    pairs = [(i, j) for i, ends in enumerate(near) for j in ends if i != j]
    i, j = np.array(pairs, int).reshape(-1, 2).T
    forth = _squared(end[j] - start[i]) / scale
    back = _squared(end[i] - start[j]) / scale
    is_better = own[i] + own[j] - (forth + back) > MIN_GAIN
    swapped = is_better & (np.maximum(forth, back) < limit)
    exchanged = np.zeros(len(own), bool)
    exchanged[i[swapped]] = True
    exchanged[j[swapped]] = True
    return exchanged


def _is_nearer(
    others: Float[np.ndarray, "m d"],
    here: Float[np.ndarray, "n d"],
    own: Float[np.ndarray, "n"],
    scale: float,
) -> Bool[np.ndarray, "n"]:
    """Return which particles move more probably from or to a particle in one frame alone.

    Args:
        others: positions of particles that are in one of the two frames, m.
        here: positions of the particles in both frames, in the other one, m.
        own: chi^2 of their displacements.
        scale: variance of one coordinate of a displacement, m^2.
    """
    if not len(others):
        return np.zeros(len(own), bool)
    other = scipy.spatial.KDTree(others).query(here)[0] ** 2 / scale
    return own - other > MIN_GAIN
