"""Kinetic theory of a homogeneous gas: seven ordinary differential equations."""

import dataclasses
from collections.abc import Collection, Iterable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils import status, validation
from jaxgran._utils.tracing import (
    any_traced,
    array_module,
    in_compiled_code,
    pad_to,
    truncate_to,
)
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run_options import Run
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.limitations import limitations_of_homogeneity, limitations_of_instant_impacts
from jaxgran.models.scales import first_cooling_rate
from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced import reduced_scene
from jaxgran.theory.covariance import run_covariance
from jaxgran.theory.density import Density, softness_factor
from jaxgran.theory.elements import SUPPORTED
from jaxgran.theory.equations import Equations, SceneAndDensity
from jaxgran.theory.moments import Moments
from jaxgran.theory.solver import MomentSolver, padded_length

TOLERANCES = validation.Domain(0.0, 0.1)
"""Relative tolerances of the solver."""

SONINES = validation.Domain(-0.4, 1.0)
"""Values of a_2 at t = 0; spheres of one speed have -0.4, disks -0.5."""

NUM_GRID_TIMES = 97
"""Number of times between which a covariance is propagated, in addition to the given ones."""

MAX_SEARCHED_SPREAD = 0.3
"""diameter_sd over the diameter up to which a search computes curves."""

SPIN_CUMULANTS_ACCURACY = {2: 0.05, 3: 0.03}
"""Relative accuracy of T_rot/T with the correlation and kurtosis of spins, by dimension."""

GAUSSIAN_SPINS_ACCURACY = 0.07
"""Relative accuracy of T_rot/T with Gaussian spins."""

WALLS_ACCURACY = 0.15
"""Relative accuracy of T_rot/T between walls."""

SLIDING_ACCURACY = 0.2
"""Relative accuracy of T_rot/T of spheres that slide and rotated at t = 0, or have rough walls."""

ALL_CORRECTIONS = ("correlations", "diffusion", "softness", "sonine", "spin_cumulants")
"""Names of the corrections of `KineticTheory`."""


def _checked_corrections(names: Any) -> tuple[str, ...]:
    """Return names of corrections in alphabetical order.

    Raises:
        ValueError: for anything but a collection of names of `ALL_CORRECTIONS`.
    """
    given = [names] if isinstance(names, str) or not isinstance(names, Iterable) else [*names]
    if isinstance(names, str) or any(name not in ALL_CORRECTIONS for name in given):
        raise ValueError(
            f"corrections must be a collection of some of {', '.join(ALL_CORRECTIONS)}, got "
            f"{names!r:.60}. Leave it out for all; () is Enskog's theory of a Maxwellian gas."
        )
    return tuple(sorted(set(given)))


class ReducedUnits(NamedTuple):
    """Units of `jaxgran.theory.averages` in SI: `Gas.path_length` and `Gas.impact_speed`."""

    length: Float[Array, ""]
    speed: Float[Array, ""]


class KineticTheory(AbstractModel):
    """Homogeneous cooling gas by Maxwell-Sonine kinetic theory, integrated with diffrax.

    ``dT/dt = -(2/d) mu_2 T (1 - c X_T/sigma)/(1 + k X_T/sigma) (1 - h)``,
    ``da_2/dt = (4/d) mu_2 (1 + a_2) - 4 mu_4/(d(d+2))``, ``da_3/dt = 3 da_2/dt - (6/d) mu_2 (1 +
    3 a_2 - a_3) + 8 mu_6/(d(d+2)(d+4))``, ``d<dr^2>/dt = 2 d D``, ``dN/dt = nu``, and two moments
    of labelled velocities for D, the first ``dD/dt = T - nu_v D``. All but T start from 0, and the
    averages over impacts are exact in eps(v) (`jaxgran.theory.averages.impact_moments`). c and k
    correct for contacts that last, h for correlated velocities (`jaxgran.theory.density`).
    The theory leaves out clustering: it holds in boxes below L_c with short contacts. The averages
    assume that eps(v) is smooth: for a law with a kink, such as an eps capped at 1, use
    `jaxgran.DSMC`; T of ice, which becomes elastic at low speed, is 3 % off after some 1e5 mean
    free times.

    Supports all elements of a scene but lasting friction, in a homogeneous gas: rough spheres, with
    T_rot, with the correlation and the kurtosis of spins to first order (T within 1.2 % of DSMC;
    T_rot/T: see `rotation_accuracy`); walls, with the denser layer before them
    (`jaxgran.scene.walls`); drag; a drive by white noise. Between walls the curve has no D and
    <dr^2>.

    Spheres of unequal sizes (`Gas.diameter_sd`) are two halves of small and large spheres with a
    temperature each (`jaxgran.theory.sizes`). They may have Stokes' drag;
    roughness, walls and a drive are refused, and the curve has no D and <dr^2>. The rate of runs of
    1 : 1.2 and 1 : 1.4 and of diameters within 10 % is right within .6 %
    (``experiments/accuracy/size_statistics.py``).

    The curve is differentiable in every parameter of the gas and in the times, forward and reverse.
    Second derivatives must be forward over forward or forward over reverse, as in `jax.hessian`,
    not ``jax.jacrev(jax.jacrev(...))``.

    Args:
        corrections: names of what is added to Enskog's theory of a Maxwellian gas, by default all,
            ``KineticTheory.all_corrections``: "sonine" (Sonine coefficients), "softness" (contacts
            of finite duration, to first order), "correlations" (of velocities at finite density),
            "spin_cumulants" (of rough spheres; otherwise spins and velocities stay independent and
            Gaussian), "diffusion" (D and <dr^2>). To leave one out, give
            ``KineticTheory.all_corrections - {"correlations"}``.
        order: 3 solves for a_2 and a_3, with D in the second Sonine order; 2 for a_2, with D in the
            first.
        initial_sonine: a_2 at t = 0, in (-0.4, 1); `jaxgran.steady_state` gives it for a gas that
            white noise has driven.
        rtol: relative tolerance of the adaptive solver; by default 1e-8 in float64, 1e-5 in
            float32. The relative error of T is about rtol, the error of <dr^2> about rtol in mean
            free paths squared.
        solver: a diffrax solver. The default suits up to some 1e6 collisions per particle; for
            more (A near 0 over many decades of time) use ``diffrax.Kvaerno5()``.
        max_steps: the maximum number of steps of one curve.

    Raises:
        ValueError: for values out of range.

    Reference: van Noije & Ernst 1998, Brilliantov & Poeschel 2006. D of a dilute gas is within
    .6 % of direct simulation for eps from .05 to 1; at packing fraction phi the true D is greater
    by the share 0.85 phi.

    >>> jaxgran.cool(gas, times, model=jaxgran.KineticTheory()).sonine.shape
    (4,)
    """

    all_corrections: ClassVar[frozenset[str]] = frozenset(ALL_CORRECTIONS)
    stochastic: ClassVar[bool] = False
    elements: ClassVar[tuple[str, ...]] = SUPPORTED
    derivative_accuracy: ClassVar[float] = 0.015  # of dilute gases, phi = .05, by particle runs

    corrections: Collection[str] = eqx.field(
        static=True, converter=_checked_corrections, default=ALL_CORRECTIONS
    )
    order: int = eqx.field(static=True, default=3)
    initial_sonine: float = eqx.field(static=True, default=0.0)
    rtol: float | None = eqx.field(static=True, default=None)
    solver: Any = eqx.field(static=True, default=diffrax.Tsit5(scan_kind="lax"))
    max_steps: int = eqx.field(static=True, default=200_000)

    def __check_init__(self):
        if self.order not in (2, 3) or isinstance(self.order, bool | float):
            raise ValueError(
                f"order must be 2 or 3, got {self.order!r}. For a Maxwellian gas leave "
                '"sonine" out of corrections.'
            )
        advice = "Initial a_2; 0 for a Maxwellian."
        validation.checked_float("initial_sonine", self.initial_sonine, SONINES, advice)
        if self.initial_sonine and "sonine" not in self.corrections:
            raise ValueError(
                f'initial_sonine = {self.initial_sonine} needs "sonine" among the corrections: '
                "a_2 stays 0 otherwise."
            )
        if self.rtol is not None:
            validation.checked_float(
                "rtol", self.rtol, TOLERANCES, "Leave it out for 1e-8 (float32: 1e-5)."
            )
        if not isinstance(self.solver, diffrax.AbstractSolver):
            raise ValueError(
                f"solver must be a diffrax solver such as diffrax.Kvaerno5(), got {self.solver!r}"
            )
        validation.checked_int("max_steps", self.max_steps, 1, "Leave it out for 200000.")

    def check(self, gas: Gas) -> None:
        """Raise ValueError if the law heats the gas, or contacts are too soft for the theory."""
        others = [
            name for name in ("surface", "container", "drive") if getattr(gas, name) is not None
        ]
        if gas.diameter_sd is not None and others:
            raise ValueError(
                f"KineticTheory does not support diameter_sd together with {others[0]}="
                f"{type(getattr(gas, others[0])).__name__}: no theory has both. Set "
                f"diameter_sd=None for equal spheres, or {others[0]}=None."
            )
        gas.check_sizes()
        if any_traced(gas):
            return
        if "softness" in self.corrections:
            checks.check_softness(gas)
        checks.check_cools(gas)

    def simplified_for(self, *gases: Gas, displacement: bool = False) -> "KineticTheory":
        """Return this model without D, and with Gaussian spins if all spheres are smooth.

        Then only alternative explanations of their curves rotate. Gaussian spins change T by up to
        2 % there, and the program compiles in two thirds of the time.
        """
        needed = set(self.corrections)
        if all(gas.surface is None for gas in gases):
            needed.discard("spin_cumulants")
        if not displacement:
            needed.discard("diffusion")
        return dataclasses.replace(self, corrections=needed)

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run) -> CoolingCurve:
        """Return the cooling curve at the given times, s, as `AbstractModel.simulate` describes."""
        size = times.size
        padded = pad_to(times, padded_length(size))
        # Traced twice if it were compiled within another program.
        computed = self.solve if in_compiled_code(gas, times) else self._compiled_curve
        curve = computed(gas, padded, 1.0)
        if gas.container is not None:  # walls would limit <dr^2>
            curve = dataclasses.replace(curve, diffusion=None, displacement=None)
        return jax.tree.map(lambda x: truncate_to(x, size) if x.ndim else x, curve)

    @eqx.filter_jit
    def _compiled_curve(
        self, gas: Gas, times: Float[Array, "times"], tolerance: float
    ) -> CoolingCurve:
        return self.solve(gas, times, tolerance)

    def solve(self, gas: Gas, times: Float[Array, "times"], tolerance: Any) -> CoolingCurve:
        """Return the curve at times on a grid of lengths; <dr^2> as if there were no walls."""
        curve, _ = self._curve_and_moments(gas, times, tolerance)
        return curve

    def _curve_and_moments(
        self, gas: Gas, times: Float[Array, "times"], tolerance: Any
    ) -> tuple[CoolingCurve, Moments]:
        supported = self._is_supported(gas)
        scene, reduced_times, units = self._in_reduced_units(gas, times, supported)
        moments, fault = self._solver(gas, times, tolerance).moments(scene, reduced_times)
        fault |= status.flag(status.UNSUPPORTED, ~supported)
        return self._curve(gas, units, times, moments, fault), moments

    def solve_with_tangents(
        self,
        gas: Gas,
        times: Float[Array, "times"],
        tolerance: Any,
        gas_tangents: Gas,
        shift_tangents: Any,
    ) -> tuple[CoolingCurve, CoolingCurve]:
        """Return `solve`, and its derivatives along some directions of the gas and of the times.

        Args:
            gas, times, tolerance: as of `solve`.
            gas_tangents: tangents of the gas, with a first axis (directions,).
            shift_tangents: tangents of a shift of all times, shape (directions,).
        """
        times_tangents = jnp.broadcast_to(
            shift_tangents[:, None], (*shift_tangents.shape, times.size)
        )
        supported = self._is_supported(gas)

        def along_directions(function, *primals):
            """Return a function of tangents, which gives values and derivatives along each."""

            def with_tangents(*tangents):
                return jax.jvp(function, primals, tangents)

            return jax.vmap(with_tangents, out_axes=(None, 0))

        def in_reduced_units(gas, times):
            return self._in_reduced_units(gas, times, supported)

        reduced, reduced_tangents = along_directions(in_reduced_units, gas, times)(
            gas_tangents, times_tangents
        )
        scene, reduced_times, units = reduced
        scene_tangents, reduced_times_tangents, units_tangents = reduced_tangents
        moments, moments_tangents, fault = self._solver(gas, times, tolerance).moments_along(
            scene, reduced_times, scene_tangents, reduced_times_tangents
        )
        fault |= status.flag(status.UNSUPPORTED, ~supported)

        def in_si(gas, units, times, moments):
            curve = self._curve(gas, units, times, moments, fault)
            return dataclasses.replace(curve, status=None)

        curve, curve_tangents = along_directions(in_si, gas, units, times, moments)(
            gas_tangents, units_tangents, times_tangents, moments_tangents
        )
        return dataclasses.replace(curve, status=fault), curve_tangents

    def _in_reduced_units(
        self, gas: Gas, times: Float[Array, "times"], supported: Bool[Array, ""]
    ) -> tuple[SceneAndDensity, Float[Array, "times"], ReducedUnits]:
        units = ReducedUnits(gas.path_length, gas.impact_speed)
        density = Density.from_gas(
            gas,
            softness="softness" in self.corrections,
            correlations="correlations" in self.corrections,
        )
        # Times of 0 take no steps.
        reduced_times = jnp.where(supported, times, 0.0) * units.speed / units.length
        return (reduced_scene(gas), density), reduced_times, units

    def _is_supported(self, gas: Gas) -> Bool[Array, ""]:
        """Return whether the softness correction is valid at T_0 and sizes differ little enough.

        No check precedes the steps of a search: where this is False, it gets nan and a status.
        """
        supported = jnp.asarray(True)
        if "softness" in self.corrections:
            at_start = jnp.ones_like(gas.temperature)
            supported = softness_factor(gas.reduced_law, at_start, gas.dimension) > 0
        if gas.diameter_sd is not None:
            supported &= gas.size_spread < MAX_SEARCHED_SPREAD
        return supported

    def _solver(self, gas: Gas, times: Float[Array, "times"], tolerance: Any) -> MomentSolver:
        rtol = self.rtol or (1e-8 if times.dtype == jnp.float64 else 1e-5)
        sonine = "sonine" in self.corrections
        equations = Equations(
            dimension=gas.dimension,
            order=self.order if sonine else 2,
            maxwellian=not sonine,
            initial_sonine=self.initial_sonine,
            gaussian_spins="spin_cumulants" not in self.corrections,
            spreading="diffusion" in self.corrections and gas.diameter_sd is None,
            sizes=gas.diameter_sd is not None,
        )
        return MomentSolver(equations, self.solver, rtol * tolerance, self.max_steps)

    def _curve(
        self,
        gas: Gas,
        units: ReducedUnits,
        times: Float[Array, "times"],
        moments: Moments,
        fault: Int[Array, ""],
    ) -> CoolingCurve:
        """Return the curve of moments in reduced units."""
        theta = jnp.exp(moments.log_temperature)
        # The last factor: compiled in float32, exp(nan) can be a number (jaxlib 0.10.1 on a CPU).
        # A factor makes derivatives nan, too.
        one_or_nan = jnp.where(fault == status.OK, 1.0, jnp.nan).astype(theta.dtype)
        temperature = gas.temperature * theta * one_or_nan
        optional = {}
        if moments.third_sonine is not None:
            optional["third_sonine"] = moments.third_sonine * one_or_nan
        if moments.rotation is not None:
            optional["rotational_temperature"] = temperature * moments.rotation
        if moments.size_ratio is not None:
            optional["size_ratio"] = jnp.exp(moments.size_ratio) * one_or_nan
        if moments.diffusion is not None and moments.displacement is not None:
            diffusion = moments.diffusion * jnp.sqrt(theta) * units.length * units.speed
            optional["diffusion"] = diffusion * one_or_nan
            optional["displacement"] = moments.displacement * units.length**2 * one_or_nan
        return CoolingCurve(
            times=times,
            temperature=temperature,
            sonine=moments.sonine * one_or_nan,
            collisions=moments.collisions * one_or_nan,
            status=fault,
            **optional,
        )

    def covariance(
        self,
        gas: Gas,
        times: validation.UserNumber,
        num_particles: int,
        *,
        rotation: bool = False,
        energy: bool = False,
    ) -> Float[Array, "n n"]:
        """Return the covariance of ln T of one run of N spheres at some times.

        T of a run departs from the curve of this model because its impacts are random in number
        and size: ``dC/dt = J C + C J^T + Q/N`` along the curve, ``C(0) = 0``, with the Jacobian J
        of the rates and the second moments Q of what impacts take (`jaxgran.theory.covariance`).
        For smooth spheres in a periodic box, with ``zeta = -d ln T/dt`` by impacts, omega
        collisions per particle and time, ``r = <x^2>/<x>^2`` of their losses x (2 for constant
        restitution), and ``Phi = d ln T(t)/d ln T_0``,

            C(t_i, t_j) = (2/N) Phi_i Phi_j int_0^min(t_i, t_j) r zeta^2/(omega Phi^2) dt.

        Contacts of soft spheres add the scatter of the energy that they hold, unless "softness" is
        not among the corrections (`jaxgran.theory.contact_noise`).

        The mean over R independent runs has 1/R of it. It is the covariance of a gas that stays
        homogeneous, at low density: `jaxgran.models.error_model` has the factors of others.

        Args:
            gas: the scene; its T_0 is the first temperature of the run itself.
            times: t, s, shape (times,), >= 0, increasing.
            num_particles: N, >= 1.
            rotation: give also ln T_rot of rough spheres.
            energy: T is that by the energy, ``<m v^2>/(d <m>)``, of spheres of unequal sizes; for
                equal ones it is the same.

        Returns:
            C, shape (times, times); with `rotation` of ln T at all times, then of ln T_rot, shape
            (2 times, 2 times). Differentiable in the gas.

        Raises:
            ValueError: for times out of order, N below 1, and `rotation` without rough spheres.
            RuntimeError: if the curve cannot be computed.

        >>> covariance = jaxgran.KineticTheory().covariance(gas, times, 250)
        >>> [round(float(error), 4) for error in jnp.sqrt(jnp.diag(covariance))]
        [0.0089, 0.0151, 0.0237, 0.0262]
        """
        gas = checks.checked_gas(gas)
        times = validation.checked_times(times)
        num_particles = validation.checked_int("num_particles", num_particles, 1)
        self.check_scene(gas)
        if rotation and gas.surface is None:
            raise ValueError(
                "rotation=True needs spheres that rotate: add surface=jaxgran.Rough(...), or leave "
                "rotation out."
            )
        padded = pad_to(times, padded_length(times.size))
        whole, fault = self._compiled_covariance(gas, padded, rotation, energy)
        if not any_traced(fault) and int(fault) != status.OK:
            raise RuntimeError(status.explain(int(fault)))
        rows = np.arange(times.size)
        if rotation:
            rows = np.concatenate([rows, rows + padded.size])
        return whole[rows][:, rows] / num_particles

    @eqx.filter_jit
    def _compiled_covariance(
        self, gas: Gas, times: Float[Array, "times"], rotation: bool, energy: bool
    ) -> tuple[Float[Array, "n n"], Any]:
        # T changes little between the times of a grid in ln(1 + t/tau_c).
        frequency = gas.collision_frequency
        shares = jnp.linspace(0.0, 1.0, NUM_GRID_TIMES, dtype=times.dtype)
        between = jnp.expm1(shares * jnp.log1p(frequency * times[-1])) / frequency
        grid = jnp.sort(jnp.concatenate([times, between]))
        curve, moments = self._curve_and_moments(gas, grid, 1.0)
        whole = run_covariance(
            gas,
            curve,
            moments.spins,
            rotation=rotation,
            energy=energy,
            softness="softness" in self.corrections,
            correlations="correlations" in self.corrections,
        )
        rows = jnp.searchsorted(grid, times)
        if rotation:
            rows = jnp.concatenate([rows, rows + grid.size])
        return whole[rows][:, rows], curve.status

    def cooling_rate(self, gas: Gas) -> Float[Array, ""]:
        """Return ``-d ln T/dt`` at t = 0, 1/s, of a Maxwellian gas; < 0 if the law heats it."""
        return first_cooling_rate(gas)

    def estimated_error(self, error_model: ErrorModel) -> float:
        """Estimated relative error of T, which follows from `rate_error`."""
        return error_model.error_of_temperature(self.rate_error(error_model))

    def rate_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"]:
        """Relative error of the cooling rate.

        Contributions are correlations, contacts that last, walls, roughness, and Sonine terms
        beyond a_3.
        """
        rate = error_model.homogeneous
        if "correlations" in self.corrections:
            rate = error_model.correlated
        contacts = error_model.instant_contacts
        if "softness" in self.corrections:
            contacts = error_model.corrected_contacts
        elements = error_model.mixing + error_model.roughness + error_model.sizes
        return rate + contacts + error_model.truncation(self.order) + elements

    def limitations(self, gas: Gas, num_particles: int | None = None) -> tuple[Limitation, ...]:
        """Return limitations by contacts that last, correlated collisions, and a growing flow."""
        consequence = "beyond the first-order softness correction"
        contacts = limitations_of_instant_impacts(gas, consequence)
        return contacts + limitations_of_homogeneity(gas, num_particles)

    @property
    def has_contacts(self) -> bool:
        """Whether softness is among the corrections."""
        return "softness" in self.corrections

    def rotation_accuracy(self, gas: Gas) -> Any:
        """Relative accuracy of T_rot/T: 3 % (3D) and 5 % (2D), 15 % between walls (see
        `ROUGH_WALL_ERROR`), and 20 % of spheres that slide where they rotated at t = 0 or the walls
        turn them.

        Measured against DSMC (``particle_statistics.py --only spins`` in experiments/accuracy) for
        mu = .05 to 1 and without Coulomb's limit, beta_t = 0 to 1, eps = .7 to .9, up to 100 mean
        free times. Where spins slow down by sliding, fast ones lose no more than slow ones, and
        their distribution gets a long tail: T_rot/T is within 4 % (3D) and 20 % (2D) up to 100 mean
        free times, and half of the true one at 1000. Gaussian spins: 7 %.
        """
        if gas.container is not None:
            accuracy = WALLS_ACCURACY
        elif "spin_cumulants" in self.corrections:
            accuracy = SPIN_CUMULANTS_ACCURACY[gas.dimension]
        else:
            accuracy = GAUSSIAN_SPINS_ACCURACY
        if gas.surface is None or gas.surface.friction is None:
            return accuracy
        if gas.container is not None and gas.container.tangential_restitution is not None:
            return SLIDING_ACCURACY
        first = gas.surface.rotational_temperature
        return jnp.where(first > 0, SLIDING_ACCURACY, accuracy).astype(first.dtype)

    def displacement_accuracy(self, gas: Gas) -> Any:
        """Relative error of <dr^2> by the Sonine order of D and by correlated collisions.

        It is None between walls and for spheres of unequal sizes.

        Hard spheres diffuse faster than in Enskog's theory by the share 0.85 phi up to phi = .2
        (Speedy, Mol. Phys. 62 (1987) 509); this is assumed for disks, too.
        """
        if gas.container is not None or gas.diameter_sd is not None:
            return None
        numpy = array_module(gas.packing_fraction)  # NumPy compiles nothing
        correlation = 0.85 * numpy.minimum(gas.packing_fraction, 0.2)
        second = self.order > 2 and "sonine" in self.corrections
        sonine = 0.005 if second else {2: 0.024, 3: 0.017}[gas.dimension]
        if gas.surface is not None:  # spins and velocities are correlated: DSMC, beta_t = .5
            sonine += 0.07
        return numpy.hypot(sonine, correlation)
