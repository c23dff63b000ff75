"""Single impacts from tracks of particles: speeds before and after, with their errors.

Between impacts a particle moves in a straight line. Lines through the positions before and after an
encounter tell whether, when and how fast two spheres meet. The modules `encounters`, `flights` and
`contacts` are the three steps, each for all encounters at once.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxgran._utils.formatting import text_table
from jaxgran.data import files
from jaxgran.data.contacts import Contacts, find_contacts
from jaxgran.data.curve_file import CSV_FILE
from jaxgran.data.drop_test import MAX_SIGMAS, SPHERE, WALL, DropTest
from jaxgran.data.encounters import Encounters, find_encounters
from jaxgran.data.flights import MIN_FRAMES, Breaks, error_by_scatter, flights_between
from jaxgran.data.header import checked_header, gas_of_header
from jaxgran.data.header_lines import header_in_si
from jaxgran.data.header_values import header_number
from jaxgran.data.measurement import Measurement
from jaxgran.data.measurement_header import priors_of_header
from jaxgran.data.motion import Motion, error_by_second_differences
from jaxgran.data.tables import read_table
from jaxgran.data.track_positions import IDENTITIES, track_columns
from jaxgran.data.trajectory_curve import is_trajectory
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import MATERIAL, PARAMETERS

MIN_TIMED = 2
"""Fewest frames of a flight that gives the time of an impact."""

TIME_ERRORS = 2.0
"""Frames nearer to an impact than this many errors of its time belong to no flight."""

NUM_PASSES = 3
"""Number of times that flights are divided anew, at the contacts found before."""


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
        header: header of the file, in SI.
        gas: gas that it describes.

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
    before it pass at less than a diameter, by 1.5 standard errors. The lines touch at the time
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
        if is_trajectory(path) or path.suffix == ".npz":
            raise ValueError(
                "impacts are read from CSV files of tracks (id,t,x,y,z), frame by frame; a file of "
                "velocities at few times does not show them"
            )
        table = read_table(path, "id,t,x,y,z", track_columns, given, IDENTITIES)
        entries = header_in_si(table.header)
        gas, questions = gas_of_header(entries)
        impacts = impacts_of_tracks(table.columns, entries, table.lines, gas)
    for question in questions:
        warnings.warn(f"{path}: {question}", stacklevel=2)
    return impacts


def impacts_of_tracks(
    columns: Mapping[str, np.ndarray], header: dict[str, str], lines: list[int], gas: Gas
) -> Impacts:
    """Return the impacts that positions in frames show: see `read_impacts`.

    Args:
        columns: columns of `track_positions.track_columns`, in SI; rows in any order.
        header: header of the file, in SI.
        lines: line number of each row, for errors.
        gas: gas with the diameter of the spheres and, if there are walls, a container.
    """
    motion = Motion.from_columns(columns, header, lines)
    _check_motion(motion, gas)
    diameter = float(gas.diameter)
    given = _given_error(header)
    error = error_by_second_differences(motion) if given is None else given
    encounters = find_encounters(motion, gas, error)
    every = np.ones(encounters.time.size, bool)
    breaks = Breaks(encounters.time, encounters.half_width, ends_others=every)
    flights = flights_between(motion, encounters.first, encounters.second, breaks)
    contacts = find_contacts(motion, encounters, flights, diameter, error)
    for _ in range(NUM_PASSES):
        breaks = _breaks_at_contacts(encounters, contacts, motion.frame_time)
        flights = flights_between(motion, encounters.first, encounters.second, breaks)
        if given is None:
            error = error_by_scatter(flights.before) or error
        contacts = find_contacts(motion, encounters, flights, diameter, error)
    return _chosen_impacts(encounters, contacts, error, header, gas)


def _check_motion(motion: Motion, gas: Gas) -> None:
    """Raise ValueError for tracks that cannot show impacts."""
    d = motion.num_coordinates
    if d < gas.dimension:
        raise ValueError(
            f"the tracks have {d} coordinates of a gas of dimension {gas.dimension}: in a "
            "projection neither the normal of an impact nor its speed along it can be known. Film "
            "all three coordinates, or give `dimension: 2` for spheres that move in a plane"
        )
    if motion.num_frames < 2 * MIN_FRAMES:
        raise ValueError(
            f"the tracks have {motion.num_frames} frames; impacts need {MIN_FRAMES} before and "
            f"{MIN_FRAMES} after each"
        )


def _given_error(header: dict[str, str]) -> float | None:
    """Return the localisation error of a header, m; None without one."""
    if "localisation_error" not in header:
        return None
    error = header_number(header, "localisation_error")
    if not error > 0:
        raise ValueError(
            f"localisation_error must be > 0 m, got {error:g}. Leave it out, and it is estimated "
            "from the tracks"
        )
    return error


def _breaks_at_contacts(encounters: Encounters, contacts: Contacts, frame_time: float) -> Breaks:
    """Return the breaks of flights at contacts, or at closest frames where no contact is known."""
    is_known = (contacts.count_before >= MIN_TIMED) & contacts.is_straight
    is_timed = is_known & contacts.touches
    frames_off = TIME_ERRORS * contacts.time_error / frame_time
    narrower = np.minimum(frames_off, encounters.half_width)
    passes = is_known & contacts.passes & (contacts.count_before >= MIN_FRAMES)
    return Breaks(
        time=np.where(is_timed, contacts.time, encounters.time),
        half_width=np.where(is_timed, narrower, encounters.half_width),
        ends_others=~passes,
    )


def _chosen_impacts(
    encounters: Encounters, contacts: Contacts, error: float, header: dict[str, str], gas: Gas
) -> Impacts:
    """Return the impacts among encounters, and why others are left out."""
    is_used, counts = _used_and_counts(contacts)
    of_spheres = is_used & ~encounters.is_wall
    of_walls = is_used & encounters.is_wall
    if not np.any(is_used):
        reasons = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise ValueError(
            f"the tracks show no impact with {MIN_FRAMES} frames before and after it ({reasons}): "
            "film at a higher rate, and check diameter and length_unit"
        )
    places = (
        encounters.first[of_spheres],
        encounters.second[of_spheres],
        contacts.time[of_spheres],
    )
    spheres = _drop_test(contacts, of_spheres, SPHERE)
    walls = _drop_test(contacts, of_walls, WALL)
    return Impacts(spheres, walls, counts, places, error, header, gas)


def _used_and_counts(contacts: Contacts) -> tuple[Bool[np.ndarray, "n"], dict[str, int]]:
    """Return which encounters are used, and how many these are and are left out for each reason."""
    eps, error = _restitution(contacts)
    passes = {
        "few frames": contacts.count >= MIN_FRAMES,
        "bent": contacts.is_straight,
        "grazing": contacts.touches,
        "impossible": (eps > -MAX_SIGMAS * error) & (eps < 1 + MAX_SIGMAS * error),
    }
    is_used = np.ones(eps.size, bool)
    left_out = {}
    for reason, passed in passes.items():
        left_out[reason] = int(np.sum(is_used & ~passed))
        is_used &= passed
    return is_used, {"used": int(np.sum(is_used))} | left_out


def _restitution(contacts: Contacts) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return eps = v_n'/v_n and its standard error."""
    v = contacts.speeds
    before = np.where(v.before > 0, v.before, 1.0)
    eps = v.after / before
    variance = v.variance_after + eps**2 * v.variance - 2 * eps * v.covariance
    return eps, np.sqrt(variance) / before


def _drop_test(contacts: Contacts, chosen: Bool[np.ndarray, "n"], onto: str) -> DropTest | None:
    """Return some of the contacts as a drop test; None without any."""
    if not np.any(chosen):
        return None
    before, after, variance, variance_after, covariance = (x[chosen] for x in contacts.speeds)
    speed_error = np.sqrt(variance)
    error_after = np.sqrt(variance_after)
    product = error_after * speed_error
    return DropTest(
        speed=before,
        restitution=after / before,
        error=error_after / before,
        onto=onto,
        speed_error=speed_error,
        correlation=np.clip(covariance / np.where(product > 0, product, 1.0), -1.0, 1.0),
        scatters=True,
    )
