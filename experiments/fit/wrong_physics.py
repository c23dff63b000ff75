"""What is the result of a fit of A if the curve contains physics that the model leaves out?

    python experiments/fit/wrong_physics.py [--draws 20] [--rows walls] [--record] [--out FILE]

Makes cooling curves of 2 mm beads (phi = .05, A = 3e-6 s; 30 points, 3 % noise) that contain rough
grains, walls, drag, a noise floor or a constant eps, fits A and T_0 with kinetic theory of smooth
viscoelastic spheres, and prints for each: fitted over true A, how often the verdict still says
"consistent", and how often the range of A over all alternatives contains the true A. A curve of
constant eps has no A: there the range must reach down to 1 % of the fitted A. If the scene can
contain the roughness, the walls or the drag, the curve is fitted again with them; `told` is that A
and `told_held` how often its 95 % interval contains the true one.

The curves are simulated with hard spheres, in 16 boxes of 50 mm with 1492 spheres each, until T
has fallen to 2 % (walls: between walls); the noise is added to their mean. Contacts of hard spheres
have no duration, so kinetic theory is used with `softness=False`.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.record import add_recording, figures, write_results
from jaxgran.models.checks import first_cooling_rate

TRUE_A = 3e-6
NUM_POINTS, NOISE = 30, 0.03
BOX, NUM_PARTICLES, REPLICAS = 0.05, 1492, 16  # m; phi = .05
LAST = 0.02
THEORY = jaxgran.KineticTheory(softness=False)


def beads() -> jaxgran.Gas:
    diameter = 2e-3
    return jaxgran.Gas(
        jaxgran.Viscoelastic(5e7, 0.22, TRUE_A),
        diameter=diameter,
        mass=jaxgran.sphere_mass(diameter, 2500.0),
        packing_fraction=NUM_PARTICLES * np.pi / 6 * (diameter / BOX) ** 3,
        temperature=0.01,
    )


def measured(gas: jaxgran.Gas) -> tuple[jax.Array, jax.Array]:
    """Return times until T has fallen to its last share, and T of hard spheres at these times."""
    error_model = jnp.geomspace(1e-2, 1e4, 400) * gas.mean_free_time
    T = jaxgran.cool(gas, error_model, model=THEORY).temperature / gas.temperature
    end = float(jnp.interp(-np.log(LAST), -jnp.log(T), error_model))
    times = jnp.geomspace(end / 300, end, NUM_POINTS)
    model = jaxgran.HardSpheres(NUM_PARTICLES, replicas=REPLICAS)
    return times, jaxgran.cool(gas, times, model=model, progress=False).temperature


def drag(gas: jaxgran.Gas) -> jaxgran.StokesDrag:
    """Return linear drag whose initial losses are 3 % of those of collisions."""
    return jaxgran.StokesDrag(0.03 * float(first_cooling_rate(gas)) / 2)


SCENES = [
    # name of the row; difference from the gas of the fit; noise floor over T_0
    ("nothing else", {}, 0.0),
    ("rough grains, beta_t = -.8", {"surface": jaxgran.Rough(-0.8)}, 0.0),
    ("rough grains, beta_t = -.5", {"surface": jaxgran.Rough(-0.5)}, 0.0),
    ("rough grains, beta_t = 0", {"surface": jaxgran.Rough(0.0)}, 0.0),
    ("walls of a 50 mm box, eps_w = .9", {"container": jaxgran.Walls(BOX, restitution=0.9)}, 0.0),
    ("walls of a 50 mm box, eps_w = .8", {"container": jaxgran.Walls(BOX, restitution=0.8)}, 0.0),
    ("constant eps = .9", {"law": jaxgran.ConstantRestitution(0.9)}, 0.0),
    ("constant eps = .8", {"law": jaxgran.ConstantRestitution(0.8)}, 0.0),
    ("constant eps = .65", {"law": jaxgran.ConstantRestitution(0.65)}, 0.0),
    ("drag, 3 % of the first losses", {"drag": drag(beads())}, 0.0),
    ("a noise floor of 1 % of T_0", {}, 0.01),
]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=20, help="of the noise (default: 20)")
    parser.add_argument("--rows", default="", help="only those whose name contains this")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = {row["name"]: row for row in figures("wrong_physics")["rows"]} if options.rows else {}
    for name, other, floor in SCENES:
        if options.rows in name:
            rows[name] = row(name, other, floor, options.draws)
            print(rows[name], flush=True)
    ordered = [rows[name] for name, *_ in SCENES if name in rows]
    write_results("wrong_physics", options, options.out, rows=ordered)


def row(name: str, other: dict, floor: float, draws: int) -> dict:
    """Compute a row of the table; for a curve without A, A is compared with 3e-6 s."""
    gas = beads()
    scene = dataclasses.replace(gas, **other)
    has_elements, true = bool(scene.elements), 0.0 if "law" in other else TRUE_A
    times, T = measured(scene)
    exact = T + floor * float(gas.temperature)
    found, compatible, ranges, inside = [], 0, [], 0
    found_so, held = [], 0
    for draw in range(draws):
        noise = np.random.default_rng(draw).standard_normal(NUM_POINTS)
        T = exact * jnp.exp(NOISE * noise)
        curve = jaxgran.CoolingCurve(times=times, temperature=T, temperature_error=NOISE * T)
        free = ("dissipative_constant", "temperature")
        result = jaxgran.fit(gas, curve, model=THEORY, free=free)
        diagnosis = jaxgran.diagnose(result, curve)
        low, high = (float(x[0]) for x in diagnosis.ranges["dissipative_constant"])
        found.append(float(result.estimate[0]) / TRUE_A)
        ranges.append((low / TRUE_A, high / TRUE_A))
        compatible += diagnosis.grade != "not consistent"
        inside += low <= max(true, 0.01 * float(result.estimate[0])) <= high
        if has_elements:
            result = jaxgran.fit(scene, curve, model=THEORY, free=free)
            A, error = (float(x) for x in result.value("dissipative_constant"))
            found_so.append(A / TRUE_A)
            held += abs(A - true) < 1.96 * error
    return {
        "name": name,
        "draws": draws,
        "A": float(np.median(found)),
        "compatible": int(compatible),
        "range": [float(x) for x in np.median(ranges, axis=0)],
        "inside": int(inside),
        "told": float(np.median(found_so)) if found_so else None,
        "told_held": int(held),
    }


if __name__ == "__main__":
    main()
