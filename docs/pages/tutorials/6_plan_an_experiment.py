# %% [markdown]
# # Plan an experiment
#
# A drop-tower flight lasts some seconds, and 250 glass beads fly in it. Their temperature can be
# measured to 2 % at 30 times. Which range of the dissipative constant A will the flight give, and
# what should be measured in addition? A plan answers before the flight: it fits noise-free curves
# of the planned scene, with the same alternatives (walls, rotation, drag, ...) as a fit of data.

# %%
import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxgran

jax.config.update("jax_enable_x64", True)
beads = jaxgran.Viscoelastic(youngs_modulus=5e7, poisson_ratio=0.22, dissipative_constant=3e-6)
gas = jaxgran.Gas(beads, diameter=2e-3, mass=1e-5, packing_fraction=0.03, temperature=0.01)


def flight(end):
    """The planned measurement of a flight: T to 2 % at 30 times up to `end`, in seconds."""
    cooled = jaxgran.cool(gas, jnp.geomspace(0.1, end, 30))
    curve = jaxgran.CoolingCurve(
        cooled.times, cooled.temperature, temperature_error=0.02 * cooled.temperature
    )
    return jaxgran.Measurement(gas, curve, num_particles=250, errors_measured=True)


short = flight(10.0)

# %% [markdown]
# A candidate is a function that changes the planned measurement, or a further measurement. Three
# are worth their price here: a longer flight, beads of which a film shows that they do not rotate,
# and ten beads dropped onto each other, whose restitution is measured to 2 %.


# %%
def longer(measurement):
    return flight(40.0)


def no_rotation(measurement):
    return dataclasses.replace(measurement, absent=("roughness", "friction"))


def ten_drops(measurement):
    speed = jnp.linspace(0.05, 0.5, 10)
    eps = jnp.full(10, 0.9)  # any value: the plan computes it
    drops = jaxgran.DropTest(speed, eps, 0.02 * eps)
    return {"flight": measurement, "drops": jaxgran.Measurement(measurement.gas, drops)}


candidates = {"40 s": longer, "no rotation": no_rotation, "ten drops": ten_drops}
plan = jaxgran.plan(short, candidates=candidates)
print(plan)
jaxgran.plot_plan(plan)

# %% [markdown]
# Ten impacts tell more than a flight four times as long, because walls, rotation and viscoelastic
# impacts cool a gas alike. We fly, and drop ten beads. Here DSMC makes the flight, with the scatter
# of 250 beads, and the true law makes the drops.

# %%
key_of_flight, key_of_errors, key_of_drops = jax.random.split(jax.random.key(3), 3)
cooled = jaxgran.cool(gas, short.curve.times, model=jaxgran.DSMC(250), key=key_of_flight)
errors = 0.02 * jax.random.normal(key_of_errors, (30,))
T = cooled.temperature * jnp.exp(errors)
curve = jaxgran.CoolingCurve(cooled.times, T, temperature_error=0.02 * T)
flown = dataclasses.replace(short, data=curve)
speed = jnp.linspace(0.05, 0.5, 10)
eps = gas.restitution(speed) * (1 + 0.02 * jax.random.normal(key_of_drops, (10,)))
drops = jaxgran.Measurement(gas, jaxgran.DropTest(speed, eps, 0.02 * eps))

alone = jaxgran.fit(flown, free=("A", "T0"))
both = jaxgran.fit({"flight": flown, "drops": drops}, free="A", separate="T0")
print("the flight alone:", alone.headline)
print("with ten drops:  ", both.headline)

# %% [markdown]
# Does the range of such a flight hold the true A? Ten flights like this one are simulated with the
# fitted A, and fitted again; then ten of grains with the strongest effect that the data allow.

# %%
imitation = jaxgran.imitate(alone, runs=10, progress=False)
print(imitation)
plt.show()
