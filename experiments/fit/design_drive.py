"""How must a gas be driven so that its temperature follows a given course?

    python experiments/fit/design_drive.py [--smoke] [--record] [--out DIR]

The drive is a white noise whose strength is constant in each of some intervals. optax minimises
the mean square of ln(T/T_wanted) over the logarithms of the strengths, along gradients through
kinetic theory in reverse mode.
"""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure

import jaxgran
from experiments.support.record import script_parser, write_picture, write_results

INTERVALS, POINTS = 12, 8
LENGTH = 8.0  # of an interval, in mean free times
BEADS = jaxgran.Viscoelastic(5e7, 0.22, 5e-6)


def main() -> None:
    options = script_parser(__doc__, "design_drive").parse_args()
    jax.config.update("jax_enable_x64", True)
    gas = jaxgran.Gas(
        BEADS,
        diameter=2e-3,
        mass=1e-5,
        packing_fraction=0.05,
        temperature=0.01,
        drive=jaxgran.WhiteNoise(0.01),
    )
    within = LENGTH * gas.mean_free_time * jnp.arange(1, POINTS + 1) / POINTS
    t = within[-1] * jnp.arange(1, INTERVALS * POINTS + 1) / (INTERVALS * POINTS) * INTERVALS
    wanted = gas.temperature * (1 + jnp.sin(2 * jnp.pi * t / t[-1]) ** 2)

    def course(log_strengths):
        def interval(T, log_strength):
            now = gas.replace(temperature=T, drive_strength=jnp.exp(log_strength))
            temperature = jaxgran.cool(now, within).temperature
            return temperature[-1], temperature

        return jnp.ravel(jax.lax.scan(interval, gas.temperature, log_strengths)[1])

    @jax.jit
    def step(log_strengths, state):
        def miss(x):
            return jnp.mean(jnp.log(course(x) / wanted) ** 2)

        value, gradient = jax.value_and_grad(miss)(log_strengths)
        updates, state = solver.update(gradient, state)
        return optax.apply_updates(log_strengths, updates), state, value

    solver = optax.adam(0.1)
    log_strengths = jnp.full(INTERVALS, jnp.log(gas.temperature / t[-1]))
    first, state, misses = log_strengths, solver.init(log_strengths), []
    for _ in range(10 if options.smoke else 200):
        log_strengths, state, miss = step(log_strengths, state)
        misses.append(float(miss) ** 0.5)
    largest = float(jnp.max(jnp.abs(course(log_strengths) / wanted - 1)))
    print(f"rms of ln(T/T_wanted): {misses[0]:.3g} at first, {misses[-1]:.2g} at last")
    print(f"largest difference {100 * largest:.2g} %; strengths {np.exp(log_strengths)} m^2/s^3")
    found = {"misses": misses, "largest": largest, "strengths": np.exp(log_strengths).tolist()}
    write_results("design_drive", options, options.out / "design_drive.json", **found)
    figure = Figure(figsize=(6, 4.5), layout="constrained")
    top, bottom = figure.subplots(2, sharex=True, height_ratios=[2, 1])
    top.plot(t, wanted, color="#222222", linestyle="--", label="wanted")
    top.plot(t, course(first), color="#999999", label="first guess")
    top.plot(t, course(log_strengths), color="#0072b2", label="with this drive")
    top.set(ylabel="T (m²/s²)")
    top.legend(frameon=False)
    edges = float(within[-1]) * np.arange(INTERVALS + 1)
    bottom.stairs(np.exp(log_strengths), edges, fill=True, color="#d55e00")
    bottom.set(xlabel="t (s)", ylabel="drive (m²/s³)")
    write_picture(figure, "design_drive", options)


if __name__ == "__main__":
    main()
