"""Cooling curves, measured or simulated: quantities of a gas at given times."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxgran._utils import status as fault_status
from jaxgran._utils.extras import import_extra
from jaxgran._utils.formatting import format_quantity, text_table
from jaxgran._utils.validation import list_to_array
from jaxgran.data.curve_arrays import (
    OF_REPLICAS,
    STATUS,
    TIME,
    label_of,
    names_of_leaves,
    nested_fields,
    to_arrays,
)
from jaxgran.data.curve_checks import check_values, is_known
from jaxgran.data.particles import Particles
from jaxgran.data.quantities import QUANTITIES, WITH_ERRORS

MIN_POINTS = 3
"""Smallest number of times of a measured curve."""

NOISE = 3.0
"""T, or <dr^2>, over its error below which a row does not count as above the noise."""


def _required(unit: str) -> Any:
    return eqx.field(converter=partial(list_to_array, unit=unit))


def _optional(unit: str) -> Any:
    return eqx.field(converter=partial(list_to_array, unit=unit), default=None)


class CoolingCurve(eqx.Module):
    """Temperature and further quantities of a cooling gas at given times, measured or computed.

    All arrays have the shape of `times`; arrays of `replicas` have the shape (replicas, times).
    A quantity that is not known is None. Quantities with units of pint, astropy or unyt, and time
    differences, are converted to SI. A curve without a status counts as measured: its values are
    finite and positive. A value that has an error may be 0 or negative, as where noise was
    subtracted. At t = 0, where the state of the gas was prepared, an error and a displacement may
    be 0.

    Attributes:
        times: t, s, increasing.
        temperature: T = <v^2>/d, m^2/s^2.
        displacement: mean square displacement <dr^2> since t = 0, m^2.
        sonine: a_2, second Sonine coefficient of the velocity distribution.
        third_sonine: a_3, third Sonine coefficient.
        size_ratio: mean square velocity of the smaller half of spheres of unequal sizes over that
            of the larger half: see `jaxgran.theory.sizes`.
        collisions: collisions per particle since t = 0.
        diffusion: self-diffusion coefficient D(t), m^2/s.
        temperature_error: standard error of T, m^2/s^2, of a measured or stochastic curve.
        displacement_error: standard error of <dr^2>, m^2.
        rotational_temperature: T_rot = I <w^2>/(d_rot m), m^2/s^2, of rough spheres.
        rotational_temperature_error: standard error of T_rot, m^2/s^2.
        velocity_correlation: <v(0) . v(t)>/d, m^2/s^2, of particle models.
        elastic_energy: energy of the contacts per particle, J, of soft spheres.
        dissipated_energy: energy dissipated since t = 0 per particle, J, of soft and hard spheres.
            Drag dissipates energy, too. Unless something drives the gas, the sum of (d/2) m T,
            (d_rot/2) m T_rot, elastic and dissipated energy is constant. nan in a driven gas with
            drag.
        regularised: impacts per particle, of hard spheres, that were made elastic to prevent
            inelastic collapse.
        flow_share: share of the kinetic energy in the longest waves of the flow, of spheres in
            periodic boxes: see `jaxgran.observables.flow_share`.
        derivative_bias: share by which a projected derivative of ln T is too large, estimated
            from flow_share in boxes longer than L_c (`jaxgran.models.error_model`). A change of
            the shape of the velocity distribution, which matters at a thermal beta above .15, is
            not part of it: see `jaxgran.DSMC`.
        replicas: the curve of each replica, with arrays of shape (replicas, times).
        particles: the final state of a particle model.
        saved: result of `cool(save=...)` at each time, first axes (times, ...), as the mean over
            replicas; for ``save="particles"`` `Particles` of shape (times, replicas, N, d).
        saved_error: standard error of `saved`, for two or more replicas.
        status: 0, or the faults of a run under `jax.jit` or `jax.vmap`, where no error can be
            raised; values are then nan. `jaxgran.explain_status` explains the number.

    >>> measured = jaxgran.CoolingCurve(times=[0.1, 1.0, 3.0], temperature=[8e-3, 2e-3, 5e-4])
    >>> measured.temperature.shape, measured.displacement is None
    ((3,), True)
    """

    times: Float[Array, "times"] = _required("s")
    temperature: Float[Array, "... times"] = _required("m^2/s^2")
    _: dataclasses.KW_ONLY
    displacement: Float[Array, "... times"] | None = _optional("m^2")
    sonine: Float[Array, "... times"] | None = _optional("")
    third_sonine: Float[Array, "... times"] | None = _optional("")
    size_ratio: Float[Array, "... times"] | None = _optional("")
    collisions: Float[Array, "... times"] | None = _optional("")
    diffusion: Float[Array, "... times"] | None = _optional("m^2/s")
    temperature_error: Float[Array, "... times"] | None = _optional("m^2/s^2")
    displacement_error: Float[Array, "... times"] | None = _optional("m^2")
    rotational_temperature: Float[Array, "... times"] | None = _optional("m^2/s^2")
    rotational_temperature_error: Float[Array, "... times"] | None = _optional("m^2/s^2")
    velocity_correlation: Float[Array, "... times"] | None = _optional("m^2/s^2")
    elastic_energy: Float[Array, "... times"] | None = _optional("J")
    dissipated_energy: Float[Array, "... times"] | None = _optional("J")
    regularised: Float[Array, "... times"] | None = _optional("")
    flow_share: Float[Array, "... times"] | None = _optional("")
    derivative_bias: Float[Array, "... times"] | None = _optional("")
    replicas: "CoolingCurve | None" = None
    particles: Particles | None = None
    saved: Any = None
    saved_error: Any = None
    status: Int[Array, ""] | None = None

    def __check_init__(self) -> None:
        if is_known(self.times):
            check_values({name: getattr(self, name) for name in QUANTITIES}, self.status)

    def __repr__(self) -> str:
        first = format_quantity(self.times[..., 0], "s")
        last = format_quantity(self.times[..., -1], "s")
        ratio = format_quantity(self.temperature[..., -1] / self.temperature[..., 0])
        known = [f.name for f in dataclasses.fields(self) if getattr(self, f.name) is not None]
        rows = [("T over its first value", ratio)]
        rows += [("known", ", ".join(name for name in known if name not in ("times", "status")))]
        if self.status is not None:
            rows.append(("status", format_quantity(self.status)))
        title = f"CoolingCurve of {np.shape(self.times)[-1]} times, t = {first} to {last}"
        return text_table(title, rows)

    def to_xarray(self) -> Any:
        """Return the curve as an `xarray.Dataset` with units; needs the extra `notebook`.

        Quantities have the dimension time. Those of replicas, whose names end in _of_replicas, have
        the dimensions replica and time; positions and velocities have replica, particle and axis.
        The arrays of ``save=`` are named by their place in the tree, as ``saved.S.0``, with the
        standard error in ``saved_error.S.0`` and the values of each replica in
        ``saved_of_replicas.S.0``. `from_xarray` is the inverse.

        Raises:
            ValueError: for several curves in one, as `jax.vmap` returns them, or if a key of a
                saved dictionary contains "." or "/" or is a number.
            ModuleNotFoundError: without xarray.
        """
        xarray = import_extra("xarray")
        self.check_single()
        arrays = {name: np.asarray(x) for name, x in to_arrays(self).items()}
        attributes = {STATUS: int(arrays.pop(STATUS))} if STATUS in arrays else {}
        are_particles = isinstance(self.saved, Particles)
        labelled = {}
        for name, array in arrays.items():
            label = label_of(name, array.ndim, are_particles)
            labelled[name] = (label.dims, array, label.attributes)
        return xarray.Dataset(labelled, coords={TIME: labelled.pop("times")}, attrs=attributes)

    @classmethod
    def from_xarray(cls, dataset: Any) -> "CoolingCurve":
        """Return the curve of a dataset that `to_xarray` made; saved lists come back as tuples.

        >>> again = jaxgran.CoolingCurve.from_xarray(curve.to_xarray())
        >>> bool(jnp.all(again.temperature == curve.temperature))
        True
        """
        arrays = {str(name): jnp.asarray(x.values) for name, x in dataset.variables.items()}
        arrays["times"] = arrays.pop(TIME)
        if STATUS in dataset.attrs:
            arrays[STATUS] = jnp.asarray(dataset.attrs[STATUS])
        return from_arrays(arrays)

    def to_pandas(self) -> Any:
        """Return the curve as a `pandas.DataFrame`, one row per time; needs the extra `notebook`.

        Raises: as `to_xarray`.
        """
        pandas = import_extra("pandas")
        self.check_single()
        known = {name: getattr(self, name) for name in QUANTITIES}
        columns = {name: np.asarray(x) for name, x in known.items() if x is not None}
        return pandas.DataFrame(columns).set_index("times")

    @classmethod
    def from_pandas(cls, frame: Any) -> "CoolingCurve":
        """Return the curve of a table that `to_pandas` made, or of one with columns named alike.

        Args:
            frame: a `pandas.DataFrame` with columns that have the names of fields, as temperature
                and temperature_error, or of the columns of files, as T and T_err, SI; times are a
                column or the index.

        Raises:
            ValueError: for a column that is neither, two columns of one quantity, or no times.

        >>> again = jaxgran.CoolingCurve.from_pandas(curve.to_pandas())
        >>> bool(jnp.all(again.temperature == curve.temperature))
        True
        """
        known = {quantity.column: name for name, quantity in QUANTITIES.items()}
        columns = frame
        if not {"t", "times"} & {*frame.columns}:
            if type(frame.index).__name__ == "RangeIndex":
                raise ValueError(
                    "the table has no times: name their column t, or make it the index"
                )
            columns = frame.reset_index(names="times")
        fields = {str(known.get(name, name)): columns[name].to_numpy() for name in columns.columns}
        if unknown := [name for name in fields if name not in QUANTITIES]:
            raise ValueError(
                f"the column {unknown[0]} is not of a curve: rename or drop it. Known are "
                f"{', '.join(known)}, and the names of the fields of CoolingCurve"
            )
        if len(fields) < len(columns.columns):
            raise ValueError(
                f"two of the columns {', '.join(columns.columns)} are the same quantity: keep one"
            )
        return cls(**fields)

    def check_single(self) -> None:
        """Raise ValueError for several curves in one, as `jax.vmap` returns them."""
        if np.ndim(self.times) != 1:
            raise ValueError(
                f"the times of this curve have shape {np.shape(self.times)}: take one curve, as in "
                "jax.tree.map(lambda x: x[0], curves)"
            )

    @classmethod
    def of_replicas(cls, times: Array, values: dict[str, Any], **others: Any) -> "CoolingCurve":
        """Return the mean of independent replicas, with standard errors for two or more of them.

        Args:
            times: t, s, shape (times,).
            values: fields of the curve by name, each of shape (replicas, times).
            others: further fields, used unchanged; the status is ok by default.
        """
        means: dict[str, Any] = {name: jnp.mean(value, axis=0) for name, value in values.items()}
        num_replicas = len(values["temperature"])
        if num_replicas > 1:
            for name in {quantity.field for quantity in WITH_ERRORS} & set(values):
                # At t = 0 all replicas agree, and the derivative of a root at 0 is not finite.
                deviation = jnp.std(jax.lax.stop_gradient(values[name]), axis=0, ddof=1)
                means[f"{name}_error"] = deviation / num_replicas**0.5
        others.setdefault("status", jnp.asarray(fault_status.OK, jnp.int32))
        return cls(times=times, **means, replicas=cls(times=times, **values), **others)

    def with_saved(self, each: Any) -> "CoolingCurve":
        """Return this curve with saved arrays of its replicas, their mean and its standard error.

        Args:
            each: tree of arrays of shape (replicas, times, ...).
        """
        assert self.replicas is not None
        error = None
        count = len(self.replicas.temperature)
        if count > 1:
            each_held = jax.lax.stop_gradient(each)
            error = jax.tree.map(lambda x: jnp.std(x, axis=0, ddof=1) / count**0.5, each_held)
        return dataclasses.replace(
            self,
            saved=jax.tree.map(lambda x: jnp.mean(x, axis=0), each),
            saved_error=error,
            replicas=dataclasses.replace(self.replicas, saved=each),
        )

    def check_measured(self) -> None:
        """Raise ValueError unless this is one curve of at least `MIN_POINTS` times."""
        shape = np.shape(self.times)
        if len(shape) != 1:
            column = "; make columns lists, as by x.ravel()" if shape[-1:] == (1,) else ""
            raise ValueError(
                f"times of a measured curve have one axis, got shape {shape}{column}; of several "
                "curves take one, as in jax.tree.map(lambda x: x[0], curves)"
            )
        if shape[0] < MIN_POINTS:
            raise ValueError(
                f"a curve needs at least {MIN_POINTS} points, got {shape[0]}; measure the cooling "
                "at more times"
            )
        if np.sum(above_noise(self)) < MIN_POINTS:
            raise ValueError(
                f"T is more than {NOISE:g} errors above 0 at fewer than {MIN_POINTS} times; "
                "measure hotter gases, or with smaller errors"
            )
        if np.shape(self.temperature) != shape:
            raise ValueError(
                f"temperature has shape {np.shape(self.temperature)}, but there are {shape[0]} "
                "times; give one value for each time"
            )


def above_noise(curve: CoolingCurve) -> np.ndarray:
    """Return which rows can be compared in ln T without a model: all if every T is positive."""
    T = np.asarray(curve.temperature)
    if curve.temperature_error is None or np.all(T > 0):
        return T > 0
    return NOISE * np.asarray(curve.temperature_error) < T


def from_arrays(arrays: dict[str, Any], like: CoolingCurve | None = None) -> CoolingCurve:
    """Return the curve with arrays that are named as by `to_arrays`.

    Args:
        arrays: by name.
        like: a curve of the same structure; by default saved arrays come back in dictionaries,
            tuples and `Particles`.

    Raises:
        ValueError: for a name that is not of an array of a curve.
    """
    arrays = {f"times{OF_REPLICAS}": arrays["times"]} | arrays
    if like is not None:
        leaves = [arrays[name] for name in names_of_leaves(like)]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)
    fields = nested_fields(arrays)
    replicas = fields.pop("replicas")
    known = {field.name for field in dataclasses.fields(CoolingCurve)}
    if unknown := sorted((fields.keys() | replicas.keys()) - known):
        raise ValueError(f"{unknown[0]} is not the name of an array of a curve")
    return CoolingCurve(**fields, replicas=CoolingCurve(**replicas) if len(replicas) > 1 else None)
