# %% [markdown]
# # Derivatives through chaos
#
# Two granular gases whose grains differ by one part in a billion are different gases after a dozen
# collisions: each impact of spheres enlarges a difference of positions several times. The
# derivative of a position in the dissipative constant A is therefore enormous, and useless. Yet
# the temperature, a mean over all particles, depends smoothly on A. This tutorial shows both, and
# how `jaxgran` differentiates the second.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxgran

jax.config.update("jax_enable_x64", True)
law = jaxgran.Viscoelastic(5e7, 0.22, 2e-5)
mass = jaxgran.sphere_mass(2e-3, 2500.0)
gas = jaxgran.Gas(law, diameter=2e-3, mass=mass, packing_fraction=0.1, temperature=0.01)
times = jnp.linspace(0.0, 40.0, 21)[1:] * gas.mean_free_time
model = jaxgran.HardSpheres(500)

# %% [markdown]
# First the chaos. Both runs start from the same particles; `save` keeps all positions at each time.


# %%
def positions(particles):
    return particles.position


quiet = {"progress": False}
keys = [jax.random.key(k) for k in range(4)]
starts = [jaxgran.cool(gas, times[:1], model=model, key=k, **quiet).particles for k in keys]


def run(factor, start=starts[0]):
    changed = gas.replace(dissipative_constant=2e-5 * factor)
    model = jaxgran.HardSpheres(500, start=start)
    return jaxgran.cool(changed, times, model=model, save=positions, **quiet)


def distance(a, b):
    side = starts[0].box_side
    shift = (a.saved - b.saved + side / 2) % side - side / 2
    return np.sqrt(np.mean(np.sum(np.asarray(shift) ** 2, axis=-1), axis=-1)) / gas.diameter


same, other = run(1.0), run(1 + 1e-9)
apart = distance(same, other)
growth = apart[-1] / apart[0]
print(f"{growth:.0e} times further apart after {same.collisions[-1]:.0f} collisions per sphere")
fig, axes = plt.subplots(figsize=(6, 4), layout="constrained")
axes.semilogy(same.collisions, apart, "o-", color="#e69f00")
axes.set(xlabel="collisions per sphere", ylabel="distance of the two runs / diameter")

# %% [markdown]
# The distance grows exponentially, by the factor printed above. Exact differentiation of the code
# would return this growth: a derivative of millions of diameters, which differs from run to run.
#
# `jaxgran` propagates tangents through every impact, but keeps only what a mean over particles
# depends on in a homogeneous gas: the scale of the velocities. A flow, which grows in boxes longer
# than $L_c$, is not kept. What remains is the derivative of the temperature. It is what `jax.jvp`,
# `jax.grad` and `jax.jacfwd` return:


# %%
def log_temperature(log_constant, model=None):
    changed = gas.replace(dissipative_constant=jnp.exp(log_constant))
    return jnp.log(jaxgran.cool(changed, times, model=model, **quiet).temperature)


at, model = jnp.log(2e-5), jaxgran.HardSpheres(500, start=starts[0])
_, slope = jax.jvp(lambda x: log_temperature(x, model), (at,), (1.0,))

# %% [markdown]
# Compare with differences of runs whose A differ by 40 %, from four initial states, and with the
# derivative of kinetic theory. A difference needs large steps and several pairs of runs, since the
# noise of each run is divided by the step; the tangent needs one run.

# %%
h = 0.2
pairs = [(run(np.exp(h), start), run(np.exp(-h), start)) for start in starts]
slopes = np.array([np.log(a.temperature / b.temperature) for a, b in pairs]) / (2 * h)
difference, noise = slopes.mean(axis=0), slopes.std(axis=0, ddof=1) / len(pairs) ** 0.5

# %%
fig, axes = plt.subplots(figsize=(6, 4), layout="constrained")
x = times / gas.mean_free_time
axes.errorbar(x, difference, noise, fmt="o", color="#222222", label="differences of 8 runs")
axes.plot(x, slope, color="#e69f00", label="tangent, one run")
axes.plot(x, jax.jacfwd(log_temperature)(at), "--", color="#0072b2", label="kinetic theory")
axes.set(xlabel="time / mean free time", ylabel="d ln T / d ln A")
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# A fit through `HardSpheres` follows these derivatives to its estimate in a few runs. In a dense
# gas that clusters the projection leaves a bias; `HardSpheres(..., differences=0.3)` then takes
# differences with common random numbers instead.
