"""Positions of tracked particles in frames, from the columns of a file."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Num

from jaxgran.data.header_values import positive_number

COORDINATES = ("x", "y", "z")
IDENTITIES = ("track_id", "id", "particle")
CLOCKS = ("t", "frame")
"""Names of columns of tracks, in order of preference; some are used by TrackMate and trackpy."""


class Positions(NamedTuple):
    """Positions of particles, one row for each particle in each frame.

    Attributes:
        ids: numbers of the particles.
        time: s.
        position: m.
    """

    ids: Num[np.ndarray, "rows"]
    time: Float[np.ndarray, "rows"]
    position: Float[np.ndarray, "rows d"]

    def frames(self) -> list["Positions"]:
        """Return the rows of each frame, for rows that are sorted by time."""
        ends = np.flatnonzero(np.diff(self.time)) + 1
        parts = (np.split(column, ends) for column in self)
        return [Positions(*rows) for rows in zip(*parts, strict=True)]


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


def positions_of_tracks(
    columns: Mapping[str, np.ndarray], header: dict[str, str], lines: list[int]
) -> Positions:
    """Return the rows of tracks, sorted by time and particle.

    Args:
        columns: columns of `track_columns`, in SI; rows in any order.
        header: in SI; with ``frame_rate``, frames per second, for frames without times.
        lines: line number of each row, for errors.

    Raises:
        ValueError: for a particle without a number or twice in a frame, and frames without times.
    """
    ids = identities_of(columns)
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
    return Positions(ids[order], t[order], position[order])


def identities_of(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the column of tracks that identifies the particles."""
    return next(columns[name] for name in IDENTITIES if name in columns)
