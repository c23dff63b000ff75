"""Base classes for your own laws of restitution and models.

A law is a subclass of `RestitutionLaw`; a `Domain` gives the range of each parameter. A law that
depends on the size or the mass of the spheres returns a `ReducedLaw`. A model is a subclass of
`AbstractModel`: it runs with the options of a `Run`, estimates its error with an `ErrorModel` and
lists what it leaves out, each as a `Limitation`.

>>> from jaxgran import extend
>>> class Plastic(extend.RestitutionLaw):
...     yield_speed: float  # m/s
...     domains = {"yield_speed": extend.Domain(0.0)}
...
...     def restitution(self, normal_speed):
...         return (1 + (normal_speed / self.yield_speed) ** 2) ** -0.125
>>> float(Plastic(0.2).restitution(0.0))
1.0
"""

from jaxgran._utils.validation import Domain as Domain
from jaxgran.data.run_options import Run as Run
from jaxgran.models.base import AbstractModel as AbstractModel
from jaxgran.models.base import Limitation as Limitation
from jaxgran.models.error_model import ErrorModel as ErrorModel
from jaxgran.scene.laws import ReducedLaw as ReducedLaw
from jaxgran.scene.laws import RestitutionLaw as RestitutionLaw

__all__ = [
    "AbstractModel",
    "Domain",
    "ErrorModel",
    "Limitation",
    "ReducedLaw",
    "RestitutionLaw",
    "Run",
]
