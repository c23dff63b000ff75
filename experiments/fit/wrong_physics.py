"""What does a fit of A say where the curve contains physics that it does not know?

    python experiments/fit/wrong_physics.py [--draws 20] [--record] [--out FILE]

Makes cooling curves of 2 mm beads (phi = .05, A = 3e-6 s; 30 points, 3 % noise) that contain rough
grains, walls, drag, a noise floor or a constant eps besides or instead, fits A and T_0 with kinetic
theory of smooth viscoelastic spheres, and prints for each: A found over A true, how often the
verdict still says "compatible", and how often the range of A over all rivals contains the true A.
A curve of constant eps has no A: there the range must reach down to 1 % of the A found. Where the
scene can be told of the roughness, the walls or the drag, it is fitted again so, and the last two
columns are A and how often its 95 % interval contains the true one.

The curves are integrated here, by rates of T that the fit does not use: rough spheres as two
temperatures with constant tangential restitution (Huthmann & Zippelius, PRE 56, R6275 (1997)),
walls as the loss of a Maxwellian gas that stays mixed.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.record import add_recording, write_results
from jaxgran.theory.table_of_times import relaxed_cooling_rate

TRUE_A = 3e-6
NUM_POINTS, NOISE = 30, 0.03
STEPS = 4000
BOX = 0.05  # m
HEAD = (
    "| the curve contains | A found / 3e-6 s | compatible | range of A / 3e-6 s | truth in it "
    "| A / 3e-6 s where the scene is told | intervals that hold it |\n|---|---|---|---|---|---|---|"
)
NOTE = "In rows of constant eps there is no A: the range must reach down to 1 % of the A found."


def beads(A: float = TRUE_A) -> jaxgran.Gas:
    return jaxgran.Gas(
        jaxgran.Viscoelastic(5e7, 0.22, A),
        diameter=2e-3,
        mass=jaxgran.sphere_mass(2e-3, 2500.0),
        packing_fraction=0.05,
        temperature=0.01,
    )


def normal_rate(gas):
    """-d ln T/dt by collisions of smooth spheres, a function of T."""
    log_theta, rate = (np.asarray(x) for x in relaxed_cooling_rate(gas, jnp.asarray(20.0)))
    return lambda T: np.interp(np.log(T / float(gas.temperature)), log_theta[::-1], rate[::-1])


def frequency(gas, T: float) -> float:
    """Collisions per sphere and second."""
    return np.sqrt(T / float(gas.temperature)) / float(gas.mean_free_time)


def cooled(rates, T_0: float, last_share: float, other: float = 0.0):
    """Times and T until T has fallen to a share, for ``rates(T, R) = (dT/dt, dR/dt)``."""
    state, t, times, values = np.array([T_0, other]), 0.0, [0.0], [T_0]
    for _ in range(100 * STEPS):
        speed = np.array(rates(*state))
        dt = 0.002 * state[0] / max(abs(speed[0]), 1e-300)
        middle = np.array(rates(*(state + 0.5 * dt * speed)))
        state, t = state + dt * middle, t + dt
        times.append(t)
        values.append(state[0])
        if state[0] < last_share * T_0:
            break
    return np.array(times), np.array(values)


def rough(beta: float):
    """Two temperatures of rough spheres with a moment of inertia of 2/5 m (sigma/2)^2."""
    q = 0.4
    eta = q * (1 + beta) / (2 * q + 2)
    a, b, c = eta * (1 - eta), eta**2 / q, eta / q * (1 - eta / q)

    def rates_of(gas):
        normal = normal_rate(gas)

        def rates(T, R):
            tangential = 4 / 3 * frequency(gas, T)
            return (
                -normal(T) * T - tangential * (a * T - b * R),
                tangential * (b * T - c * R),
            )

        return rates

    return rates_of


def beside(extra):
    """Collisions of smooth spheres, and another rate of loss."""

    def rates_of(gas):
        normal = normal_rate(gas)
        return lambda T, R: (-(normal(T) + extra(gas, T)) * T, 0.0)

    return rates_of


def walls(eps: float):
    """Flux ``Z n sqrt(T / 2 pi)`` onto six faces, each impact losing ``(1 - eps^2) m T``.

    Centres are in a cube shorter by a diameter, with the pressure Z n m T at the walls.
    """

    def loss(gas, T):
        phi = float(gas.packing_fraction)
        pressure = (1 + phi + phi**2 - phi**3) / (1 - phi) ** 3
        faces = 6 / (BOX - float(gas.diameter))
        return pressure * faces * np.sqrt(T / (2 * np.pi)) * (1 - eps**2) * 2 / 3

    return beside(loss)


def drag(share: float):
    """Linear drag, a share of the first rate of collisional cooling."""
    return beside(lambda gas, T: share * normal_rate(gas)(float(gas.temperature)))


def constant(eps: float):
    """Constant restitution instead of A, by Haff's law."""

    def rates_of(gas):
        return lambda T, R: (-(1 - eps**2) / 3 * frequency(gas, T) * T, 0.0)

    return rates_of


def nothing(gas):
    return beside(lambda gas, T: 0.0)(gas)


def told_rough(beta: float):
    return lambda gas: {"surface": jaxgran.Rough(beta)}


def told_walls(eps: float):
    return lambda gas: {"container": jaxgran.Walls(BOX, restitution=eps)}


def told_drag(share: float):
    def elements(gas):
        return {"drag": jaxgran.StokesDrag(share * normal_rate(gas)(float(gas.temperature)) / 2)}

    return elements


SCENES = [
    # what the curve contains, its rates, the noise floor over T_0, A in it, what a scene can say
    ("nothing else", nothing, 0.0, TRUE_A, None),
    ("rough grains, beta_t = -.8", rough(-0.8), 0.0, TRUE_A, told_rough(-0.8)),
    ("rough grains, beta_t = -.5", rough(-0.5), 0.0, TRUE_A, told_rough(-0.5)),
    ("rough grains, beta_t = 0", rough(0.0), 0.0, TRUE_A, told_rough(0.0)),
    ("walls of a 50 mm box, eps_w = .9", walls(0.9), 0.0, TRUE_A, told_walls(0.9)),
    ("walls of a 50 mm box, eps_w = .8", walls(0.8), 0.0, TRUE_A, told_walls(0.8)),
    ("constant eps = .9", constant(0.9), 0.0, 0.0, None),
    ("constant eps = .8", constant(0.8), 0.0, 0.0, None),
    ("constant eps = .65", constant(0.65), 0.0, 0.0, None),
    ("drag, 3 % of the first losses", drag(0.03), 0.0, TRUE_A, told_drag(0.03)),
    ("a noise floor of 1 % of T_0", nothing, 0.01, TRUE_A, None),
]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=20, help="of the noise (default: 20)")
    parser.add_argument("--out", type=Path, help="a file for the table")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(HEAD)
    rows = []
    for name, rates_of, floor, true, told in SCENES:
        rows.append(row(name, rates_of, floor, true, told, options.draws))
        print(line(rows[-1]), flush=True)
    write_results("wrong_physics", options, None, rows=rows)
    if options.out is not None:
        options.out.write_text(table({"rows": rows}), encoding="utf-8")


def table(results: dict) -> str:
    """The table of all rows."""
    return "\n".join([HEAD, *map(line, results["rows"]), "", NOTE]) + "\n"


def line(row: dict) -> str:
    """A row of the table."""
    low, high = row["range"]
    draws = row["draws"]
    told = "| "
    if row["told"] is not None:
        told = f"{row['told']:.2f} | {row['told_held']} of {draws}"
    return (
        f"| {row['name']} | {row['A']:.2f} | {row['compatible']} of {draws} | "
        f"{low:.2f} to {high:.2f} | {row['inside']} of {draws} | {told} |"
    )


def row(name: str, rates_of, floor: float, true: float, told, draws: int) -> dict:
    """One row of the table; for a curve without A, A is compared with 3e-6 s."""
    gas = beads()
    T_0 = float(gas.temperature)
    times, values = cooled(rates_of(gas), T_0, 0.02)
    t = np.geomspace(times[-1] / 300, times[-1], NUM_POINTS)
    exact = np.interp(t, times, values) + floor * T_0
    found, compatible, ranges, inside = [], 0, [], 0
    found_so, held = [], 0
    for draw in range(draws):
        noise = np.random.default_rng(draw).standard_normal(NUM_POINTS)
        T = exact * np.exp(NOISE * noise)
        curve = jaxgran.CoolingCurve(times=t, temperature=T, temperature_error=NOISE * T)
        result = jaxgran.fit(gas, curve, free=("dissipative_constant", "temperature"))
        diagnosis = jaxgran.diagnose(result, curve)
        low, high = (float(x[0]) for x in diagnosis.ranges["dissipative_constant"])
        found.append(float(result.estimate[0]) / TRUE_A)
        ranges.append((low / TRUE_A, high / TRUE_A))
        compatible += diagnosis.explains
        inside += low <= max(true, 0.01 * float(result.estimate[0])) <= high
        if told is not None:
            scene = dataclasses.replace(gas, **told(gas))
            result = jaxgran.fit(scene, curve, free=("dissipative_constant", "temperature"))
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
