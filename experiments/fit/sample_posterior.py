"""Does the error bar of a fit agree with the posterior? NUTS on (A, phi, T_0).

    python experiments/fit/sample_posterior.py [--samples 1000] [--chains 4] [--warmup 600]
        [--out DIR]

The curve is the dilute LAMMPS curve, with phi known within 4 % and T_0 within 1 %. The sampler uses
`jaxgran.log_likelihood`, which the fit maximises, and the priors of the fit, of phi and of T_0.
Finds both results and the effective samples per second, and draws a corner plot.
"""

import dataclasses
import time
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.diagnostics import effective_sample_size, potential_scale_reduction
from blackjax.util import run_inference_algorithm
from corner import corner

import jaxgran
from experiments.support.plots import THEORY
from experiments.support.record import Options, run_parts
from experiments.support.scenes import of_lammps, temperature_only

FREE = ("dissipative_constant", "temperature")
PRIORS = {"packing_fraction": 0.04, "temperature": 0.01}
"""Relative standard errors."""

MODEL = jaxgran.KineticTheory(rtol=1e-6)
"""The error of T is then some 1e-5, a hundredth of the least error of a point; a gradient takes
less time than at 1e-9."""

LABELS = ("A (1e-6 s)", "phi", "T_0 (1e-2 m²/s²)")


def sample_posterior(options: Options) -> dict:
    lammps = of_lammps("dilute")
    values = {name: float(lammps.gas.value(name)) for name in PRIORS}
    priors = {name: (x, PRIORS[name] * x) for name, x in values.items()}
    # T only: the factor of <dr^2> in the fit is a parameter that the likelihood integrates out.
    of_T = temperature_only(lammps.curve)
    measurement = dataclasses.replace(lammps, data=of_T, priors=priors)
    result = jaxgran.fit(measurement, free=FREE, quick=True)
    samples, facts = sample(*log_posterior(measurement, priors, result), options)
    A, phi, T_0 = samples.reshape(-1, 3).T
    for name, values in zip(FREE, (A, T_0), strict=True):
        estimate, error = (float(x) for x in result.value(name))
        of_values = {"mean": float(values.mean()), "std": float(values.std())}
        facts[name] = of_values | {"fit": estimate, "fit_std": error}
    return facts | {"picture": draw(result, np.stack([A * 1e6, phi, T_0 * 100], axis=1))}


def log_posterior(measurement, priors, result):
    """Return the posterior of theta, and the SI values (A, phi, T_0) of theta.

    theta is (ln A, ln phi, ln T_0), each less its prior or fitted value and over its prior or
    fitted error, so that its entries are of order one.
    """
    phi, e_phi = priors["packing_fraction"]
    T_0, e_T = priors["temperature"]
    A, e_A = (float(x) for x in result.value("dissipative_constant"))
    centre = jnp.log(jnp.array([A, phi, T_0]))
    width = jnp.array([e_A / A, e_phi / phi, e_T / T_0])

    def values(theta):
        return jnp.exp(centre + width * theta)

    def log_density(theta):
        A, phi, T_0 = values(theta)
        changed = {"dissipative_constant": A, "packing_fraction": phi, "temperature": T_0}
        now = measurement.gas.replace(**changed)
        # The prior of A is flat in ln A.
        likelihood = jaxgran.log_likelihood(now, measurement, model=MODEL)
        return likelihood - 0.5 * jnp.sum(theta[1:] ** 2)

    return log_density, values


def sample(log_density, values, options) -> tuple[np.ndarray, dict]:
    """Return samples (chains, samples, 3) of SI values, and speed and diagnostics of the run."""
    warm_key, key = jax.random.split(jax.random.key(0))
    full = {"is_mass_matrix_diagonal": False}
    adapt: Any = blackjax.window_adaptation(blackjax.nuts, log_density, **full)
    (state, tuned), _ = adapt.run(warm_key, jnp.zeros(3), options.warmup)
    nuts: Any = blackjax.nuts(log_density, **tuned)

    def chain(key):
        kept = {"transform": lambda state, info: (state.position, info.is_divergent)}
        return run_inference_algorithm(key, nuts, options.samples, initial_state=state, **kept)[1]

    keys = jax.random.split(key, options.chains)
    keys = jax.random.split(keys[0], len(keys))
    chains = jax.jit(jax.vmap(chain)).lower(keys).compile()
    begin = time.perf_counter()
    theta, divergent = jax.block_until_ready(chains(keys))
    seconds = time.perf_counter() - begin
    return np.asarray(jax.vmap(jax.vmap(values))(theta)), {
        "samples_per_second": options.samples * options.chains / seconds,
        "divergent": int(jnp.sum(divergent)),
        "effective": float(jnp.min(effective_sample_size(theta))),
        "r_hat": float(jnp.max(potential_scale_reduction(theta))),
    }


def draw(result: jaxgran.Fit, samples: np.ndarray):
    """Draw a corner plot, with the Gaussian of the fit over the histograms of A and T_0."""
    figure = corner(samples, labels=LABELS, color="0.3", quantiles=(0.025, 0.975))
    axes = np.array(figure.axes).reshape(3, 3)
    for i, name, unit in ((0, FREE[0], 1e6), (2, FREE[1], 100.0)):
        estimate, error = (float(x) * unit for x in result.value(name))
        (left, right), (_, top) = axes[i, i].get_xlim(), axes[i, i].get_ylim()
        x = np.linspace(left, right, 200)
        normal = 0.95 * np.exp(-0.5 * ((x - estimate) / error) ** 2)
        axes[i, i].plot(x, normal * top, color=THEORY, lw=2)
    axes[0, 2].text(0.0, 0.8, "grey: NUTS\nblue: fit, with its budget", fontsize=12)
    return figure


if __name__ == "__main__":
    run_parts(__doc__, sample_posterior, smoke=False, samples=1000, chains=4, warmup=600)
