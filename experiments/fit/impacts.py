"""What do single impacts add to T(t): coverage of oblique impacts, and impacts from tracks.

    python experiments/fit/impacts.py [--only oblique tracks walls] [--runs 20] [--out DIR]

- oblique: 20 impacts at angles of 10 to 80 degrees, eps and eps_t with errors of .02, of a law with
  A = 3e-6 s, beta_t = .5 and mu = .2. Finds how often the error bars (95 %) hold each of the three.
- tracks: 250 hard spheres, filmed with 500 frames a second for .8 s, positions with errors of .02
  of a diameter. Finds the share of the impacts with four free frames on both sides that is found,
  the share of false ones, the bias of eps, and A with roughness untold: by impacts alone, by T(t)
  alone, and by both, in the explanation that the data prefer. Spheres are smooth, rough (beta_t =
  -.3), or slide (beta_t = .5, mu = .2).
- walls: the row "rough between rough walls, beta_t free" of `wrong_physics`, with 20 oblique
  impacts, half of them on the wall.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

import jaxgran
from experiments.fit import wrong_physics
from experiments.fit.wrong_physics import NORMAL, NUM_PARTICLES, TRUE_A, beads
from experiments.support.analysis import fit_quietly
from experiments.support.record import Options, collected, each_alone, figures, run_parts
from experiments.support.scenes import cool
from jaxgran.data.track_impacts import impacts_of_tracks
from jaxgran.data.tracks import curve_of_tracks

RATE = 500.0
"""Frames per second."""

ERROR = 0.02
"""Localisation error over the diameter, and error of eps and eps_t of oblique impacts."""

A, BETA, FRICTION = "dissipative_constant", "tangential_restitution", "friction"
SURFACES = {
    "smooth": {},
    "rough": wrong_physics.ROUGH,
    "sliding": wrong_physics.SLIDING,
}


def oblique_impacts(
    gas: jaxgran.Gas, number: int, seed: int, onto: str = "sphere"
) -> jaxgran.DropTest:
    """Return impacts at random angles and speeds, with their errors."""
    rng = np.random.default_rng(seed)
    speed = np.exp(rng.uniform(np.log(0.05), np.log(0.5), number))
    sideways = speed * np.tan(np.radians(rng.uniform(10, 80, number)))
    error = np.full(number, ERROR)
    test = jaxgran.DropTest(
        speed,
        np.full(number, 0.9),
        error,
        onto,
        tangential_speed=sideways,
        tangential_restitution=np.full(number, 0.1),
        tangential_error=error,
    )
    eps = np.asarray(test.computed(gas))
    eps_t = np.asarray(test.computed_tangential(gas))
    return dataclasses.replace(
        test,
        restitution=eps + ERROR * rng.standard_normal(number),
        tangential_restitution=eps_t + ERROR * rng.standard_normal(number),
    )


def oblique(options: Options) -> dict[str, Any]:
    """Fit A, beta_t and mu to 20 oblique impacts, in 5 times as many runs as asked for."""
    gas = beads(**wrong_physics.SLIDING)
    guess = gas.replace(dissipative_constant=1e-6, tangential_restitution=0.0, friction=0.9)
    names = (A, BETA, FRICTION)
    true = np.array([float(gas.value(name)) for name in names])
    off = []
    for seed in range(5 * options.runs):
        measured = jaxgran.Measurement(guess, oblique_impacts(gas, 20, seed))
        result = fit_quietly(measured, free=names, quick=True)
        off.append((result.estimate - true) / result.standard_error)
    held = np.sum(np.abs(off) < NORMAL, axis=0)
    return {"runs": len(off), "held": dict(zip(names, held.tolist(), strict=True))}


class Film(NamedTuple):
    """Spheres in frames.

    Attributes:
        gas: their scene.
        times: of the frames, s.
        position, velocity: m and m/s, shape (frames, N, 3).
        side: of the periodic box, m; infinite between walls.
    """

    gas: jaxgran.Gas
    times: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    side: float


def film(gas: jaxgran.Gas, frames: int, seed: int, number: int = NUM_PARTICLES) -> Film:
    """Simulate hard spheres, and return them in frames."""
    times = np.arange(frames) / RATE
    saved = cool(gas, times, jaxgran.HardSpheres(number), seed, save="particles").saved
    side = float(gas.box_side(number)) if gas.container is None else np.inf
    position, velocity = (np.asarray(x)[:, 0] for x in (saved.position, saved.velocity))
    return Film(gas, times, position, velocity, side)


def with_errors(film: Film, error: float, seed: int) -> np.ndarray:
    """Return the positions with errors, m."""
    rng = np.random.default_rng(seed)
    return film.position + error * rng.standard_normal(film.position.shape)


def columns_of(film: Film, error: float, seed: int) -> dict[str, np.ndarray]:
    """Return the positions with errors as the columns of a file."""
    x, y, z = with_errors(film, error, seed).reshape(-1, 3).T
    frames, number, _ = film.position.shape
    ids = np.tile(np.arange(1.0, number + 1), frames)
    return {"id": ids, "t": np.repeat(film.times, number), "x": x, "y": y, "z": z}


def header_of(film: Film, error: float) -> dict[str, str]:
    """Return what the header of a file says of the frames."""
    header = {"localisation_error": repr(error), "N": str(film.position.shape[1])}
    return header if film.side == np.inf else header | {"box_side": repr(film.side)}


def found_impacts(film: Film, gas: jaxgran.Gas, error: float, seed: int) -> jaxgran.Impacts:
    """Return the impacts that the positions show, for a gas as a fit knows it."""
    columns = columns_of(film, error, seed)
    header = header_of(film, error)
    lines = list(range(columns["t"].size))
    return impacts_of_tracks(columns, header, lines, gas)


def joint_fit(
    film: Film, error: float, seed: int, free: tuple[str, ...] = (), **surface: Any
) -> jaxgran.Fit:
    """Fit A to T(t) and the impacts of the same tracks, with a scene of smooth spheres."""
    gas = dataclasses.replace(film.gas, **{"surface": None} | surface)
    impacts = found_impacts(film, gas, error, seed)
    measured = curve_measurement(film, gas, error, seed)
    data = {"curve": measured, "impacts": jaxgran.Measurement(gas, impacts.spheres)}
    return fit_quietly(data, free=(A, *free), separate=("temperature",))


def curve_measurement(film: Film, gas: jaxgran.Gas, error: float, seed: int) -> jaxgran.Measurement:
    """Return T(t) of the positions, at every tenth frame interval."""
    columns = columns_of(film, error, seed)
    header = header_of(film, error)
    curve = curve_of_tracks(columns, header, list(range(columns["t"].size)), gas).curve
    few = slice(None, None, 10)
    thinned = jaxgran.CoolingCurve(
        curve.times[few], curve.temperature[few], temperature_error=curve.temperature_error[few]
    )
    return jaxgran.Measurement(gas, thinned, num_particles=film.position.shape[1])


def true_impacts(film: Film) -> list[tuple[int, int, int]]:
    """Return impacts of two spheres that meet no third one between two frames: frame and both."""
    change = np.diff(film.velocity, axis=0)
    found = []
    for frame, of_frame in enumerate(change):
        struck = np.flatnonzero(np.max(np.abs(of_frame), axis=1) > 1e-9)
        sums = np.abs(of_frame[struck][:, None] + of_frame[struck]).max(axis=-1)
        for i, j in zip(*np.nonzero(np.triu(sums < 1e-9, 1)), strict=True):
            found.append((frame, int(struck[i]), int(struck[j])))
    return found


def judged(film: Film, impacts: jaxgran.Impacts) -> dict[str, float]:
    """Return the shares of impacts that were found and that are false, and the bias of eps.

    The bias is the difference of eps from the law that equally fits the impacts of known speeds.
    """
    struck = np.zeros(film.position.shape[:2], bool)
    struck[:-1] = np.max(np.abs(np.diff(film.velocity, axis=0)), axis=-1) > 1e-9
    true = true_impacts(film)
    frames = film.times.size

    def has_four_frames(frame: int, i: int) -> bool:
        before = np.flatnonzero(struck[:frame, i])
        after = np.flatnonzero(struck[frame + 1 :, i])
        since = frame - (before[-1] if before.size else -1)
        until = after[0] + 1 if after.size else frames - 1 - frame
        return min(since, until) >= 4

    wanted = {x for x in true if has_four_frames(x[0], x[1]) and has_four_frames(x[0], x[2])}
    known: dict[tuple[int, int], list[int]] = {}
    for frame, i, j in true:
        known.setdefault((i, j), []).append(frame)
    hits = set()
    false = 0
    first, second, time = impacts.places
    for i, j, t in zip(first.tolist(), second.tolist(), time.tolist(), strict=True):
        at = t * RATE
        pair = min(i, j), max(i, j)
        near = [frame for frame in known.get(pair, []) if abs(frame + 0.5 - at) < 2]
        false += not near
        hits |= {(frame, *pair) for frame in near[:1]}
    test = impacts.spheres
    error = np.asarray(test.errors(film.gas))
    weight = error**-2 / np.sum(error**-2)
    bias = np.sum(weight * np.asarray(test.residuals(film.gas)) * error)
    return {
        "found": len(hits & wanted) / len(wanted),
        "false": false / len(time),
        "bias": float(bias),
        "bias_error": float(np.sum(error**-2) ** -0.5),
        "used": len(time),
    }


def tracks(options: Options) -> dict[str, Any]:
    """Film spheres of each surface, and fit their impacts and T(t); a process for each surface."""
    jobs = [(name, options.runs, options.frames) for name in options.surfaces]
    known = figures("impacts_tracks", {"surfaces": []})["surfaces"]
    by_name = {found["surface"]: found for found in known}
    by_name |= {found["surface"]: found for found in collected(each_alone(of_surface, jobs))}
    return {"surfaces": [by_name[name] for name in SURFACES if name in by_name]}


def of_surface(name: str, runs: int, frames: int) -> dict[str, Any]:
    """Return what the tracks of spheres of one surface show, and its statistics."""
    rows = [of_film(name, seed, frames) for seed in range(runs)]

    def within(key: str) -> int:
        return sum(abs(row[key] - 1) < 0.1 for row in rows)

    return {
        "surface": name,
        "rows": rows,
        "runs": runs,
        "found": float(np.mean([row["found"] for row in rows])),
        "false": float(np.mean([row["false"] for row in rows])),
        "bias": float(np.mean([row["bias"] for row in rows])),
        "A_of_curve": float(np.median([row["A_of_curve"] for row in rows])),
        "within_tenth": within("A_explained"),
        "within_tenth_of_impacts": within("A_of_impacts"),
        "within_tenth_with_surface_free": within("A_with_surface_free"),
        "inside": sum(row["range_of_both"][0] <= 1 <= row["range_of_both"][1] for row in rows),
    }


def of_film(name: str, seed: int, frames: int) -> dict[str, Any]:
    """Fit the impacts and T(t) of one film."""
    filmed = film(beads(**SURFACES[name]), frames, seed)
    error = ERROR * float(filmed.gas.diameter)
    smooth = dataclasses.replace(filmed.gas, surface=None)
    impacts = found_impacts(filmed, smooth, error, seed)
    alone = fit_quietly(jaxgran.Measurement(smooth, impacts.spheres))
    curve = curve_measurement(filmed, smooth, error, seed)
    untold = fit_quietly(curve, free=(A, "temperature"), quick=True)
    both = joint_fit(filmed, error, seed)
    guess = jaxgran.Rough(0.0, friction=0.3) if name == "sliding" else jaxgran.Rough(0.0)
    free = (BETA, FRICTION) if name == "sliding" else (BETA,)
    told = joint_fit(filmed, error, seed, free, surface=guess)
    low, high = (float(x[0]) / TRUE_A for x in both.ranges.get(A, ([np.nan], [np.nan])))
    preferred = [x for x in both.alternatives if x.preferred and x.restitution is None]
    explained = preferred[0].estimate if preferred else both.estimate
    return (
        {"surface": name, "seed": seed}
        | judged(filmed, impacts)
        | {
            "A_of_impacts": float(alone.estimate[0]) / TRUE_A,
            "error_of_impacts": float(alone.standard_error[0]) / TRUE_A,
            "A_of_curve": float(untold.estimate[0]) / TRUE_A,
            "A_of_both": float(both.estimate[0]) / TRUE_A,
            "A_explained": float(explained[0]) / TRUE_A,
            "explanation": preferred[0].name if preferred else "",
            "range_of_both": [low, high],
            "A_with_surface_free": float(told.estimate[0]) / TRUE_A,
        }
    )


def walls(options: Options) -> dict[str, Any]:
    """Fit "rough between rough walls, beta_t free" with and without 20 oblique impacts."""
    (row,) = (x for x in wrong_physics.ROWS if x.name == "rough between rough walls")
    times, each, rotation = wrong_physics.measured(row, options.runs)
    gas = beads(**row.gas)
    fitted = beads(**row.fitted)
    off = {"alone": [], "with impacts": []}
    for run, T in enumerate(np.asarray(each)):
        curve = jaxgran.CoolingCurve(times, T, rotational_temperature=rotation[run])
        measured = jaxgran.Measurement(fitted, curve, num_particles=NUM_PARTICLES)
        impacts = {
            onto: jaxgran.Measurement(fitted, oblique_impacts(gas, 10, 2 * run + k, onto))
            for k, onto in enumerate(("sphere", "wall"))
        }
        free = (A, BETA)
        alone = fit_quietly(
            measured, model=wrong_physics.THEORY, free=(*free, "temperature"), quick=True
        )
        both = fit_quietly(
            {"curve": measured, **impacts},
            model=wrong_physics.THEORY,
            free=free,
            separate=("temperature",),
            quick=True,
        )
        off["alone"].append(float(np.log(alone.estimate[0] / TRUE_A)))
        off["with impacts"].append(float(np.log(both.estimate[0] / TRUE_A)))
    return {
        "runs": options.runs,
        "off": {name: float(np.sqrt(np.mean(np.square(x)))) for name, x in off.items()},
        "A": {name: float(np.exp(np.median(x))) for name, x in off.items()},
    }


if __name__ == "__main__":
    run_parts(
        __doc__,
        oblique,
        tracks,
        walls,
        prefix="impacts_",
        smoke=False,
        runs=20,
        frames=400,
        surfaces=[*SURFACES],
    )
