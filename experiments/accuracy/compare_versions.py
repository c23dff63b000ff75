"""Does this version give the same numbers as another version?

    python experiments/accuracy/compare_versions.py CHECKOUT [--record] [--out DIR]

CHECKOUT is the folder of the other version (``git worktree add --detach FOLDER COMMIT``). Both
versions simulate the same ten scenes with all four models, with elements, derivatives and saved
observables, fit two curves, one by kinetic theory with its diagnosis and one by DSMC, and fit two
curves jointly. Each version runs in a separate process. Every returned array is compared. Prints
one row for each case: the number of arrays, and "identical" if all bits agree, otherwise the
largest difference relative to the largest value of that array. The exit code is 1 if a case is not
identical.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from experiments.support.record import DATA, EXPERIMENTS, Options, process, run_parts

# The scenes are written out because modules of other versions have other names.
CASES = """
import sys
from dataclasses import replace
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxgran as jg

def beads(beta=0.15, dimension=3, packing_fraction=0.05, law=None, **elements):
    gas = jg.Gas(
        jg.Viscoelastic(5e7, 0.22, 1e-6), diameter=2e-3, mass=jg.sphere_mass(2e-3, 2500.0),
        packing_fraction=packing_fraction, temperature=0.01, dimension=dimension)
    gas = gas.replace(dissipative_constant=1e-6 * beta / float(gas.thermal_beta))
    return replace(gas, **({} if law is None else {"law": law}), **elements)

def cool(gas, last, model, **options):
    times = np.linspace(0, last, 5)[1:] * float(gas.mean_free_time)
    return jg.cool(gas, times, model=model, key=jax.random.key(3), progress=False, **options)

def slope(gas, last, model):
    name = "dissipative_constant"
    curve = lambda a: cool(gas.replace(**{name: a}), last, model).temperature
    return jax.jvp(curve, (float(gas.value(name)),), (1.0,))

rough = jg.Rough(0.5, rotational_temperature=0.002)
drag, noise = jg.StokesDrag(0.5), jg.WhiteNoise(1e-2)
side = beads().box_side(200)
walls = jg.Walls(side, restitution=0.9)
series = jg.RestitutionSeries([-0.1, -0.02], [0.2, 0.4])
grains = jg.Frictional(20.0, 0.3)
soft_walls = jg.Walls(side, restitution=jg.Viscoelastic(5e7, 0.22, 1e-6))


def flow(particles):
    return jg.observables.flow_share(particles.position, particles.velocity, particles.box_side)

def fitted():
    curve, header = jg.read_curve(sys.argv[1])
    gas = jg.read_gas(header)
    result = jg.fit(gas, curve, free=("dissipative_constant", "temperature"))
    return result, jg.diagnose(result, curve)

def fitted_by_particles():
    gas = beads()
    curve = cool(gas, 20.0, jg.DSMC(2000, replicas=2))
    start = gas.replace(dissipative_constant=1.2 * gas.value("dissipative_constant"))
    model = jg.DSMC(1000, replicas=2)
    return jg.fit(start, curve, model=model, key=jax.random.key(1), progress=False)

def fitted_jointly():
    gases = {str(phi): beads(packing_fraction=phi) for phi in (0.02, 0.1)}
    model = jg.DSMC(1000, replicas=2)
    curves = {name: cool(gas, 20.0, model) for name, gas in gases.items()}
    if hasattr(jg, "fit_jointly"):  # of versions before 0.2.0
        return jg.fit_jointly({name: (gases[name], curves[name]) for name in gases})
    return jg.fit(gases, curves)

CASE = {
    "theory, smooth": lambda: (cool(beads(), 50.0, None), slope(beads(), 50.0, None)),
    "theory, rough, walls, drag": lambda: cool(
        beads(surface=rough, container=walls, drag=drag), 20.0, None),
    "theory, disks, series, driven": lambda: cool(
        beads(dimension=2, law=series, drive=noise), 20.0, None),
    "DSMC, smooth": lambda: (
        cool(beads(), 20.0, jg.DSMC(1000, replicas=2)), slope(beads(), 20.0, jg.DSMC(500))),
    "DSMC, rough, walls, drag, drive": lambda: cool(
        beads(surface=rough, container=walls, drag=drag, drive=noise), 5.0, jg.DSMC(500)),
    "hard spheres": lambda: (
        cool(beads(0.3), 20.0, jg.HardSpheres(200, replicas=2), save=flow),
        slope(beads(0.3), 5.0, jg.HardSpheres(200))),
    "hard spheres, rough, walls, drag": lambda: cool(
        beads(surface=rough, container=walls, drag=drag), 5.0, jg.HardSpheres(200)),
    "hard disks, constant restitution, driven": lambda: cool(
        beads(dimension=2, law=jg.ConstantRestitution(0.8), drive=noise), 5.0,
        jg.HardSpheres(200), save="particles"),
    "soft spheres": lambda: (
        cool(beads(packing_fraction=0.2), 3.0, jg.SoftSpheres(100)),
        slope(beads(packing_fraction=0.2), 2.0, jg.SoftSpheres(100))),
    "soft spheres, friction, walls, drag": lambda: cool(
        beads(surface=grains, container=soft_walls, drag=drag), 2.0, jg.SoftSpheres(200)),
    "fit by kinetic theory, diagnosis": fitted,
    "fit by DSMC": fitted_by_particles,
    "joint fit": fitted_jointly,
}
arrays = {}
for name, run in CASE.items():
    for k, leaf in enumerate(jax.tree.leaves(run())):
        if isinstance(leaf, (jax.Array, np.ndarray, float, int)):
            leaf = jax.random.key_data(leaf) if jax.dtypes.issubdtype(
                getattr(leaf, "dtype", None), jax.dtypes.prng_key) else leaf
            arrays[f"{name}/{k}"] = np.asarray(leaf)
    print(name, file=sys.stderr, flush=True)
arrays["package"] = np.array(jg.__file__)
np.savez(sys.argv[2], **arrays)
"""


def compare_versions(options: Options) -> dict:
    before, now = (arrays_of(folder) for folder in (options.CHECKOUT, EXPERIMENTS.parent))
    rows = []
    for case in dict.fromkeys(key.partition("/")[0] for key in [*before, *now]):
        pair = [
            {k: x for k, x in each.items() if k.startswith(case + "/")} for each in (before, now)
        ]
        number = f"{len(pair[1])} arrays"
        if pair[0].keys() != pair[1].keys():
            number, difference = f"{len(pair[0])} and {number}", float("inf")
        else:
            difference = max(relative_difference(x, pair[1][key]) for key, x in pair[0].items())
        rows.append({"case": case, "difference": difference})
        print(f"{case:45} {number:12} {difference or 'identical'}")
    return {"rows": rows}


def relative_difference(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest difference over the largest value; 0 if all bits agree."""
    if one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes():
        return 0.0
    if one.shape != other.shape or one.dtype.kind not in "fiu":
        return float("inf")
    return float(np.nanmax(np.abs(one - other)) / np.nanmax(np.abs(one)))


def arrays_of(folder: Path) -> dict[str, np.ndarray]:
    """Return all arrays of the version in a folder, by case and number."""
    with tempfile.TemporaryDirectory() as results:
        file = Path(results) / "arrays.npz"
        process("-c", CASES, DATA / "lammps_cooling_dilute.csv", file, folder=folder)
        with np.load(file) as arrays:
            found = dict(arrays)
    package = Path(str(found.pop("package")))
    if not package.is_relative_to(folder.resolve()):
        raise SystemExit(f"the version in {folder} was not imported, but {package}")
    return found


if __name__ == "__main__":
    settings = {"type": Path, "help": "folder of the other version"}
    found = run_parts(__doc__, compare_versions, smoke=False, CHECKOUT=settings)
    sys.exit(any(row["difference"] for row in found["compare_versions"]["rows"]))
