# %% [markdown]
# # Learn the law of restitution itself
#
# What if no formula is known for ε(v), the coefficient of restitution at the impact speed
# v? A cooling gas visits a wide range of speeds. So we let the law be a smooth, monotone curve
# through free values, `jaxgran.RestitutionSpline`, and fit all of these to one measured T(t). The
# curve was simulated in LAMMPS, whose viscoelastic law we do not use.

# %%
import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxgran

jax.config.update("jax_enable_x64", True)
measurement = jaxgran.example_measurement()
grains, curve = measurement.gas, measurement.curve

# %% [markdown]
# The knots of the spline span the speeds of the impacts that cool the gas. In the fit,
# `free="law"` frees all numbers of the law. A prior decides where the data say nothing: the
# exponent of −ln ε ~ v^p changes by about 0.3 over a factor of ten in the speed.

# %%
low, high = jaxgran.RestitutionSpline.visited_speeds(curve.temperature)
law = jaxgran.RestitutionSpline(jnp.geomspace(low, high, 8))
learner = dataclasses.replace(grains, law=law)
result = jaxgran.fit(dataclasses.replace(measurement, gas=learner), free="law")
print(f"chi^2 per degree of freedom: {float(result.reduced_chi2):.2g}")

# %% [markdown]
# The band contains the whole law with a probability of 95 %, by all errors of the fit. Which
# formula does it contain? `compare` fits one to the band: chi^2 per degree of freedom is near 1 or
# less if the band contains such a law. For the viscoelastic law this also reads off A.

# %%
band = jaxgran.restitution_band(result)
rough_guess = grains.replace(dissipative_constant=1e-6)
chi2, p, viscoelastic = band.compare(rough_guess, "dissipative_constant")
print(f"viscoelastic: {chi2:.2g}, A = {float(viscoelastic.value('dissipative_constant')):.3g} s")
print(f"A of the simulated grains: {float(grains.dissipative_constant):.3g} s")
same = dataclasses.replace(grains, law=jaxgran.ConstantRestitution(0.9))
chi2, p, _ = band.compare(same, "coefficient")
print(f"constant restitution: {chi2:.2g}")

# %% [markdown]
# Below the law, the speeds of impacts: their distribution per ln v is v² exp(−v²/4T) at each
# time. Outside the shaded range of speeds, ε follows from the prior alone.

# %%
v = jnp.geomspace(low / 3, 2 * high, 100)
band = jaxgran.restitution_band(result, v)
true = grains.restitution(v)
shape = {"figsize": (6, 5), "height_ratios": [3, 1], "layout": "constrained"}
fig, (top, bottom) = plt.subplots(2, sharex=True, **shape)
top.axvspan(low, high, color="#999999", alpha=0.12)
top.fill_between(v, band.low, band.high, color="#0072b2", alpha=0.2)
top.semilogx(v, band.restitution, color="#0072b2", label="learnt from T(t)")
top.semilogx(v, true, "--", color="#222222", label="law of the simulated grains")
top.set(ylabel=r"$\epsilon(v)$")
top.legend(frameon=False)
for T in curve.temperature[jnp.array([1, 30, -1])]:
    bottom.fill_between(v, v**2 * jnp.exp(-(v**2) / (4 * T)) / T, alpha=0.4)
bottom.set(xlabel="impact speed v (m/s)", ylabel="impacts", yticks=[])
plt.show()
