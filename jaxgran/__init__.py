"""Differentiable granular gases in JAX.

The examples in the docstrings use these definitions:

>>> import dataclasses, jax, jax.numpy as jnp, jaxgran
>>> jax.config.update("jax_enable_x64", True)
>>> beads = jaxgran.Viscoelastic(youngs_modulus=5e7, poisson_ratio=0.22, dissipative_constant=3e-6)
>>> gas = jaxgran.Gas(beads, diameter=2e-3, mass=1e-5, packing_fraction=0.05, temperature=0.01)
>>> times = jnp.array([0.1, 0.3, 1.0, 3.0])  # s
>>> cooled = jaxgran.cool(gas, times)
>>> error = 0.01 * cooled.temperature
>>> curve = jaxgran.CoolingCurve(times, cooled.temperature, temperature_error=error)
>>> measurement = jaxgran.Measurement(gas, curve, num_particles=10**6)
>>> result = jaxgran.fit(measurement)  # estimates A
"""

from importlib import import_module
from typing import Any

from jaxgran import extend as extend
from jaxgran._utils.status import explain as explain_status
from jaxgran.data.curve import CoolingCurve as CoolingCurve
from jaxgran.data.curve_file import read_curve as read_curve
from jaxgran.data.curve_file import write_curve as write_curve
from jaxgran.data.drop_test import DropTest as DropTest
from jaxgran.data.example import example_measurement as example_measurement
from jaxgran.data.lammps import lammps_commands as lammps_commands
from jaxgran.data.measurement import Measurement as Measurement
from jaxgran.data.measurement_file import read_measurement as read_measurement
from jaxgran.data.particle_file import read_particles as read_particles
from jaxgran.data.particles import Particles as Particles
from jaxgran.data.track_impacts import Impacts as Impacts
from jaxgran.data.track_impacts import read_impacts as read_impacts
from jaxgran.fitting.alternatives import Alternative as Alternative
from jaxgran.fitting.fit import fit as fit
from jaxgran.fitting.imitate import Imitation as Imitation
from jaxgran.fitting.imitate import imitate as imitate
from jaxgran.fitting.learnt_law import RestitutionBand as RestitutionBand
from jaxgran.fitting.learnt_law import restitution_band as restitution_band
from jaxgran.fitting.likelihood import log_likelihood as log_likelihood
from jaxgran.fitting.plan import Expected as Expected
from jaxgran.fitting.plan import Plan as Plan
from jaxgran.fitting.plan import plan as plan
from jaxgran.fitting.result import Fit as Fit
from jaxgran.models.choose import Choice as Choice
from jaxgran.models.choose import choose_model as choose_model
from jaxgran.models.cool import cool as cool
from jaxgran.models.dsmc import DSMC as DSMC
from jaxgran.models.hard_spheres import HardSpheres as HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory as KineticTheory
from jaxgran.models.soft_spheres import SoftSpheres as SoftSpheres
from jaxgran.particles import observables as observables
from jaxgran.scene.contact import Impact as Impact
from jaxgran.scene.contact import contact_force as contact_force
from jaxgran.scene.contact import elastic_constant as elastic_constant
from jaxgran.scene.contact import impact as impact
from jaxgran.scene.elements import Frictional as Frictional
from jaxgran.scene.elements import Rough as Rough
from jaxgran.scene.elements import StokesDrag as StokesDrag
from jaxgran.scene.elements import WhiteNoise as WhiteNoise
from jaxgran.scene.gas import Gas as Gas
from jaxgran.scene.geometry import sphere_mass as sphere_mass
from jaxgran.scene.laws import ConstantRestitution as ConstantRestitution
from jaxgran.scene.laws import RestitutionSeries as RestitutionSeries
from jaxgran.scene.laws import RestitutionSpline as RestitutionSpline
from jaxgran.scene.laws import Viscoelastic as Viscoelastic
from jaxgran.scene.laws import viscoelastic_restitution as viscoelastic_restitution
from jaxgran.scene.walls import Walls as Walls
from jaxgran.sweeps import sweep as sweep
from jaxgran.theory.steady_states import SteadyState as SteadyState
from jaxgran.theory.steady_states import steady_state as steady_state

__all__ = [
    "Alternative",
    "Choice",
    "ConstantRestitution",
    "CoolingCurve",
    "DSMC",
    "DropTest",
    "Expected",
    "Fit",
    "Frictional",
    "Gas",
    "HardSpheres",
    "Imitation",
    "Impact",
    "Impacts",
    "KineticTheory",
    "Measurement",
    "Particles",
    "Plan",
    "RestitutionBand",
    "RestitutionSeries",
    "RestitutionSpline",
    "Rough",
    "SoftSpheres",
    "SteadyState",
    "StokesDrag",
    "Viscoelastic",
    "Walls",
    "WhiteNoise",
    "choose_model",
    "contact_force",
    "cool",
    "elastic_constant",
    "example_measurement",
    "explain_status",
    "extend",
    "fit",
    "imitate",
    "impact",
    "lammps_commands",
    "log_likelihood",
    "observables",
    "plan",
    "read_curve",
    "read_impacts",
    "read_measurement",
    "read_particles",
    "restitution_band",
    "sphere_mass",
    "steady_state",
    "sweep",
    "viscoelastic_restitution",
    "write_curve",
]

_PLOT_FUNCTIONS = ("plot_curve", "plot_fit", "plot_plan")
"""Functions of `jaxgran.plotting`, which is imported with matplotlib when one is first used."""


def __getattr__(name: str) -> Any:
    if name in _PLOT_FUNCTIONS:
        return getattr(import_module("jaxgran.plotting"), name)
    raise AttributeError(f"module 'jaxgran' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, *_PLOT_FUNCTIONS]
