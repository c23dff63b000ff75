# %% [markdown]
# # Learn the law of restitution itself
#
# What if no formula is known for $\epsilon(v)$, the coefficient of restitution at the impact speed
# $v$? A cooling gas visits a wide range of speeds, and `jaxgran.cool` is differentiable in every
# number of a law. So we let the law be a smooth curve through free values, and fit all of these to
# one measured $T(t)$. The curve was simulated in LAMMPS, whose viscoelastic law we do not use.

# %%
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import optimistix as optx

import jaxgran
from experiments.support.record import DATA

jax.config.update("jax_enable_x64", True)
curve, header = jaxgran.read_curve(DATA / "lammps_cooling_dilute.csv")
grains = jaxgran.read_gas(header)
times, T = curve.times[1:], curve.temperature[1:]
error = jnp.hypot(curve.temperature_error[1:] / T, 0.006)  # of points and of kinetic theory

# %% [markdown]
# The law: $\epsilon = 1 - e^{f(\ln v)}$, where $f$ is a sum of Gaussians at eight speeds, so that
# the loss is positive and smooth.

# %%
CENTRES = jnp.linspace(jnp.log(3e-4), jnp.log(1.0), 8)
WIDTH = CENTRES[1] - CENTRES[0]


class LearntLaw(jaxgran.RestitutionLaw):
    """A law given by weights of Gaussians in ln v."""

    weights: jax.Array
    domains: ClassVar = {"weights": jaxgran.Domain(-float("inf"))}
    lists: ClassVar = ("weights",)

    def restitution(self, normal_speed):
        x = (jnp.log(normal_speed + 1e-6)[..., None] - CENTRES) / WIDTH
        basis = jnp.exp(-(x**2) / 2)
        return 1 - jnp.exp(basis @ self.weights / jnp.sum(basis, axis=-1))


def gas(weights):
    return eqx.tree_at(lambda gas: gas.law, grains, LearntLaw(weights))


# %% [markdown]
# Least squares: the residuals of $\ln T$, and a prior that neighbouring weights do not bend much,
# which decides where the data say nothing. Levenberg-Marquardt takes the Jacobian in all eight
# weights from JAX.


# %%
@jax.jit
def residuals(weights, _=None):
    computed = jaxgran.cool(gas(weights), times).temperature
    bends = jnp.diff(weights, 2) / 0.3
    return jnp.concatenate([jnp.log(computed / T) / error, bends])


solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
solution = optx.least_squares(residuals, solver, jnp.full(8, jnp.log(0.1)), max_steps=60)
weights = solution.value
jacobian = jax.jacfwd(residuals)(weights)
covariance = jnp.linalg.inv(jacobian.T @ jacobian)
miss = jnp.abs(jnp.expm1(residuals(weights)[: times.size] * error)).max()
print(f"largest difference of T: {100 * miss:.2g} %")

# %% [markdown]
# The band is the linearised 95 % interval. Below, the speeds of impacts: their distribution is
# $v\,e^{-v^2/4T}$ at each time, so that the gas visits what lies between the first and the last.

# %%
v = jnp.geomspace(3e-4, 1.0, 100)
law, by_weight = jax.vmap(jax.value_and_grad(lambda w, v: LearntLaw(w).restitution(v)), (None, 0))(
    weights, v
)
band = 2 * jnp.sqrt(jnp.sum((by_weight @ covariance) * by_weight, axis=-1))
true = grains.replace(dissipative_constant=float(header["A"])).restitution(v)
fig, (top, bottom) = plt.subplots(
    2, sharex=True, figsize=(6, 5), height_ratios=[3, 1], layout="constrained"
)
top.fill_between(v, law - band, law + band, color="#0072b2", alpha=0.2)
top.semilogx(v, law, color="#0072b2", label="learnt from T(t)")
top.semilogx(v, true, "--", color="#222222", label="law of the simulated grains")
top.set(ylabel=r"$\epsilon(v)$", ylim=(0.75, 1.0))
top.legend(frameon=False)
for at in (0, 30, -1):
    bottom.fill_between(v, v**2 * jnp.exp(-(v**2) / (4 * T[at])) / T[at], alpha=0.4)
bottom.set(xlabel="impact speed v (m/s)", ylabel="impacts", yticks=[])
plt.show()
