"""How do I add my own model? Haff's law in closed form, compared with kinetic theory.

    python experiments/fit/own_model.py [--record] [--out DIR]

Prints T of a gas with a constant coefficient of restitution by both models, the model that
`choose_model` selects, and a fit of that coefficient and of T_0 by the new model, and draws the
fit.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.closed_forms import haff
from experiments.support.record import run_parts
from experiments.support.scenes import hard_beads


class HaffLaw(jaxgran.extend.AbstractModel):
    """Haff's law: spheres of constant restitution, whose velocities stay Maxwellian."""

    stochastic: ClassVar[bool] = False  # curves have no noise
    derivative_accuracy: ClassVar[float] = 0.02  # error of Enskog's collision frequency

    def check(self, gas):
        if not isinstance(gas.law, jaxgran.ConstantRestitution):
            raise ValueError("HaffLaw needs ConstantRestitution; use jaxgran.KineticTheory")

    def simulate(self, gas, times, run):
        tau = gas.collision_frequency * times
        T = gas.temperature * haff(tau, gas.value("coefficient"), gas.dimension)
        return jaxgran.CoolingCurve(times=times, temperature=T)

    def estimated_error(self, error_model):
        # a_2 changes the cooling rate by a fraction 3 a_2 / 16.
        of_rate = error_model.homogeneous + 3 / 16 * np.abs(error_model.sonine)
        return error_model.error_of_temperature(of_rate)

    def limitations(self, gas, num_particles=None):
        if float(gas.value("coefficient")) > 0.7:
            return ()
        remedy = "This scene needs kinetic theory, which includes a_2."
        return (jaxgran.extend.Limitation("velocities are not Maxwellian", True, remedy),)


def own_model(_) -> dict:
    gas = hard_beads(packing_fraction=0.02, restitution=0.9)
    times = jnp.geomspace(1, 300, 9) * gas.mean_free_time
    models = (HaffLaw(), jaxgran.KineticTheory())
    own, theory = (jaxgran.cool(gas, times, model=model).temperature for model in models)
    choice = jaxgran.choose_model(gas, times, 0.05, models=models)

    times = jnp.geomspace(0.3, 300, 40) * gas.mean_free_time
    exact = jaxgran.cool(gas, times).temperature
    noise = 0.01 * jax.random.normal(jax.random.key(0), times.shape)
    curve = jaxgran.CoolingCurve(times, exact * jnp.exp(noise), temperature_error=0.01 * exact)
    free = ("coefficient", "temperature")
    measurement = jaxgran.Measurement(gas.replace(coefficient=0.5), curve)
    result = jaxgran.fit(measurement, model=HaffLaw(), free=free)
    print(result)
    return {
        "T_over_theory": own / theory,
        "choice": choice.reasons[0],
        "fitted": {name: result.value(name) for name in free},
        "verdict": result.verdict,
        "picture": jaxgran.plot_fit(result)[0].figure,
    }


if __name__ == "__main__":
    run_parts(__doc__, own_model, smoke=False)
