"""Base of the models of particles: how a gas becomes a run of particles, and a run a curve."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, nan_where
from jaxgran.data.curve import DEFAULTS, QUANTITIES, CoolingCurve, Particles, Run
from jaxgran.gradients.rule import Result
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel
from jaxgran.particles import snapshot
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.elements import transformed_times
from jaxgran.particles.run import Recorder, grouped, run_on_host, run_traced
from jaxgran.particles.start import has_other_box, reduced_start
from jaxgran.scene.gas import Gas


class AbstractParticleModel(AbstractModel):
    """A model of particles.

    Attributes:
        num_particles: N of each replica.
        replicas: number of independent gases.
        start: positions and velocities given by a user; None for random ones.
        transforms_time: True if drag is integrated in transformed time, which rounding limits.
    """

    num_particles: AbstractVar[int]
    replicas: AbstractVar[int]
    start: AbstractVar[Particles | None]
    transforms_time: AbstractClassVar[bool]

    stochastic: ClassVar[bool] = True
    saves: ClassVar[bool] = True

    @property
    @abstractmethod
    def projected(self) -> bool:
        """True if derivatives are projected or by differences, False if they are plain."""

    @abstractmethod
    def scene(self, gas: Gas) -> Any:
        """Return the gas in the units of the run."""

    @abstractmethod
    def units(self, gas: Gas) -> snapshot.Units:
        """Return the units of the run."""

    @abstractmethod
    def dynamics(
        self, scene: Any, dimension: int, replicas: int, traced: bool = False
    ) -> AbstractDynamics:
        """Return the motion of the particles.

        Args:
            scene: the gas in the units of the run.
            dimension: d.
            replicas: number of replicas in one array.
            traced: whether numbers of the run are traced.
        """

    @abstractmethod
    def differentiable(
        self, run: Callable[..., Result], shifted: Callable[..., Result]
    ) -> Callable[..., Result]:
        """Return a run with derivatives, see `jaxgran.gradients.rule.differentiable`.

        Args:
            run: a function of the scene, the times, the start, all else, and directions.
            shifted: the same function without files, for further runs.
        """

    @abstractmethod
    def derivative_bias(self, gas: Gas, times: Array, flow_share: Array) -> Array | None:
        """Estimate the bias of the derivatives of ln T from the flow in each replica."""

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run = DEFAULTS) -> CoolingCurve:
        """Return the cooling curve at the given times, s, as `AbstractModel.simulate` describes."""
        invalid, fault = self.invalid_times(gas, times)
        if self.start is not None:  # then T_0 is a constant unit of speed in derivatives
            gas = gas.replace(temperature=jax.lax.stop_gradient(gas.temperature))
        scene = self.scene(gas)
        units = self.units(gas)
        reduced = times * units.velocity / units.length
        if self.transforms_time and gas.drag is not None:
            reduced = transformed_times(scene.drag_rates, reduced)
        start = reduced_start(self.start, gas, differentiable=not self.projected)
        key = jax.random.key(0) if run.key is None else run.key
        simulated = partial(self._simulated, gas.dimension)
        rule = self.differentiable(
            partial(simulated, run), partial(simulated, Run(run.key, run.progress))
        )
        result = rule(scene, reduced, start, (key, units, times))
        return self._curve(gas, times, units, result, invalid, fault, run.save == "particles")

    def invalid_times(
        self, gas: Gas, times: Float[Array, "times"]
    ) -> tuple[Bool[Array, "times"], Int[Array, ""]]:
        """Return a mask of the times that the run cannot reach, and the status for them."""
        late = jnp.zeros(times.shape, bool)
        if self.transforms_time:
            late = checks.unreachable_with_drag(gas, times)
        # Traced values could not be checked before the run.
        other_box = has_other_box(self.start, gas, self.num_particles)
        fault = status.flag(status.OUT_OF_RANGE, jnp.any(late))
        return late | other_box, fault | status.flag(status.BOX_MISMATCH, other_box)

    def _simulated(
        self,
        dimension: int,
        run: Run,
        scene: Any,
        times: Float[Array, "times"],
        start: Any,
        others: Any,
        directions: Any = None,
    ) -> Result:
        """Return the result of a run, from the host unless a number is traced.

        Args:
            dimension: d.
            run: options.
            scene, times, start: the gas, the times and a given start in units of the run.
            others: key of the random numbers, units of the run, and the times in SI.
            directions: of tangents in the material; None for no tangents.
        """
        key, units, seconds = others
        save = snapshot.save_function(run.save)
        if any_traced(scene, times, start, others):
            checks.refuse_files(self, run)
            dynamics = self.dynamics(scene, dimension, self.replicas, traced=True)
            recorder = Recorder(dynamics, units, save)
            return run_traced(recorder, times, start, key, directions)
        groups = grouped(self.replicas, self.num_particles if self.has_positions else 0)
        dynamics = self.dynamics(scene, dimension, self.replicas // groups.number)
        recorder = Recorder(dynamics, units, save)
        return run_on_host(recorder, times, start, key, directions, groups, run, seconds)

    @eqx.filter_jit
    def _curve(
        self,
        gas: Gas,
        times: Float[Array, "times"],
        units: snapshot.Units,
        result: Result,
        invalid: Bool[Array, "times"],
        fault: Int[Array, ""],
        saves_particles: bool,
    ) -> CoolingCurve:
        """Return the curve of a run in SI, with nan at invalid times."""
        one_or_nan = jnp.where(invalid[None], jnp.nan, jnp.ones_like(gas.temperature))
        records = result.records.values
        saved = result.records.saved
        scales = {
            "1": 1.0,
            "m^2": units.length**2,
            "m^2/s^2": gas.temperature,
            "J": gas.mass * gas.temperature,
        }
        values = {
            name: records[name].T * scales[quantity.unit] * one_or_nan
            for name, quantity in QUANTITIES.items()
            if name in records
        }
        others = {}
        if self.has_positions:
            others["particles"] = snapshot.particles(units, self.replicas, *result.particles)
        if "flow_share" in values:
            others["derivative_bias"] = self.derivative_bias(gas, times, values["flow_share"])
        curve = CoolingCurve.of_replicas(times, values, status=result.status | fault, **others)
        if saved is None:
            return curve
        saved = jax.tree.map(partial(nan_where, invalid[:, None]), saved)
        if not saves_particles:
            return curve.with_saved(jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), saved))
        box_side = jnp.broadcast_to(units.box_side, (len(times), *units.box_side.shape))
        return dataclasses.replace(curve, saved=saved._replace(box_side=box_side))
