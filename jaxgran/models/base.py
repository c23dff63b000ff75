"""The interface of a model of a cooling gas."""

import re
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractClassVar
from jaxtyping import Array, Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run_options import Run
from jaxgran.models.error_model import ErrorModel
from jaxgran.scene.gas import Gas


class Limitation(NamedTuple):
    """An effect that a scene contains and a model leaves out.

    Attributes:
        words: the effect, as the clause of a sentence.
        decisive: True if the estimates of a fit cannot be trusted; False if the scene is at the
            edge of validity.
        remedy: a sentence that names a model with this effect.

    >>> [limitation.words for limitation in jaxgran.KineticTheory().limitations(gas)]
    []
    """

    words: str
    decisive: bool
    remedy: str


class AbstractModel(eqx.Module):
    """A model of a cooling gas: a description, without state and without the options of a run.

    A subclass defines the members below; it then works in `jaxgran.cool`, `jaxgran.fit` and
    `jaxgran.choose_model`, which use no other members. Numbers that a user may differentiate or
    sweep are array fields, counts and choices are static fields. If a member is missing, creating
    the model raises a TypeError that names it.

    `jaxgran.DSMC` is a short example; `experiments/fit/own_model.py` defines one in 25 lines.

    >>> jaxgran.KineticTheory().name, jaxgran.DSMC(1000).stochastic
    ('kinetic theory', True)
    >>> isinstance(jaxgran.HardSpheres(100), jaxgran.extend.AbstractModel)
    True
    """

    stochastic: AbstractClassVar[bool]
    """True if curves carry random noise. A fit then makes repeated runs with fresh random numbers,
    takes the noise from ``curve.replicas`` and needs at least two replicas."""

    derivative_accuracy: AbstractClassVar[float]
    """Relative accuracy of a derivative of ln T in a parameter. A fit treats parameters whose
    effects differ by less as undetermined."""

    saves: ClassVar[bool] = False
    """True if the model has particles, so that a run can return `CoolingCurve.saved`."""

    has_positions: ClassVar[bool] = False
    """True if the model has positions, so that a run can write a trajectory."""

    elements: ClassVar[tuple[str, ...]] = ()
    """Elements that the model supports in addition to smooth spheres in free flight: see
    `Gas.elements`."""

    def check_scene(self, gas: Gas) -> None:
        """Refuse the elements of a scene that the model does not support, then call `check`.

        Raises:
            ValueError: naming the unsupported element and the models that support it.
        """
        for name in gas.elements:
            if name not in self.elements:
                field = "surface" if name == "friction" else name
                if name == "diameter_sd":
                    raise ValueError(
                        f"{type(self).__name__} has equal spheres and does not support "
                        "diameter_sd. Use KineticTheory, or set diameter_sd=None."
                    )
                given = type(getattr(gas, field)).__name__
                models = " or ".join(_models_with(name))
                instead = ", or surface=Rough(...) for impacts" if name == "friction" else ""
                raise ValueError(
                    f"{type(self).__name__} does not support `{field}={given}`. Use {models}"
                    f"{instead}, or set {field}=None."
                )
        self.check(gas)

    def solve(self, gas: Gas, times: Float[Array, "times"], tolerance: Any) -> CoolingCurve:
        """Return the curve inside the compiled program of a fit, by default by `simulate`.

        A model that solves equations multiplies its tolerance by `tolerance`.
        """
        return self.simulate(gas, times, Run())

    def solve_with_tangents(
        self,
        gas: Gas,
        times: Float[Array, "times"],
        tolerance: Any,
        gas_tangents: Gas,
        shift_tangents: Any,
    ) -> tuple[CoolingCurve, CoolingCurve]:
        """Return the curve of `solve`, and its derivatives along some directions.

        Args:
            gas, times, tolerance: as of `solve`.
            gas_tangents: tangents of the gas, with a first axis (directions,).
            shift_tangents: tangents of a shift of all times, shape (directions,).
        """

        def curve(gas: Gas, shift: Array) -> CoolingCurve:
            return self.solve(gas, times + shift, tolerance)

        def with_tangents(*tangents: Any) -> tuple[CoolingCurve, CoolingCurve]:
            return jax.jvp(curve, (gas, jnp.zeros((), times.dtype)), tangents)

        return jax.vmap(with_tangents, out_axes=(None, 0))(gas_tangents, shift_tangents)

    def simplified_for(self, *gases: Gas, displacement: bool = False) -> "AbstractModel":
        """Return the model that computes the curves of some gases in fits: by default this one.

        Args:
            gases: the scenes.
            displacement: whether <dr^2> is needed.
        """
        return self

    def sized_for(self, gas: Gas, spare: float = 2.0) -> "AbstractModel":
        """Return this model with fixed sizes of its arrays, for `jax.jit`.

        That is the model itself, unless its arrays grow with the need, as in
        `jaxgran.HardSpheres` and `jaxgran.SoftSpheres`.
        """
        return self

    def check_save(self, save: Any) -> None:
        """Raise ValueError if `save` is not a function, or the model has no particles."""
        if save is None:
            return
        if not (callable(save) or save == "particles"):
            raise ValueError(
                'save must be a function of the particles of a replica, or "particles", got '
                f"{save!r:.60}"
            )
        if not self.saves:
            raise ValueError(
                f"{type(self).__name__} has no particles to save. Use DSMC, HardSpheres or "
                "SoftSpheres, or set save=None."
            )

    @abstractmethod
    def check(self, gas: Gas) -> None:
        """Check that the model supports this law and scene. Traced values pass unchecked.

        Raises:
            ValueError: with what was given, what is allowed and what to do.
        """

    @abstractmethod
    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run) -> CoolingCurve:
        """Return the cooling curve at the given times.

        Inside `jax.jit`, `jax.vmap` and derivatives this is a pure function. ``curve.status``
        reports a failure, and values that could not be computed are nan.

        Args:
            gas: a scene that has passed `check`.
            times: t, s, increasing, >= 0.
            run: options of this run.
        """

    @abstractmethod
    def estimated_error(self, error_model: ErrorModel) -> float:
        """Estimated relative error of T at the worst time, noise included."""

    def rate_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"] | float:
        """Estimated relative error of the cooling rate, without noise.

        It is given at the times of `error_model`. The error bars of a fit contain it. The default
        is `derivative_accuracy`, or 0 for a stochastic model.
        """
        return 0.0 if self.stochastic else self.derivative_accuracy

    def derivative_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"] | float:
        """Estimated relative error by which the derivatives of ln T may be too large.

        It comes in addition to `derivative_accuracy`, at the times of `error_model`, and is 0 by
        default. The error bars of a fit contain it.
        """
        return 0.0

    @abstractmethod
    def limitations(self, gas: Gas, num_particles: int | None = None) -> tuple[Limitation, ...]:
        """Return the effects that the model leaves out of a scene, the most serious first.

        Args:
            gas: the scene.
            num_particles: N of the gas, or None if it is unknown.

        Returns:
            A tuple, empty if the model leaves out nothing that matters.
        """

    def check_fit(self, names: tuple[str, ...]) -> None:
        """Check that the named parameters of a gas can be fitted through this model (default: all).

        Raises:
            ValueError: naming the parameters that cannot be fitted, with the reason.
        """

    def rotation_accuracy(self, gas: Gas) -> float:
        """Relative accuracy of T_rot/T of rough spheres; 7 % by default."""
        return 0.07

    def displacement_accuracy(self, gas: Gas) -> Float[Array, ""] | None:
        """Relative accuracy of <dr^2>; None (the default) if a fit should not use <dr^2>.

        A model that returns a number computes <dr^2> and the number of collisions of this gas.
        """
        return None

    @property
    def has_contacts(self) -> bool:
        """Whether contacts of its spheres hold energy, which scatters T; False by default."""
        return False

    @property
    def name(self) -> str:
        """Name of the model in a sentence: "soft spheres" for `SoftSpheres`."""
        words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(self).__name__).split()
        return " ".join(word if word.isupper() else word.lower() for word in words)


def _models_with(element: str) -> list[str]:
    """Return the names of the models of this package that support an element."""

    def below(cls: type[AbstractModel]) -> list[type[AbstractModel]]:
        return [x for sub in cls.__subclasses__() for x in (sub, *below(sub))]

    known = [x for x in below(AbstractModel) if x.__module__.startswith("jaxgran.")]
    return sorted({x.__name__ for x in known if element in x.elements})
