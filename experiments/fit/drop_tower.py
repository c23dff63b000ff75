"""What could a published drop-tower experiment say about A? Its numbers, and a simulation.

    python experiments/fit/drop_tower.py [--runs 6] [--record] [--out DIR]

Published (T. Trittel, D. Puzyrev, K. Harth & R. Stannarius, npj Microgravity (2024),
doi 10.1038/s41526-024-00420-5, abstract): equal spheres in a drop tower; after the excitation stops
the kinetic energy falls to about 5 % in three Haff times; the rotational degrees of freedom hold
about 2/3 of the energy of the translational ones, and cool at the same rate.

The abstract does not give these values, which are assumed: 300 polymer spheres of 6 mm in a cube of
100 mm, T_0 = .01 m^2/s^2, Y = 2 GPa, an A for which eps is .85 at the initial thermal speed, walls
of eps = .85, and beta_t = 0 of spheres and walls, for which T_rot/T stays near 2/3 in kinetic
theory.

Simulates single runs of hard, rough
spheres between walls, adds errors of 5 % to T and T_rot, and fits each run twice with kinetic
theory: as smooth spheres without walls, and as rough spheres between walls with beta_t free.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from scipy.optimize import root_scalar

import jaxgran
from experiments.support.analysis import fit_quietly
from experiments.support.plots import GUIDE, INK, THEORY, caption, panels
from experiments.support.record import Options, run_parts
from experiments.support.scenes import cool, temperature_only

NUM_PARTICLES, DIAMETER, SIDE = 300, 6e-3, 0.1
EPS, BETA_T, RATIO = 0.85, 0.0, 2 / 3
POINTS, ERROR = 30, 0.05


def scene() -> jaxgran.Gas:
    """Return the simulated gas."""
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(2e9, 0.4, 1e-6),
        diameter=DIAMETER,
        mass=jaxgran.sphere_mass(DIAMETER, 1050.0),
        packing_fraction=NUM_PARTICLES * np.pi / 6 * (DIAMETER / SIDE) ** 3,
        temperature=0.01,
        surface=jaxgran.Rough(BETA_T, rotational_temperature=RATIO * 0.01),
        container=jaxgran.Walls(SIDE, restitution=EPS, tangential_restitution=BETA_T),
    )

    def excess(log_A: float) -> float:
        now = gas.replace(dissipative_constant=np.exp(log_A))
        return float(now.restitution(gas.impact_speed)) - EPS

    log_A = root_scalar(excess, bracket=(np.log(1e-9), np.log(1e-2)), xtol=1e-14).root
    return gas.replace(dissipative_constant=np.exp(log_A))


def twin(gas: jaxgran.Gas, key: int) -> jaxgran.CoolingCurve:
    """Simulate a single run of hard spheres, with errors of T and T_rot."""
    theory = cool(gas, np.geomspace(0.01, 100.0, 400))
    end = float(theory.times[jnp.argmax(theory.temperature < 0.05 * gas.temperature)])
    times = np.linspace(end / POINTS, end, POINTS)
    exact = cool(gas, times, jaxgran.HardSpheres(NUM_PARTICLES), key)
    noise = np.exp(ERROR * np.random.default_rng(key).standard_normal((2, POINTS)))
    T, T_rot = exact.temperature * noise[0], exact.rotational_temperature * noise[1]
    rotation = {"rotational_temperature": T_rot, "rotational_temperature_error": ERROR * T_rot}
    return jaxgran.CoolingCurve(times, T, temperature_error=ERROR * T, **rotation)


def fitted(gas: jaxgran.Gas, curve: jaxgran.CoolingCurve) -> tuple[jaxgran.Fit, jaxgran.Fit]:
    """Fit a run as smooth spheres without walls, and with the complete scene."""
    unknown = gas.replace(dissipative_constant=0.0, tangential_restitution=0.0)
    smooth = dataclasses.replace(unknown, surface=None, container=None)
    of_T = jaxgran.Measurement(smooth, temperature_only(curve), num_particles=NUM_PARTICLES)
    of_both = jaxgran.Measurement(unknown, curve, num_particles=NUM_PARTICLES)
    first = fit_quietly(of_T, free=("dissipative_constant", "temperature"), quick=True)
    free = ("dissipative_constant", "tangential_restitution", "rotational_temperature")
    return first, fit_quietly(of_both, free=free, quick=True)


def drop_tower(options: Options) -> dict:
    gas = scene()
    A = float(gas.value("dissipative_constant"))
    curves = [twin(gas, key) for key in range(options.runs)]
    smooth, complete = zip(*(fitted(gas, curve) for curve in curves), strict=True)
    right = [float(fit.estimate[0]) / A for fit in complete]
    errors = [float(fit.standard_error[0]) / A for fit in complete]
    found = [float(fit.estimate[0]) / A for fit in smooth if not fit.undetermined]
    return {
        "A_over_true": right,
        "error_over_true": errors,
        "held": sum(abs(x - 1) < 1.96 * error for x, error in zip(right, errors, strict=True)),
        "runs": options.runs,
        "smooth_undetermined": options.runs - len(found),
        "smooth_over_true": found,
        "picture": draw(curves[0], smooth[0], complete[0], A),
    }


def in_words(result: jaxgran.Fit, A: float) -> str:
    """Format A and its error over the true A."""
    if "dissipative_constant" in result.undetermined:
        return "not determined"
    return f"{result.estimate[0] / A:.2f} ± {result.standard_error[0] / A:.2f}"


def draw(curve: jaxgran.CoolingCurve, smooth: jaxgran.Fit, complete: jaxgran.Fit, A: float):
    """Draw T and T_rot of a run, with both fits."""
    figure, (axes,) = panels(size=(7.0, 4.6))
    for name, color, label in (
        ("temperature", INK, "$T$, one simulated run"),
        ("rotational_temperature", GUIDE, r"$T_\mathrm{rot}$, the same run"),
    ):
        T, style = getattr(curve, name), {"fmt": "o", "markersize": 4, "capsize": 2}
        axes.errorbar(curve.times, T, ERROR * T, color=color, label=label, **style)
    told = f"rough spheres between walls: A over the true A {in_words(complete, A)}"
    untold = f"smooth spheres, no walls: A over the true A {in_words(smooth, A)}"
    axes.plot(curve.times, complete.curve.temperature, color=THEORY, label=told)
    axes.plot(curve.times, complete.curve.rotational_temperature, ":", color=THEORY)
    axes.plot(curve.times, smooth.curve.temperature, "--", color=THEORY, label=untold)
    caption(axes, yscale="log", xlabel="t (s)", ylabel="temperature (m²/s²)")
    return figure


if __name__ == "__main__":
    run_parts(__doc__, drop_tower, smoke=False, runs=6)
