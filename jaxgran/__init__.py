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
>>> result = jaxgran.fit(gas, curve)  # estimates A
"""

from importlib import import_module
from typing import Any

from jaxgran._utils.status import explain as explain_status
from jaxgran._utils.validation import Domain
from jaxgran.data.curve import CoolingCurve, Particles, Run
from jaxgran.data.curve_file import (
    DropTest,
    read_absent,
    read_curve,
    read_drop_test,
    read_gas,
    read_priors,
    write_curve,
)
from jaxgran.data.particles import read_particles
from jaxgran.fitting.diagnosis import Diagnosis, diagnose, log_likelihood
from jaxgran.fitting.fit import fit
from jaxgran.fitting.learnt_law import restitution_band
from jaxgran.fitting.result import Fit
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.models.choose import Choice, choose_model
from jaxgran.models.cool import cool
from jaxgran.models.dsmc import DSMC
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.hard_spheres import HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.soft_spheres import SoftSpheres
from jaxgran.particles import observables
from jaxgran.scene.contact import Impact, contact_force, elastic_constant, impact
from jaxgran.scene.elements import Frictional, Rough, StokesDrag, Walls, WhiteNoise
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import sphere_mass
from jaxgran.scene.laws import (
    ConstantRestitution,
    ReducedLaw,
    RestitutionLaw,
    RestitutionSeries,
    RestitutionSpline,
    Viscoelastic,
    viscoelastic_restitution,
)
from jaxgran.sweep import sweep
from jaxgran.theory.equations import SteadyState, steady_state

__all__ = [
    "DSMC",
    "AbstractModel",
    "Choice",
    "ConstantRestitution",
    "CoolingCurve",
    "Diagnosis",
    "Domain",
    "DropTest",
    "ErrorModel",
    "Fit",
    "Frictional",
    "Gas",
    "HardSpheres",
    "Impact",
    "KineticTheory",
    "Limitation",
    "Particles",
    "ReducedLaw",
    "RestitutionLaw",
    "RestitutionSeries",
    "RestitutionSpline",
    "Rough",
    "Run",
    "SoftSpheres",
    "SteadyState",
    "StokesDrag",
    "Viscoelastic",
    "Walls",
    "WhiteNoise",
    "choose_model",
    "contact_force",
    "cool",
    "diagnose",
    "elastic_constant",
    "explain_status",
    "fit",
    "impact",
    "log_likelihood",
    "observables",
    "read_absent",
    "read_curve",
    "read_drop_test",
    "read_gas",
    "read_particles",
    "read_priors",
    "restitution_band",
    "sphere_mass",
    "steady_state",
    "sweep",
    "viscoelastic_restitution",
    "write_curve",
]


_PLOT_FUNCTIONS = ("plot_curve", "plot_fit")
"""Functions of `jaxgran.plotting`, which is imported with matplotlib when one is first used."""


def __getattr__(name: str) -> Any:
    if name in _PLOT_FUNCTIONS:
        return getattr(import_module("jaxgran.plotting"), name)
    raise AttributeError(f"module 'jaxgran' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, *_PLOT_FUNCTIONS]
