"""The interface of a model of a cooling gas."""

import re
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from equinox import AbstractClassVar
from jaxtyping import Array, Float

from jaxgran.data.curve import CoolingCurve, Run
from jaxgran.models.error_model import ErrorModel
from jaxgran.scene.gas import Gas

ELEMENTS = {
    "surface": "rough spheres (surface=Rough)",
    "friction": "friction between spheres (surface=Frictional)",
    "container": "walls (container)",
    "drag": "drag",
    "drive": "a drive (drive)",
    "preparation": "a driven start (preparation)",
}
"""Words for the elements of a scene."""

TAKE_IT = "KineticTheory(), DSMC(N) or HardSpheres(N), which take it"
"""What to use for an element that a model does not take."""

SUPPORTED_BY = {
    "friction": "SoftSpheres(N), which takes it, or surface=Rough(...) for instantaneous impacts",
    "container": "KineticTheory(), DSMC(N), HardSpheres(N) or SoftSpheres(N), which take it",
    "drag": "KineticTheory(), DSMC(N), HardSpheres(N) or SoftSpheres(N), which take it",
}
"""The same for elements that other models take."""


class Limitation(NamedTuple):
    """Something that a model leaves out and a scene contains.

    Attributes:
        words: what, as the clause of a sentence.
        decisive: estimates of a fit cannot be trusted; else the scene is at the edge of validity.
        remedy: a sentence saying which model contains it.

    >>> [omission.words for omission in jaxgran.KineticTheory().omissions(gas)]
    []
    """

    words: str
    decisive: bool
    remedy: str


class AbstractModel(eqx.Module):
    """A model of a cooling gas: a description, without state and without the options of a run.

    A subclass defines the members below; it then works in `jaxgran.cool`, `jaxgran.fit`,
    `jaxgran.choose_model` and `jaxgran.diagnose`, which ask the model nothing else. Numbers that a
    person may differentiate or sweep are array fields, counts and choices are static fields. A
    missing member is named by the TypeError that creating the model raises.

    `jaxgran.DSMC` is a short example; `tests/models/test_own_model.py` defines one in 25 lines.

    >>> jaxgran.KineticTheory().name, jaxgran.DSMC(1000).stochastic
    ('kinetic theory', True)
    >>> isinstance(jaxgran.HardSpheres(100), jaxgran.AbstractModel)
    True
    """

    stochastic: AbstractClassVar[bool]
    """Whether curves carry random noise. A fit then makes repeated runs with fresh random numbers,
    takes the noise from ``curve.replicas`` and needs two replicas at least."""

    derivative_accuracy: AbstractClassVar[float]
    """Relative accuracy of a derivative of ln T in a parameter. Parameters whose effects differ by
    less count as undetermined."""

    saves: ClassVar[bool] = False
    """Whether curves have `CoolingCurve.saved` where a run asks for it: the model has particles."""

    has_positions: ClassVar[bool] = False
    """Whether it writes a trajectory where a run asks for it."""

    rotation_accuracy: ClassVar[float] = 0.07
    """Relative accuracy of T_rot/T of rough spheres."""

    elements: ClassVar[tuple[str, ...]] = ()
    """What the model takes besides smooth spheres in free flight: see `Gas.elements`."""

    def check_scene(self, gas: Gas) -> None:
        """`check`, after refusing the elements of a scene that the model does not take."""
        for name in gas.elements:
            if name not in self.elements:
                raise ValueError(
                    f"{type(self).__name__} does not take {ELEMENTS[name]}: use "
                    f"{SUPPORTED_BY.get(name, TAKE_IT)}, or "
                    f"leave {'surface' if name == 'friction' else name} out of the gas"
                )
        self.check(gas)

    def check_save(self, save: Any) -> None:
        """Raise ValueError for something to save that is no function, or of no particles."""
        if save is None:
            return
        if not (callable(save) or save == "particles"):
            raise ValueError(
                'save must be a function of the particles of a replica, or "particles", got '
                f"{save!r:.60}"
            )
        if not self.saves:
            raise ValueError(
                f"{type(self).__name__} has no particles of which something could be saved: leave "
                "save out, or use DSMC(N), HardSpheres(N) or SoftSpheres(N)"
            )

    @abstractmethod
    def check(self, gas: Gas) -> None:
        """Check that the model can take this law and scene. Traced values pass unchecked.

        Raises:
            ValueError: saying what was given, what is allowed and what to do.
        """

    @abstractmethod
    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run) -> CoolingCurve:
        """The cooling curve at the given times.

        Inside `jax.jit`, `jax.vmap` and derivatives this is a pure function. A failure is reported
        by ``curve.status``, and values that could not be computed are nan.

        Args:
            gas: a scene that has passed `check`.
            times: t, s, increasing, >= 0.
            run: options of this run.
        """

    @abstractmethod
    def estimated_error(self, error_model: ErrorModel) -> float:
        """Estimated relative error of T at the worst time of a gas's course, noise included."""

    def rate_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"] | float:
        """Estimated relative error of the cooling rate along a gas's course, without noise.

        The error bars of a fit contain it. By default `derivative_accuracy`, or 0 for a stochastic
        model.
        """
        return 0.0 if self.stochastic else self.derivative_accuracy

    def derivative_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"] | float:
        """Estimated relative error of the derivatives of ln T along a gas's course, beyond
        `derivative_accuracy`: they may be too large by it. The error bars of a fit contain it.
        """
        return 0.0

    @abstractmethod
    def limitations(self, gas: Gas, num_particles: int | None = None) -> tuple[Limitation, ...]:
        """What the model leaves out of a scene, the most serious first; () if nothing matters.

        Args:
            gas: the scene.
            num_particles: N of the gas, or None if it is unknown.
        """

    def check_fit(self, names: tuple[str, ...]) -> None:
        """Check that the named floats of a gas can be fitted through this model (default: all).

        Raises:
            ValueError: saying which cannot, and why.
        """

    def displacement_accuracy(self, gas: Gas) -> Float[Array, ""] | None:
        """Relative accuracy of <dr^2>; None (the default) if a fit should not use it."""
        return None

    @property
    def name(self) -> str:
        """The model's name in a sentence: "soft spheres" for `SoftSpheres`."""
        parted = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(self).__name__)
        return " ".join(word if word.isupper() else word.lower() for word in parted.split())
