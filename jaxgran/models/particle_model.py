"""Base of the models of particles: one run with its derivatives, or replicas side by side."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced
from jaxgran.data.curve import DEFAULTS, QUANTITIES, CoolingCurve, Run
from jaxgran.gradients.rule import Result
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel
from jaxgran.particles import run as particle_run
from jaxgran.particles import snapshot
from jaxgran.particles.run import Inputs
from jaxgran.scene.gas import Gas

M = TypeVar("M", bound="AbstractParticleModel")


class AbstractParticleModel(AbstractModel):
    """A model of particles, whose runs are functions of `Inputs` and directions of derivatives.

    Attributes:
        num_particles: N of each replica.
        replicas: number of independent gases.
    """

    num_particles: AbstractVar[int]
    replicas: AbstractVar[int]

    stochastic: ClassVar[bool] = True
    saves: ClassVar[bool] = True
    transforms_time: ClassVar[bool] = True
    """True if drag is integrated in transformed time, which rounding limits."""

    @abstractmethod
    def inputs(self, gas: Gas, times: Float[Array, "times"], run: Run) -> Inputs:
        """Return the gas and the times in the units of the run."""

    @abstractmethod
    def differentiable(self, outputs: Callable[..., Result], run: Run) -> Callable[..., Result]:
        """Return `outputs`, a function of inputs, directions and a run, with derivatives."""

    @abstractmethod
    def outputs(self, inputs: Inputs, directions: Any, dimension: int, run: Run) -> Result:
        """Run all replicas in one array, from the host unless a number of the inputs is traced."""

    def single_replica(self: M) -> M:
        """Return the model of one replica."""
        return dataclasses.replace(self, replicas=1)

    def invalid_times(
        self, gas: Gas, times: Float[Array, "times"]
    ) -> tuple[Bool[Array, "times"], Int[Array, ""]]:
        """Return a mask of the times that the run cannot reach, and the status for them."""
        late = jnp.zeros(times.shape, bool)
        if self.transforms_time:
            late = checks.unreachable_with_drag(gas, times)
        return late, status.flag(status.OUT_OF_RANGE, jnp.any(late))

    def derivative_bias(self, gas: Gas, times: Array, flow_share: Array) -> Array | None:
        """Estimate the bias of the derivatives of ln T from the flow in each replica."""
        return None

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run = DEFAULTS) -> CoolingCurve:
        """Return the cooling curve at the given times, s; see `jaxgran.AbstractModel.simulate`."""
        invalid, fault = self.invalid_times(gas, times)
        inputs = self.inputs(gas, times, run)

        def simulated(
            scene: Any,
            times: Array,
            start: Any,
            others: Any,
            directions: Any = None,
            run: Run = run,
        ) -> Result:
            inputs = Inputs(scene, times, start, *others)
            return self._by_replica(inputs, directions, gas.dimension, run)

        rule = self.differentiable(simulated, run)
        out = rule(inputs.scene, inputs.times, inputs.start, (inputs.key, inputs.units))
        return self._curve(gas, times, inputs.units, out, invalid, fault, run.save == "particles")

    @eqx.filter_jit
    def _curve(
        self,
        gas: Gas,
        times: Float[Array, "times"],
        units: snapshot.Units,
        out: Result,
        invalid: Bool[Array, "times"],
        fault: Int[Array, ""],
        saves_particles: bool,
    ) -> CoolingCurve:
        """Return the curve of a run in SI, with nan at invalid times."""
        records, saved = out.records.values, out.records.saved
        others, energy = {}, gas.mass * gas.temperature
        scales = {"1": 1.0, "m^2": units.length**2, "m^2/s^2": gas.temperature, "J": energy}
        values = {
            name: jnp.where(invalid[None], jnp.nan, records[name].T * scales[quantity.unit])
            for name, quantity in QUANTITIES.items()
            if name in records
        }
        if out.particles is not None:
            others["particles"] = snapshot.particles(units, self.replicas, *out.particles)
        if "flow_share" in values:
            others["derivative_bias"] = self.derivative_bias(gas, times, values["flow_share"])
        curve = CoolingCurve.of_replicas(times, values, status=out.status | fault, **others)
        if saved is None:
            return curve
        saved = jax.tree.map(partial(snapshot.nan_where, invalid[:, None]), saved)
        if not saves_particles:
            return curve.with_saved(jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), saved))
        box_side = jnp.broadcast_to(units.box_side, (len(times), *units.box_side.shape))
        return dataclasses.replace(curve, saved=saved._replace(box_side=box_side))

    def _by_replica(self, inputs: Inputs, directions: Any, dimension: int, run: Run) -> Result:
        """Run on the host or compiled, and there replicas by themselves or all in one array."""
        run_all = partial(self.outputs, inputs, directions, dimension, run)
        if any_traced(inputs):
            checks.refuse_files(self, run)
            return run_all()
        spheres = self.num_particles if self.has_positions else 0
        if on := particle_run.replica_devices(self.replicas, spheres):
            single = self.single_replica()

            def run_replica(k: int, run: Run) -> Result:
                rows = slice(k * self.num_particles, (k + 1) * self.num_particles)
                start = jax.tree.map(lambda x: x[rows], inputs.start)
                part = inputs._replace(start=start, key=run.key)
                return single._by_replica(part, directions, dimension, run)

            runs = particle_run.run_replicas(run_replica, self.replicas, run, on)
            return particle_run.join_results(runs)
        if directions is None:
            return run_all()
        # In a rule of differentiation operations on known numbers would be staged.
        return particle_run.in_threads([run_all], [particle_run.chosen_device()])[0]
