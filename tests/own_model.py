"""A model of a user's own, as `jaxgran.extend` allows it: Haff's law."""

from typing import ClassVar

import numpy as np

import jaxgran


def haff(tau, coefficient, dimension=3):
    """T/T_0 of Maxwellian spheres of constant restitution, after tau mean free times."""
    return (1 + (1 - coefficient**2) / (2 * dimension) * tau) ** -2.0


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
