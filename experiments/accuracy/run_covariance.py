"""Does T of one run scatter as `jaxgran.KineticTheory.covariance` says?

    python experiments/accuracy/run_covariance.py [--only PART ...] [--runs 400] [--store]
        [--record] [--smoke] [--out DIR]

Runs of N grains differ in their random start alone. Their logarithms of T (and of T_rot) less the
mean over the runs are whitened with the covariance of kinetic theory: divided by its Cholesky
factor, they are independent and of variance 1 at all times if it is right. A row has the mean of
this variance over the times, the lowest and the highest, the correlation of neighbouring times, the
mean and the standard deviation of chi^2, and how far the mean of theory is from that of the runs,
which is a matter of its own.

- dsmc: direct simulation, whose collisions have no memory; impacts on walls are left to hard
  spheres;
- hard_spheres: the same scenes, and walls;
- density: hard spheres of higher density, in boxes shorter than L_c;
- flow: hard spheres in boxes about as long as L_c, in which a flow grows;
- soft_spheres: contacts of 2 to 10 % of the mean free time, which hold energy.

Runs are kept in DIR and used again. --store writes their means and covariances to
``experiments/data/run_statistics.npz``, which tests read. There, "independent" runs are of an
event-driven code that shares nothing with this package.
"""

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxgran
from experiments.support.record import DATA, Options, run_parts
from experiments.support.scenes import beads as beads_with_contacts
from experiments.support.scenes import cool

THEORY = jaxgran.KineticTheory(corrections=jaxgran.KineticTheory.all_corrections - {"softness"})
ENSKOG = jaxgran.KineticTheory(
    corrections=jaxgran.KineticTheory.all_corrections - {"softness", "correlations"}
)
SOFT_THEORY = jaxgran.KineticTheory()
STORED = DATA / "run_statistics.npz"
DEPTH = 3.5
"""Largest ln(T_0/T) of gases that cool."""

NUM_TIMES = 36
"""Number of times, at equal steps of ln T."""


def beads(law: Any = None, packing_fraction: float = 0.03, dimension: int = 3, **elements: Any):
    """Return 3 mm beads, viscoelastic without a law or with a constant restitution."""
    if law is None:
        law = jaxgran.Viscoelastic(6e10, 0.24, 2.5e-7)
    elif not isinstance(law, jaxgran.extend.RestitutionLaw):
        law = jaxgran.ConstantRestitution(law)
    return jaxgran.Gas(
        law,
        diameter=3e-3,
        mass=jaxgran.sphere_mass(3e-3, 2600.0),
        packing_fraction=packing_fraction,
        temperature=0.02,
        dimension=dimension,
        **elements,
    )


def between_walls(packing_fraction: float, side: float, restitution: float) -> jaxgran.Gas:
    walls = jaxgran.Walls(side, restitution=restitution)
    return beads(packing_fraction=packing_fraction, container=walls)


def with_drag() -> jaxgran.Gas:
    gas = beads()
    return dataclasses.replace(gas, drag=jaxgran.StokesDrag(0.02 * gas.collision_frequency))


def driven() -> jaxgran.Gas:
    """Return a gas that white noise heats to twice its temperature."""
    gas = beads()
    hot = gas.replace(temperature=2 * gas.temperature)
    strength = THEORY.cooling_rate(hot) * hot.temperature
    return dataclasses.replace(gas, drive=jaxgran.WhiteNoise(strength))


class Scene(NamedTuple):
    """A gas of N grains; `make` returns it."""

    make: Callable[[], jaxgran.Gas]
    num_particles: int = 250

    @property
    def times(self) -> np.ndarray:
        """Times of the runs, s, without t = 0."""
        gas = self.make()
        tau = float(gas.mean_free_time)
        if gas.drive is not None:
            return tau * np.linspace(1.5, 30.0, 20)
        t = tau * np.concatenate([[0.0], np.geomspace(0.05, 1e3, 2000)])
        cooled = -np.log(np.asarray(cool(gas, t, THEORY).temperature / gas.temperature))
        return np.interp(np.linspace(0.0, DEPTH, NUM_TIMES + 1)[1:], cooled, t)


SPINNING = {"rotational_temperature": 0.012}
SMOOTH = {
    "smooth": Scene(beads),
    "constant": Scene(lambda: beads(0.8)),
    "disks": Scene(lambda: beads(packing_fraction=0.05, dimension=2)),
    "constant disks": Scene(lambda: beads(0.8, 0.05, 2)),
}
ROUGH = {
    "rough": Scene(lambda: beads(surface=jaxgran.Rough(0.2, **SPINNING))),
    "sliding": Scene(lambda: beads(surface=jaxgran.Rough(0.2, friction=0.2, **SPINNING))),
    "rough disks": Scene(
        lambda: beads(None, 0.05, 2, surface=jaxgran.Rough(0.2, inertia=0.5, **SPINNING))
    ),
}
OTHERS = {"drag": Scene(with_drag), "driven": Scene(driven)}
WALLS = {
    "walls .75": Scene(lambda: between_walls(0.03, 0.049022303, 0.75)),
    "walls .9": Scene(lambda: between_walls(0.05, 0.032373616, 0.9), 120),
    "walls .8": Scene(lambda: between_walls(0.02, 0.089079437, 0.8), 1000),
}
DENSE = {
    "phi .1": Scene(lambda: beads(packing_fraction=0.1)),
    "phi .25": Scene(lambda: beads(packing_fraction=0.25)),
    "phi .4": Scene(lambda: beads(packing_fraction=0.4)),
}
FLOWING = {
    "phi .25, .8 L_c": Scene(lambda: beads(0.8, 0.25)),
    "phi .25, 1.3 L_c": Scene(lambda: beads(0.8, 0.25), 1030),
}
SOFT = {
    "t_c .02": Scene(lambda: beads_with_contacts(0.25, 0.3, 0.02)),
    "t_c .05": Scene(lambda: beads_with_contacts(0.05, 0.1, 0.05)),
    "t_c .1": Scene(lambda: beads_with_contacts(0.1, 0.5, 0.1)),
    "t_c .05, disks": Scene(lambda: beads_with_contacts(0.1, 0.2, 0.05, 2)),
}
"""The number is t_c/tau_c."""

ALL = SMOOTH | ROUGH | OTHERS | WALLS | DENSE | FLOWING | SOFT


class Runs(NamedTuple):
    """ln T of some runs, and ln T_rot if the spheres are rough, shape (runs, times)."""

    log_T: np.ndarray
    log_T_rot: np.ndarray | None = None

    @property
    def joint(self) -> np.ndarray:
        parts = [x for x in self if x is not None]
        return np.concatenate(parts, axis=1)


def simulated(scene: Scene, times: np.ndarray, kind: str, runs: int) -> Runs:
    """Return runs of one kind of particles."""
    gas, n = scene.make(), scene.num_particles
    models = {
        "dsmc": jaxgran.DSMC(n, runs),
        "hard spheres": jaxgran.HardSpheres(n, replicas=runs),
        "soft spheres": jaxgran.SoftSpheres(n, replicas=runs),
    }
    model = models[kind]
    curve = jaxgran.cool(gas, times, model=model, key=jax.random.key(7), progress=False)
    each = [curve.replicas.temperature, curve.replicas.rotational_temperature]
    return Runs(*(None if x is None else np.log(np.asarray(x)) for x in each))


def kept(scene: Scene, name: str, kind: str, options: Options) -> Runs:
    """Return the runs of a scene in the folder of the results, which are made if missing."""
    path = options.out / f"{kind} {name} {options.runs}.npz"
    times = scene.times
    if path.exists():
        with np.load(path) as stored:
            if np.allclose(stored["times"], times, rtol=1e-5):
                return Runs(*(stored[field] for field in Runs._fields if field in stored))
    runs = simulated(scene, times, kind, options.runs)
    path.parent.mkdir(parents=True, exist_ok=True)
    known = {field: x for field, x in runs._asdict().items() if x is not None}
    np.savez(path, times=times, **known)
    return runs


def theory_of(kind: str) -> jaxgran.KineticTheory:
    """Return theory of one kind of runs: DSMC has no correlated velocities, hard spheres have no
    contacts."""
    return {"dsmc": ENSKOG, "soft spheres": SOFT_THEORY}.get(kind, THEORY)


def whitened(each: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the deviations from the mean over the runs, white and of variance 1 if all is right.

    The covariance of the deviations from the mean over R runs is (R - 1)/R of one run's.
    """
    deviation = (each - each.mean(axis=0)) * np.sqrt(len(each) / (len(each) - 1))
    return np.linalg.solve(np.linalg.cholesky(covariance), deviation.T).T


def scatter_of(white: np.ndarray) -> dict[str, Any]:
    """Return what whitened deviations tell, shape (runs, times)."""
    runs, num = white.shape
    variance, chi_square = np.mean(white**2, axis=0), np.sum(white**2, axis=1)
    error = np.sqrt(2 / runs)
    return {
        "variance": variance.mean(),
        "variance_error": error / np.sqrt(num),
        "lowest": variance.min(),
        "highest": variance.max(),
        "scatter_of_points": np.sqrt(np.mean((variance - 1) ** 2)) / error,
        "neighbours": np.mean(white[:, 1:] * white[:, :-1]),
        "neighbours_error": 1 / np.sqrt(runs * num),
        "chi_square": chi_square.mean(),
        "chi_square_deviation": chi_square.std(ddof=1),
        "points": num,
    }


def row_of(scene: Scene, name: str, kind: str, runs: Runs) -> dict[str, Any]:
    """Compare the runs of a scene with theory."""
    gas, times, num = scene.make(), scene.times, runs.log_T.shape[1]
    rotation = runs.log_T_rot is not None
    theory = theory_of(kind)
    covariance = np.asarray(theory.covariance(gas, times, scene.num_particles, rotation=rotation))
    quarters = np.arange(1, 5) * num // 4 - 1
    offset = runs.log_T.mean(axis=0) - np.log(np.asarray(cool(gas, times, theory).temperature))
    row = {"scene": name, "model": kind, "num_particles": scene.num_particles}
    row |= {"runs": len(runs.log_T)}
    row |= {"box": float(gas.box_side(scene.num_particles) / gas.critical_box)}
    row |= {"T": scatter_of(whitened(runs.log_T, covariance[:num, :num]))}
    row["T"] |= {
        "offset": offset[quarters],
        "offset_error": (runs.log_T.std(axis=0, ddof=1) / np.sqrt(len(runs.log_T)))[quarters],
    }
    if rotation:
        row["T_rot"] = scatter_of(whitened(runs.log_T_rot, covariance[num:, num:]))
        row["both"] = scatter_of(whitened(runs.joint, covariance))
    return row


def parameters_of(gas: jaxgran.Gas) -> dict[str, list]:
    return {name: np.asarray(x).tolist() for name, x in gas.parameters.items()}


def store(statistics: dict[str, dict[str, Any]]) -> None:
    """Write or replace the statistics of runs in `STORED`, by the name of kind and scene."""
    arrays = dict(np.load(STORED)) if STORED.exists() else {}
    for name, values in statistics.items():
        arrays |= {f"{name}/{field}": np.asarray(x) for field, x in values.items()}
    np.savez_compressed(STORED, **arrays)


FIELDS = "gas", "num_particles", "runs", "times", "mean", "covariance"
"""What `STORED` keeps of each scene: see `statistics_of`."""


def statistics_of(scene: Scene, times: np.ndarray, runs: Runs) -> dict[str, Any]:
    """Return what `STORED` keeps of a scene."""
    joint = runs.joint
    covariance = np.cov(joint, rowvar=False)
    lower = covariance[np.tril_indices(len(covariance))].astype(np.float32)
    parameters = json.dumps(parameters_of(scene.make()))
    mean = joint.mean(axis=0).astype(np.float32)
    values = parameters, scene.num_particles, len(joint), times, mean, lower
    return dict(zip(FIELDS, values, strict=True))


def rows_of(scenes: dict[str, Scene], kind: str, options: Options) -> Iterator[dict]:
    if options.smoke:
        scenes, options.runs = dict(list(scenes.items())[:1]), 20
    for name, scene in scenes.items():
        runs = kept(scene, name, kind, options)
        if options.store:
            store({f"{kind}/{name}": statistics_of(scene, scene.times, runs)})
        yield row_of(scene, name, kind, runs)


def dsmc(options: Options) -> Iterator[dict]:
    return rows_of(SMOOTH | ROUGH | OTHERS, "dsmc", options)


def hard_spheres(options: Options) -> Iterator[dict]:
    return rows_of(SMOOTH | ROUGH | OTHERS | WALLS, "hard spheres", options)


def density(options: Options) -> Iterator[dict]:
    return rows_of(DENSE, "hard spheres", options)


def flow(options: Options) -> Iterator[dict]:
    return rows_of(FLOWING, "hard spheres", options)


def soft_spheres(options: Options) -> Iterator[dict]:
    return rows_of(SOFT, "soft spheres", options)


def independent(folder: Path) -> None:
    """Store the statistics of the runs of an independent code in a folder."""
    files = {"smooth": "smooth", "rough": "rough", "walls .75": "walls_75"}
    files |= {"walls .9": "walls_90", "walls .8": "walls_80"}
    for name, file in files.items():
        with np.load(folder / f"{file}.npz") as runs:
            rotation = np.log(runs["T_rot"][:, 1:]) if "T_rot" in runs else None
            found = Runs(np.log(runs["T"][:, 1:]), rotation)
            store({f"independent/{name}": statistics_of(ALL[name], runs["t"][1:], found)})


if __name__ == "__main__":
    options = {"runs": 400, "store": False}
    parts = dsmc, hard_spheres, density, flow, soft_spheres
    run_parts(__doc__, *parts, prefix="run_covariance_", **options)
