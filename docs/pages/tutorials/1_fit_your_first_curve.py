# %% [markdown]
# # Fit your first cooling curve
#
# A granular gas is a cloud of grains that lose energy at every impact, so that its temperature
# T = ⟨v²⟩/3 falls. How fast it falls depends on one number of the material, the
# dissipative constant A (in seconds) of viscoelastic spheres. This tutorial estimates A from a
# curve T(t) of 60 points, simulated in LAMMPS with 4000 spheres, and asks whether to believe it.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxgran

jax.config.update("jax_enable_x64", True)
measurement = jaxgran.example_measurement()
print(measurement)

# %% [markdown]
# A curve file is a header with the gas (packing fraction, diameter, density, Young's modulus,
# Poisson's ratio, all in SI units), the number of spheres and of runs, and columns `t,T,T_err`. The
# value of A in this header is the one used in LAMMPS; a fit of A does not use it.
#
# We leave A and the initial temperature T₀ free. The model is kinetic theory, a set of
# ordinary differential equations for T and for the shape of the velocity distribution, and JAX
# gives the fit its exact derivatives.

# %%
result = jaxgran.fit(measurement, free=("A", "T0"))
A, error = (float(x) for x in result.value("dissipative_constant"))
used = float(measurement.gas.dissipative_constant)
print(f"A = {A:.4g} +- {error:.1g} s; used in LAMMPS: {used:.4g} s")
jaxgran.plot_fit(result)

# %% [markdown]
# The points of the lower panel are residuals in units of their standard deviation, each without
# what is expected from the points before it. The error of A has several causes.

# %%
for cause, part in result.error_budget.items():
    print(f"{cause:>24}: {100 * part[0] / A:.2g} % of A")

# %% [markdown]
# A good fit does not prove the model: another law of loss might explain the same curve with another
# A. So `fit` compares such alternatives, too (drag, rough grains, walls, a noise floor, a late
# clock) and gives the range of A over all that the curve does not exclude.

# %%
print(result.verdict)
low, high = (float(x[0]) for x in result.ranges["dissipative_constant"])
print(f"range of A over all alternatives: {low:.3g} to {high:.3g} s")

# %% [markdown]
# A determines the coefficient of restitution at every impact speed, ε(v): slow impacts
# are more elastic. The grey band shows the alternatives, and the vertical lines the typical impact
# speeds at the first and the last point.

# %%
v = np.geomspace(1e-4, 1.0, 100)
fig, axes = plt.subplots(figsize=(6, 4), layout="constrained")
laws = {a: result.gas.replace(dissipative_constant=a).restitution(v) for a in (A, low, high)}
axes.fill_between(v, laws[low], laws[high], color="0.85", label="range over all alternatives")
axes.semilogx(v, laws[A], color="#0072b2", label=f"A = {1e6 * A:.2f} µs")
first, last = measurement.curve.temperature[0], measurement.curve.temperature[-1]
for T in (first, last):
    axes.axvline((2 * float(T)) ** 0.5, color="0.5", ls=":")
axes.set(xlabel="impact speed v (m/s)", ylabel=r"coefficient of restitution $\epsilon$")
axes.legend(frameon=False)
plt.show()
