"""Fits of tracks on the command line, with the single impacts in them."""

import json

import numpy as np
import pytest

import jaxgran
from jaxgran.data.header import gas_of_header
from tests.data.test_tracks import text_of

HEADER = {"eta": 0.03, "diameter": 2e-3, "density": 2500, "Y": 5e7, "nu": 0.22, "T0": 0.01}
TRUE_A = 3e-6
FRAME_TIME = 2e-3
ERROR = 1e-5
"""Localisation error, m."""


def next_impact(r, g, diameter):
    """The pair that touches next, and when, of pairs with separations r and velocities g."""
    product = np.sum(r * g, axis=1)
    square = np.sum(g**2, axis=1)
    discriminant = product**2 - square * (np.sum(r**2, axis=1) - diameter**2)
    meets = (product < 0) & (discriminant > 0)
    until = np.full(len(r), np.inf)
    until[meets] = (-product[meets] - np.sqrt(discriminant[meets])) / square[meets]
    pair = np.argmin(until)
    return pair, until[pair]


def film(gas, number, num_frames, seed):
    """Positions of hard spheres in frames, one impact after the other, and the side of their box.

    They start at the sites of a cubic lattice.
    """
    rng = np.random.default_rng(seed)
    side = float(gas.box_side(number))
    diameter = float(gas.diameter)
    sites = int(np.ceil(number ** (1 / 3)))
    x = side / sites * np.argwhere(np.ones((sites, sites, sites)))[:number]
    v = float(gas.temperature) ** 0.5 * rng.standard_normal((number, 3))
    v -= v.mean(axis=0)
    i, j = np.triu_indices(number, 1)
    frames = [x]
    for _ in range(num_frames - 1):
        left = FRAME_TIME
        while left > 0:
            r = x[i] - x[j]
            r -= side * np.round(r / side)
            g = v[i] - v[j]
            pair, until = next_impact(r, g, diameter)
            step = min(until, left)
            x = x + v * step
            left -= step
            if until == step:
                normal = (r[pair] + g[pair] * step) / diameter
                speed = -normal @ g[pair]
                change = (1 + float(gas.restitution(speed))) / 2 * speed * normal
                v[i[pair]] += change
                v[j[pair]] -= change
        frames.append(x)
    return np.array(frames), side


@pytest.fixture
def tracks(scene):
    """A file of tracks of 100 spheres in 41 frames.

    T(t) then has as many points as the curves of `measured`, whose compiled programs fit it.
    """
    gas, _ = gas_of_header({key: str(x) for key, x in (HEADER | {"A": TRUE_A}).items()})
    positions, side = film(gas, 100, 41, seed=0)
    positions = positions + ERROR * np.random.default_rng(1).standard_normal(positions.shape)
    times = FRAME_TIME * np.arange(len(positions))
    known = {"N": 100, "box_side": side, "localisation_error": ERROR}
    (scene / "tracks.csv").write_text(text_of(times, positions, **HEADER | known))
    return scene / "tracks.csv"


@pytest.mark.slow
def test_tracks_and_their_impacts_are_fitted_together(tracks, run):
    found = jaxgran.read_impacts(tracks)
    number = found.counts["used"]
    assert number > 30
    status, out, _ = run("fit", "tracks.csv", "--impacts", "--quick", "--out", "fitted")
    assert status == 0
    assert "curve    tracks: 40 points" in out
    assert f"drops    tracks impacts: {number} impacts" in out
    assert f"tracks: {number} used, {found.counts['few frames']} few frames" in out
    answer = json.loads(out.splitlines()[-1])
    # A is within 3 standard errors, and these are less than 10 %.
    assert abs(answer["A"] / TRUE_A - 1) < 3 * answer["A_std_err"] / TRUE_A < 0.1
    curve, _ = jaxgran.read_curve(tracks)
    assert answer["tracks: T0"] == pytest.approx(float(curve.temperature[0]), rel=0.1)
    assert answer["agree"]
    record = json.loads((tracks.parent / "fitted" / "tracks-kinetic-theory.json").read_text())
    weights = {label: weight[0] for label, weight in record["weight"].items()}
    assert weights.keys() == {"tracks", "tracks impacts"} and min(weights.values()) > 0
    assert sum(weights.values()) == pytest.approx(1.0)


def test_impacts_without_tracks_are_refused(measured, run):
    status, _, err = run("fit", "--drop-test", "alone.csv", "--impacts", "--out", "fitted")
    assert status == 2 and "--impacts" in err and "tracks" in err
