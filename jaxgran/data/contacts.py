"""Contacts of two spheres, or of a sphere with a wall, by the straight lines of their flights.

The lines before an encounter give the time of contact, the normal and the speed of approach; the
lines after it give the speed of separation. All errors follow from the localisation error.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxgran.data.encounters import Encounters
from jaxgran.data.flights import TINY, Flights, LinePairs
from jaxgran.data.motion import Motion

MARGIN = 1.5
"""Standard errors by which spheres must overlap, or a sphere approach a wall, to count as touching.
False impacts are then .2 % of all."""

MISSED = 3.0
"""Standard errors by which spheres must pass each other to count as having missed."""

BENT_LEVEL = 1e-4
"""Probability by chance below which positions are not on a straight line."""

THROUGH_LEVEL = 0.05
"""Probability by chance above which positions before and after an encounter are on one line."""

Numbers = Float[np.ndarray, "n"]
Vectors = Float[np.ndarray, "n d"]
Flags = Bool[np.ndarray, "n"]
"""One number, vector or truth value for each encounter."""


class NormalSpeeds(NamedTuple):
    """Speeds along the normal before and after contacts, and the covariance of their errors.

    Attributes:
        before: v_n, of approach, m/s.
        after: v_n', of separation, m/s.
        variance: of v_n, m^2/s^2.
        variance_after: of v_n', m^2/s^2.
        covariance: of v_n and v_n', m^2/s^2.
    """

    before: Numbers
    after: Numbers
    variance: Numbers
    variance_after: Numbers
    covariance: Numbers


class Contacts(NamedTuple):
    """Contacts to which the flights of encounters lead.

    Attributes:
        time: of the contact, by the lines before and after it, s.
        time_error: standard error of this time, s.
        speeds: along the normal.
        touches: whether the lines before touch by `MARGIN` errors, near the closest frame.
        passes: whether the encounter changed no velocity: the lines before miss each other by
            `MISSED` errors, or do not surely touch and go straight on.
        count_before: frames of the shorter one of the flights before.
        count: frames of the shortest one of the flights before and after.
        is_straight: whether these flights are straight.
    """

    time: Numbers
    time_error: Numbers
    speeds: NormalSpeeds
    touches: Flags
    passes: Flags
    count_before: Numbers
    count: Numbers
    is_straight: Flags


def find_contacts(
    motion: Motion, encounters: Encounters, flights: Flights, diameter: float, error: float
) -> Contacts:
    """Return the contacts to which the flights of encounters lead.

    Args:
        motion: motion of the spheres.
        encounters: encounters of two spheres, or of spheres with walls.
        flights: flights before and after these.
        diameter: diameter of the spheres, m.
        error: localisation error, m.
    """
    before, after, through, start = flights.with_walls(encounters.is_wall)
    r = before.separation_at(start) - encounters.shift
    g = before.velocity
    elapsed = _time_of_touching(r, g, encounters, diameter)
    arrival = start + elapsed
    normal = _normal_at_contact(r + g * elapsed[:, None], encounters)
    curvature = np.where(encounters.is_wall, 0.0, 1 / diameter)
    speeds = _normal_speeds(before, after, arrival, normal, curvature, error)

    r_after = after.separation_at(arrival) - encounters.shift
    delay = _time_of_parting(r_after, after.velocity, encounters, diameter)
    place_error = error * np.sqrt(before.variance_at(arrival))
    place_error_after = error * np.sqrt(after.variance_at(arrival))
    # At a lower speed a sphere moves less than the error in the whole film, which counts as rest.
    slowest = error / motion.duration
    arrival_error = _time_error(place_error, speeds.before, speeds.variance, slowest)
    parting_error = _time_error(place_error_after, speeds.after, speeds.variance_after, slowest)
    time, time_error = _mean_time(arrival, delay, arrival_error, parting_error)

    gap = _impact_parameter(r, g) - diameter
    touches, misses = _touch_or_miss(gap, place_error, speeds, encounters.is_wall)
    tolerance = (encounters.half_width + 1) * motion.frame_time
    touches = touches & (np.abs(arrival - encounters.time) <= tolerance)
    flies_on = through.are_straight(error, THROUGH_LEVEL)
    return Contacts(
        time=time,
        time_error=time_error,
        speeds=speeds,
        touches=touches,
        passes=misses | (~touches & flies_on),
        count_before=before.count,
        count=np.minimum(before.count, after.count),
        is_straight=before.are_straight(error, BENT_LEVEL) & after.are_straight(error, BENT_LEVEL),
    )


def _dot(a: Vectors, b: Vectors) -> Numbers:
    """Return scalar products."""
    return np.sum(a * b, axis=1)


def _squared(a: Vectors) -> Numbers:
    """Return squared lengths."""
    return _dot(a, a)


# Before the contact, and after it, the separation of partners is r + g t.


def _time_of_closest_approach(r: Vectors, g: Vectors) -> Numbers:
    """Return when partners are nearest to each other, s."""
    return -_dot(r, g) / np.maximum(_squared(g), TINY)


def _impact_parameter(r: Vectors, g: Vectors) -> Numbers:
    """Return the distance of closest approach, m."""
    closest = r + g * _time_of_closest_approach(r, g)[:, None]
    return np.linalg.norm(closest, axis=1)


def _time_of_overlap(r: Vectors, g: Vectors, diameter: float) -> Numbers:
    """Return how long spheres would overlap if they flew through each other, s; 0 if they miss."""
    depth = np.maximum(diameter**2 - _impact_parameter(r, g) ** 2, 0.0)
    return 2 * np.sqrt(depth / np.maximum(_squared(g), TINY))


def _time_at_wall(r: Vectors, g: Vectors, normal: Vectors) -> Numbers:
    """Return when spheres are at the wall, s; 0 if they fly along it."""
    rise = _dot(g, normal)
    return -_dot(r, normal) / np.where(rise != 0, rise, np.inf)


def _time_of_touching(r: Vectors, g: Vectors, encounters: Encounters, diameter: float) -> Numbers:
    """Return when spheres that approach each other, or a wall, begin to touch, s."""
    of_spheres = _time_of_closest_approach(r, g) - _time_of_overlap(r, g, diameter) / 2
    return np.where(encounters.is_wall, _time_at_wall(r, g, encounters.normal), of_spheres)


def _time_of_parting(r: Vectors, g: Vectors, encounters: Encounters, diameter: float) -> Numbers:
    """Return when spheres that leave each other, or a wall, cease to touch, s."""
    of_spheres = _time_of_closest_approach(r, g) + _time_of_overlap(r, g, diameter) / 2
    return np.where(encounters.is_wall, _time_at_wall(r, g, encounters.normal), of_spheres)


def _normal_at_contact(r: Vectors, encounters: Encounters) -> Vectors:
    """Return unit vectors from the second partner to the first one, at the separation r."""
    length = np.maximum(np.linalg.norm(r, axis=1), TINY)
    of_spheres = r / length[:, None]
    return np.where(encounters.is_wall[:, None], encounters.normal, of_spheres)


def _normal_speeds(
    before: LinePairs,
    after: LinePairs,
    arrival: Numbers,
    normal: Vectors,
    curvature: Numbers,
    error: float,
) -> NormalSpeeds:
    """Return v_n = -g.n and v_n' = g'.n, with the covariance of their errors.

    Each line before the contact has two independent errors, of its mean position and of its
    velocity. The error of the separation at contact, which turns the normal, is the former plus the
    latter times the delay since the mean time. v_n' also has the errors of the velocities after the
    contact. (Errors of the second partner have the other sign, and equal squares.)

    Args:
        before: lines of both partners before the contact.
        after: lines after it.
        arrival: time of contact, s.
        normal: unit vector at contact.
        curvature: 1/diameter for spheres, 1/m; 0 for walls.
        error: localisation error, m.
    """
    g = before.velocity
    g_after = after.velocity
    slope = -_slope_by_separation(g, g, normal, curvature)
    slope_after = _slope_by_separation(g_after, g, normal, curvature)
    variance = np.zeros_like(arrival)
    variance_after = np.zeros_like(arrival)
    covariance = np.zeros_like(arrival)
    for line, line_after in zip(before, after, strict=True):
        of_mean = line.variance_of_mean
        of_velocity = line.variance_of_velocity
        delay = (arrival - line.time)[:, None]
        # derivatives of v_n and v_n' by the velocity of the line
        change = slope * delay - normal
        change_after = slope_after * delay
        variance += of_mean * _squared(slope) + of_velocity * _squared(change)
        variance_after += of_mean * _squared(slope_after) + of_velocity * _squared(change_after)
        variance_after += line_after.variance_of_velocity
        covariance += of_mean * _dot(slope, slope_after)
        covariance += of_velocity * _dot(change, change_after)
    return NormalSpeeds(
        before=-_dot(g, normal),
        after=_dot(g_after, normal),
        variance=error**2 * variance,
        variance_after=error**2 * variance_after,
        covariance=error**2 * covariance,
    )


def _slope_by_separation(u: Vectors, g: Vectors, normal: Vectors, curvature: Numbers) -> Vectors:
    """Return the derivative of u.n by the separation r at a given time before contact, 1/s.

    A change dr delays the contact by dr.n/v_n, with v_n = -g.n, so that the separation at contact
    changes by dr + g dr.n/v_n, perpendicular to n, and n by this over the diameter. The normal of a
    wall, whose curvature is 0, stays.

    Args:
        u: vectors that do not depend on r, m/s.
        g: relative velocities before contact, m/s.
        normal: n.
        curvature: 1/diameter, 1/m; 0 for walls.
    """
    speed = -_dot(g, normal)
    along_normal = _dot(u, g) * (1 / np.where(speed == 0, np.inf, speed))
    return curvature[:, None] * (u + normal * along_normal[:, None])


def _time_error(place_error: Numbers, speed: Numbers, variance: Numbers, slowest: float) -> Numbers:
    """Return the error of a time of contact, s.

    Args:
        place_error: error of the separation, m.
        speed: speed along the normal, m/s.
        variance: variance of this speed, m^2/s^2.
        slowest: smallest speed that counts, m/s.
    """
    return place_error / np.maximum(speed, np.sqrt(variance) + slowest)


def _mean_time(
    arrival: Numbers, delay: Numbers, arrival_error: Numbers, parting_error: Numbers
) -> tuple[Numbers, Numbers]:
    """Return the weighted mean of the times of contact by the flights before and after it.

    Where both differ by `MISSED` errors, as with another impact between, the former counts alone.

    Args:
        arrival: time by the flights before, s.
        delay: time by the flights after, less this one, s.
        arrival_error, parting_error: errors of both, s.

    Returns:
        The mean and its error, s.
    """
    weight = arrival_error**2 / (arrival_error**2 + parting_error**2 + TINY)
    agrees = np.abs(delay) < MISSED * np.hypot(arrival_error, parting_error)
    share = np.where(agrees, weight, 0.0)
    return arrival + share * delay, arrival_error * np.sqrt(1 - share)


def _touch_or_miss(
    gap: Numbers, gap_error: Numbers, speeds: NormalSpeeds, is_wall: Flags
) -> tuple[Flags, Flags]:
    """Return whether partners surely touch, and whether they surely miss each other.

    Args:
        gap: impact parameter less the diameter, m.
        gap_error: its error, m.
        speeds: speeds along the normal; a wall is reached by whatever approaches it.
        is_wall: whether the partner is a wall.
    """
    approaches = speeds.before > MARGIN * np.sqrt(speeds.variance)
    touches = np.where(is_wall, approaches, gap < -MARGIN * gap_error)
    misses = ~is_wall & (gap > MISSED * gap_error)
    return touches & (speeds.before > 0), misses
