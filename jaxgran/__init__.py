"""jaxgran: differentiable granular gases in JAX."""

from jaxgran.choice import Choice, choose_model
from jaxgran.contact import Impact, contact_force, elastic_constant, impact
from jaxgran.cooling import cool
from jaxgran.curve import CoolingCurve, Particles, read_curve, read_gas, write_curve
from jaxgran.diagnosis import Diagnosis, diagnose
from jaxgran.estimate import Fit
from jaxgran.fitting import fit
from jaxgran.gas import Gas, sphere_mass
from jaxgran.models.dsmc import DSMC
from jaxgran.models.hard_spheres import HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.soft_spheres import SoftSpheres
from jaxgran.restitution import (
    ConstantRestitution,
    ReducedLaw,
    RestitutionLaw,
    RestitutionSeries,
    Viscoelastic,
    viscoelastic_restitution,
)
from jaxgran.status import explain as explain_status

__all__ = [
    "DSMC",
    "Choice",
    "ConstantRestitution",
    "CoolingCurve",
    "Diagnosis",
    "Fit",
    "Gas",
    "HardSpheres",
    "Impact",
    "KineticTheory",
    "Particles",
    "ReducedLaw",
    "RestitutionLaw",
    "RestitutionSeries",
    "SoftSpheres",
    "Viscoelastic",
    "choose_model",
    "contact_force",
    "cool",
    "diagnose",
    "elastic_constant",
    "explain_status",
    "fit",
    "impact",
    "read_curve",
    "read_gas",
    "sphere_mass",
    "viscoelastic_restitution",
    "write_curve",
]
