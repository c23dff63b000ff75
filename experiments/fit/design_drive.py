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

import jaxgran
from experiments.support.plots import GUIDE, HARD, INK, THEORY, caption, panels
from experiments.support.record import Options, run_parts

INTERVALS, POINTS = 12, 8
LENGTH = 8.0  # of an interval, in mean free times


def design_drive(options: Options) -> dict:
    law, size = jaxgran.Viscoelastic(5e7, 0.22, 5e-6), {"diameter": 2e-3, "mass": 1e-5}
    drive = jaxgran.WhiteNoise(0.01)
    gas = jaxgran.Gas(law, **size, packing_fraction=0.05, temperature=0.01, drive=drive)
    t = LENGTH * gas.mean_free_time * jnp.arange(1, INTERVALS * POINTS + 1) / POINTS
    within = t[:POINTS]
    wanted = gas.temperature * (1 + jnp.sin(2 * jnp.pi * t / t[-1]) ** 2)

    def course(log_strengths):
        def interval(T, log_strength):
            now = gas.replace(temperature=T, drive_strength=jnp.exp(log_strength))
            temperature = jaxgran.cool(now, within).temperature
            return temperature[-1], temperature

        return jnp.ravel(jax.lax.scan(interval, gas.temperature, log_strengths)[1])

    def square(log_strengths):
        return jnp.mean(jnp.log(course(log_strengths) / wanted) ** 2)

    def step(carry, _):
        log_strengths, state = carry
        value, gradient = jax.value_and_grad(square)(log_strengths)
        updates, state = solver.update(gradient, state)
        return (optax.apply_updates(log_strengths, updates), state), jnp.sqrt(value)

    solver, first = optax.adam(0.1), jnp.full(INTERVALS, jnp.log(gas.temperature / t[-1]))
    start, steps = (first, solver.init(first)), 10 if options.smoke else 200
    (log_strengths, _), misses = jax.lax.scan(step, start, length=steps)
    largest = float(jnp.max(jnp.abs(course(log_strengths) / wanted - 1)))
    figure, (top, bottom) = panels(1, 2, size=(6, 2.25), sharex=True, height_ratios=[2, 1])
    top.plot(t, wanted, color=INK, linestyle="--", label="wanted")
    top.plot(t, course(first), color=GUIDE, label="first guess")
    top.plot(t, course(log_strengths), color=THEORY, label="with this drive")
    caption(top, ylabel="T (m²/s²)")
    strengths, edges = jnp.exp(log_strengths), np.append(0.0, t[POINTS - 1 :: POINTS])
    bottom.stairs(strengths, edges, fill=True, color=HARD)
    caption(bottom, xlabel="t (s)", ylabel="drive (m²/s³)")
    return {"misses": misses, "largest": largest, "strengths": strengths, "picture": figure}


if __name__ == "__main__":
    run_parts(__doc__, design_drive)
