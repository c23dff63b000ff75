# %% [markdown]
# # Which model does my gas need?
#
# `jaxgran.cool` computes a cooling curve at four levels of detail:
#
# | model | what it solves | what it leaves out |
# |---|---|---|
# | `KineticTheory` | moments of the Enskog equation | clusters; lasting contacts but in part |
# | `DSMC` | random collisions in a homogeneous gas | clusters, lasting contacts |
# | `HardSpheres` | impacts without duration, particle by particle | lasting contacts |
# | `SoftSpheres` | contacts resolved in time steps | nothing of these |
#
# We compare all four with a curve of a dense gas of soft grains, simulated in LAMMPS.

# %%
import time

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxgran
from jaxgran.plotting import COLOURS

jax.config.update("jax_enable_x64", True)
measurement = jaxgran.example_measurement("dense")
gas, curve = measurement.gas, measurement.curve
times, measured = curve.times[1:40:3], curve.temperature[1:40:3]
print(f"packing fraction {gas.packing_fraction:.2f}, mean free time {gas.mean_free_time:.2g} s")
print(f"a contact lasts {gas.contact_fraction:.2g} mean free times")

# %% [markdown]
# `choose_model` estimates the error of each model for this gas, and takes the fastest one within a
# tolerance of T. No simulation is run for this, so it takes no time.

# %%
choice = jaxgran.choose_model(gas, times, tolerance=0.02, num_particles=500, replicas=2)
print(*choice.reasons, sep="\n")

# %% [markdown]
# Now all four, with 500 particles (DSMC: 5000). A second call is timed, as the first one compiles.

# %%
spheres = jaxgran.HardSpheres(500, replicas=2), jaxgran.SoftSpheres(500, replicas=2)
models = jaxgran.KineticTheory(), jaxgran.DSMC(5000, replicas=2), *spheres
found, seconds = {}, {}
for model in models:
    for _ in range(2):
        begin = time.perf_counter()
        T = jaxgran.cool(gas, times, model=model, progress=False).temperature
        found[model.name] = np.asarray(T / measured)
        seconds[model.name] = time.perf_counter() - begin

# %%
estimates = {c.model.name: c.error for c in choice.candidates}
print(f"{'model':<16}{'error of T':>12}{'estimated':>12}{'run time':>12}")
for name, ratio in found.items():
    error, known = np.abs(ratio - 1).max(), estimates[name]
    estimate = "none" if known is None else f"{100 * float(known):.2g} %"
    print(f"{name:<16}{f'{100 * error:.2g} %':>12}{estimate:>12}{seconds[name]:10.3f} s")

# %%
fig, axes = plt.subplots(figsize=(6, 4), layout="constrained")
for (name, ratio), mark in zip(found.items(), "Dvs^", strict=True):
    colour = COLOURS[name]
    axes.semilogx(times / gas.mean_free_time, ratio, marker=mark, color=colour, label=name)
axes.axhline(1, color="0.5", lw=1)
axes.set(xlabel="time / mean free time", ylabel="T of the model / T of LAMMPS")
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# Kinetic theory, DSMC and hard spheres cool too fast at late times. Impacts of DSMC and of hard
# spheres are over at once, whereas here they last a sixth of a free flight; and DSMC does not know
# that in a dense gas the velocities of neighbours become alike, which kinetic theory includes in
# part. Only soft spheres agree with LAMMPS to the noise of so few particles. They also take the
# longest time, by the table above.
