"""`cool`: the cooling curve of a gas by any model."""

import dataclasses
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, is_known, known_part, nan_where
from jaxgran._utils.validation import check_bool, checked_times
from jaxgran.data.checkpoint import saved_at_termination
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.files import check_writable
from jaxgran.data.particles import Particles
from jaxgran.data.run_options import Run
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel
from jaxgran.models.choose import choose_model
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas, is_allowed_spread
from jaxgran.scene.geometry import MIN_BOX


def cool(
    gas: Gas,
    times: ArrayLike | Sequence[float],
    *,
    model: AbstractModel | Literal["auto"] | None = None,
    key: PRNGKeyArray | None = None,
    progress: bool = True,
    checkpoint: str | Path | None = None,
    save: Callable[[Particles], Any] | Literal["particles"] | None = None,
    trajectory: str | Path | None = None,
    throw: bool = True,
    tolerance: float | None = None,
    num_particles: int | None = None,
) -> CoolingCurve:
    """Compute how a gas cools and spreads from its initial temperature at t = 0.

    The model is a description; `key`, `progress`, `checkpoint` and `throw` are options of this run.
    With known numbers a particle model is run from the host, which enlarges arrays that are too
    small, shows progress and writes checkpoints. Inside `jax.jit`, `jax.vmap` or a derivative this
    is a pure function of arrays, which calls nothing on the host. A key gives the same random start
    in both, but for rounding, which the ten collisions of its equilibration enlarge.

    Args:
        gas: the scene; its parameters may be traced, differentiated and batched with `jax.vmap`.
        times: t, s, increasing and >= 0, shape (times,); need not start at 0.
        model: a `jaxgran.extend.AbstractModel`, by default `jaxgran.KineticTheory()`. "auto" uses
            the fastest model whose estimated error is small enough; `jaxgran.choose_model` returns
            it with the reasons.
        key: key of the random numbers of a particle model, by default `jax.random.key(0)`: two
            calls without a key return the same numbers. With several CPU devices, or from 8192
            spheres on with one, each replica has arrays of its own and the key
            ``fold_in(key, k)``, independent of the number of devices. Otherwise replicas share one
            array, and replicas of spheres share their step lengths and the lifetimes of their
            neighbour lists.
        progress: show a progress bar on a terminal during a run of some seconds.
        checkpoint: path of a file for particle models. The run is saved there each minute and when
            it is interrupted, by Ctrl-C or SIGTERM, and is resumed from it; a resumed run gives the
            same numbers bit for bit. Not inside `jax.jit` and `jax.vmap`.
        save: function for models with particles, which JAX can compile. It takes the `Particles` of
            one replica (arrays of shape (N, d), SI) and returns a pytree of arrays; see
            `jaxgran.observables`. Its mean over replicas at each time is ``curve.saved``, its
            standard error ``curve.saved_error``, and its values in each replica
            ``curve.replicas.saved``. "particles" saves all particles at all times. Positions of
            DSMC, which has none, are nan.
        trajectory: path of a file for models with positions, .gsd (OVITO, freud, VMD, HOOMD; needs
            the extra `trajectories`) or .xyz (extended XYZ). The particles are written to it at
            each time, as soon as it is reached; `jaxgran.read_particles` reads it. Several replicas
            write one file each, ``name.0.gsd`` and so on. Not inside `jax.jit` and `jax.vmap`.
        throw: raise RuntimeError if the run fails. With False, and always inside compiled code,
            which cannot raise, the curve is nan from the failure on, and its ``status`` gives the
            reason (see `jaxgran.explain_status`).
        tolerance: relative error of T allowed, for "auto" only; 0.02 by default.
        num_particles: N of the gas, if known, for "auto" only.

    Returns:
        `CoolingCurve` at those times.

    Raises:
        ValueError: for times that are negative, unsorted, not finite or not a list, a trajectory
            that exists already, a scene that the model does not support, a checkpoint of a model
            without a run, or options of "auto" with another model. Traced values cannot be
            checked: if they are out of range the curve is nan, and its status says so.
        OSError: for a checkpoint that cannot be written.
        RuntimeError: if the run fails and `throw` is True, with what to do.

    >>> curve = jaxgran.cool(gas, times)
    >>> [round(float(T), 5) for T in curve.temperature]
    [0.00784, 0.00524, 0.00205, 0.00053]
    """
    gas = checks.checked_gas(gas)
    times = checked_times(times)
    key = checks.checked_key(key)
    check_bool(progress=progress, throw=throw)
    model = KineticTheory() if model is None else model
    if model == "auto":
        tolerance = 0.02 if tolerance is None else tolerance
        choice = choose_model(gas, times, tolerance, num_particles)
        if choice.error > tolerance:
            warnings.warn(choice.reasons[0], stacklevel=2)
        model = choice.model
    elif not (tolerance is None and num_particles is None):
        raise ValueError(
            'tolerance and num_particles go with model="auto". Leave them out, or give '
            "num_particles to the model, as in SoftSpheres(num_particles)."
        )
    model = checks.checked_model(model)
    model.check_save(save)
    _check_path("trajectory", trajectory, model, model.has_positions, "no positions to write")
    _check_path("checkpoint", checkpoint, model, model.stochastic, "no run to be saved")
    if checkpoint is not None:
        check_writable(os.fspath(checkpoint))
    model.check_scene(gas)
    gas, simulated, allowed = _valid_where_traced(gas, times)
    run = Run(key, progress, checkpoint, save, trajectory)
    if allowed is not None and is_known(allowed) and not allowed:
        curve = _unknown_curve(model, gas, simulated, run)
    else:
        with saved_at_termination(checkpoint):
            curve = model.simulate(gas, simulated, run)
    curve = _nan_unless(allowed, curve, times)
    if throw and curve.status is not None and not isinstance(curve.status, Tracer):
        _raise_if_failed(curve, gas)
    return curve


def _check_path(name: str, path: Any, model: AbstractModel, supported: bool, lack: str) -> None:
    if path is not None and not isinstance(path, str | os.PathLike):
        raise ValueError(f"{name} must be a path, got {path!r}")
    if path is not None and not supported:
        raise ValueError(
            f"{type(model).__name__} has {lack}, got {name}={str(path)!r}. Use HardSpheres or "
            f"SoftSpheres, or set {name}=None."
        )


def _valid_where_traced(
    gas: Gas, times: Float[Array, "times"]
) -> tuple[Gas, Float[Array, "times"], Bool[Array, ""] | None]:
    """Replace a gas and times whose traced values are out of range by ones that models accept.

    Returns:
        The gas, nan where a traced parameter is out of range; the times, replaced if traced ones do
        not increase from 0 or later; and True if all values were allowed, None if nothing is
        traced.
    """
    if not any_traced(gas, times):
        return gas, times, None
    # Also values that are known and only carry a tangent, which `Gas` does not check.
    traced = {name: gas.value(name) for name in gas.domains}
    traced = {name: value for name, value in traced.items() if any_traced(value)}
    allowed = jnp.ones((), bool)
    for name, value in traced.items():
        allowed &= jnp.all(gas.domains[name].contains(value))
    if gas.container is not None:
        allowed &= jnp.all(gas.container.side / gas.diameter > MIN_BOX)
    if gas.diameter_sd is not None:
        allowed &= is_allowed_spread(gas.size_spread)
    one_or_nan = jnp.where(allowed, 1.0, jnp.nan)
    # A product, so that derivatives are nan, too: an optimiser would take 0 for a minimum.
    gas = gas.replace(**{name: x * one_or_nan.astype(x.dtype) for name, x in traced.items()})
    if any_traced(times):
        increase = jnp.all(jnp.diff(times) > 0) & (times[0] >= 0) & jnp.isfinite(times[-1])
        allowed &= increase
        times = jnp.where(increase, times, jnp.arange(1.0, 1.0 + times.size, dtype=times.dtype))
    return gas, times, allowed


def _allowed_gas(gas: Gas) -> Gas:
    """Return a gas of known numbers, with those out of range replaced by ones in the range."""
    gas = jax.tree.map(known_part, gas)
    wrong = {}
    for name, domain in gas.domains.items():
        value = gas.value(name)
        if not np.all(domain.contains(value)):
            inside = domain.low if domain.low_allowed else domain.from_free(0.0)
            wrong[name] = jnp.full_like(value, inside)
    return gas.replace(**wrong)


def _unknown_curve(
    model: AbstractModel, gas: Gas, times: Float[Array, "times"], run: Run
) -> CoolingCurve:
    """Return a curve of the shapes of a run, which is nan, in the values and derivatives of a gas.

    It stands for a run with numbers that are known, and not allowed.
    """
    options = Run(run.key, save=run.save)
    model = model.sized_for(_allowed_gas(gas))
    shapes = eqx.filter_eval_shape(
        lambda gas, times: model.simulate(gas, times, options), gas, times
    )
    traced = (gas.value(name) for name in gas.domains)
    total = sum((jnp.sum(x) for x in traced if any_traced(x)), start=jnp.zeros(())) * jnp.nan

    def filled(shape: jax.ShapeDtypeStruct) -> Array:
        zeros = jnp.zeros(shape.shape, shape.dtype)
        return zeros + total.astype(shape.dtype) if eqx.is_inexact_array(zeros) else zeros

    return jax.tree.map(filled, shapes)


def _nan_unless(
    allowed: Bool[Array, ""] | None, curve: CoolingCurve, times: Float[Array, "times"]
) -> CoolingCurve:
    """Return the curve, with all floats nan and a status if a value was not allowed."""
    if allowed is None:
        return curve
    masked = jax.tree.map(lambda x: nan_where(~allowed, x), curve)
    fault = status.flag(status.OUT_OF_RANGE, ~allowed)
    if curve.status is not None:
        fault = jnp.where(allowed, curve.status, fault)
    return dataclasses.replace(masked, times=times, status=fault)


def _raise_if_failed(curve: CoolingCurve, gas: Gas) -> None:
    fault = int(np.bitwise_or.reduce(np.asarray(curve.status), axis=None))
    if fault == status.OK:
        return
    known = np.isfinite(np.asarray(curve.temperature))
    reached = ""
    if np.any(known):
        last = int(np.flatnonzero(known)[-1])
        ratio = float(curve.temperature[last] / gas.temperature)
        reached = f"stopped after t = {curve.times[last]:.3g} s, T/T_0 = {ratio:.3g}: "
    raise RuntimeError(reached + status.explain(fault))
