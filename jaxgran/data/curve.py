"""Cooling curves, measured or simulated: the type, its quantities, and its tables.

`CoolingCurve` holds quantities at given times, `Particles` the particles, and `Run` the options of
the run that computes a curve. The tables below name each quantity, its unit and its column in
files. Curves become tables of xarray and pandas, which are imported on demand.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxgran._utils.formatting import TableRows, format_quantity, html_table, text_table
from jaxgran._utils.validation import list_to_array


class Particles(NamedTuple):
    """Positions and velocities of all particles of all replicas at one time.

    Attributes:
        position: in [0, box_side), m, shape (replicas, N, d).
        velocity: m/s, same shape.
        box_side: side of the periodic cube (d = 3) or square (d = 2), m; for a container its side,
            or its d sides.
        angular_velocity: 1/s, shape (replicas, N, 3), in a plane (replicas, N, 1); None for smooth
            spheres.

    >>> side, apart = gas.box_side(2), jnp.array([[[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]]])
    >>> start = jaxgran.Particles(apart, jnp.zeros((1, 2, 3)), side)
    >>> start.position.shape  # replicas, N, d
    (1, 2, 3)
    """

    position: Float[Array, "replicas N d"]
    velocity: Float[Array, "replicas N d"]
    box_side: Float[Array, "..."]
    angular_velocity: Float[Array, "replicas N spins"] | None = None


if TYPE_CHECKING:
    UserParticles = Particles
else:
    # A run-time type checker accepts everything, so that jaxgran's message reports a wrong type.
    UserParticles = Any

_number_field = partial(eqx.field, converter=list_to_array)


class CoolingCurve(eqx.Module):
    """Temperature and further quantities of a cooling gas at given times, measured or computed.

    All arrays have the shape of `times`; those of `replicas` have the shape (replicas, times).
    A quantity that is not known is None.

    Attributes:
        times: t, s, increasing.
        temperature: T = <v^2>/d, m^2/s^2.
        displacement: mean square displacement <dr^2> since t = 0, m^2.
        sonine: a_2, second Sonine coefficient of the velocity distribution.
        third_sonine: a_3, third Sonine coefficient.
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
            (d_rot/2) m T_rot, elastic and dissipated energy is constant.
        regularised: impacts per particle, of hard spheres, that were made elastic to prevent
            inelastic collapse.
        flow_share: share of the kinetic energy in the longest waves of the flow, of spheres in
            periodic boxes: see `jaxgran.observables.flow_share`.
        derivative_bias: share by which a projected derivative of ln T is too large, estimated
            from flow_share in boxes longer than L_c (`jaxgran.models.error_model`).
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

    times: Float[Array, "times"] = _number_field()
    temperature: Float[Array, "... times"] = _number_field()
    displacement: Float[Array, "... times"] | None = _number_field(default=None)
    sonine: Float[Array, "... times"] | None = _number_field(default=None)
    third_sonine: Float[Array, "... times"] | None = _number_field(default=None)
    collisions: Float[Array, "... times"] | None = _number_field(default=None)
    diffusion: Float[Array, "... times"] | None = _number_field(default=None)
    temperature_error: Float[Array, "... times"] | None = _number_field(default=None)
    displacement_error: Float[Array, "... times"] | None = _number_field(default=None)
    rotational_temperature: Float[Array, "... times"] | None = _number_field(default=None)
    rotational_temperature_error: Float[Array, "... times"] | None = _number_field(default=None)
    velocity_correlation: Float[Array, "... times"] | None = _number_field(default=None)
    elastic_energy: Float[Array, "... times"] | None = _number_field(default=None)
    dissipated_energy: Float[Array, "... times"] | None = _number_field(default=None)
    regularised: Float[Array, "... times"] | None = _number_field(default=None)
    flow_share: Float[Array, "... times"] | None = _number_field(default=None)
    derivative_bias: Float[Array, "... times"] | None = _number_field(default=None)
    replicas: "CoolingCurve | None" = None
    particles: Particles | None = None
    saved: Any = None
    saved_error: Any = None
    status: Int[Array, ""] | None = None

    def __repr__(self) -> str:
        return text_table(*self._words)

    def _repr_html_(self) -> str:
        return html_table(*self._words)

    def to_xarray(self) -> Any:
        """Return the curve as an `xarray.Dataset` with units; needs the extra `notebook`.

        Quantities have the dimension time. Those of replicas, whose names end in _of_replicas, have
        the dimensions replica and time; positions and velocities have replica, particle and axis.
        The arrays of ``save=`` are named by their place in the tree, as ``saved.S.0``, with the
        standard error in ``saved_error.S.0`` and the values of each replica in
        ``saved_of_replicas.S.0``.

        Raises:
            ValueError: for several curves in one, as `jax.vmap` returns them, or if a key of a
                saved dictionary contains "." or "/".
            ModuleNotFoundError: without xarray.
        """
        return _to_dataset(self)

    def to_pandas(self) -> Any:
        """Return the curve as a `pandas.DataFrame`, one row per time; needs the extra `notebook`.

        Raises: as `to_xarray`.
        """
        pandas = import_extra("pandas")
        columns = _known_quantities(self)
        return pandas.DataFrame(columns, index=pandas.Index(np.asarray(self.times), name="times"))

    @property
    def _words(self) -> tuple[str, TableRows]:
        """Title and rows of a short account of the curve."""
        first = last = ratio = ""
        if not any(isinstance(x, Tracer) for x in (self.times, self.temperature)):
            first, last = (format_quantity(np.asarray(self.times)[..., i], "s") for i in (0, -1))
            T = np.asarray(self.temperature)
            ratio = format_quantity(T[..., -1] / T[..., 0])
            first, last = f", t = {first}", f" to {last}"
        known = [f.name for f in dataclasses.fields(self) if getattr(self, f.name) is not None]
        rows = [("T over its first value", ratio or "traced")]
        rows += [("known", ", ".join(name for name in known if name not in ("times", "status")))]
        if self.status is not None:
            rows.append(("status", format_quantity(self.status)))
        return f"CoolingCurve of {np.shape(self.times)[-1]} times{first}{last}", rows

    @classmethod
    def of_replicas(cls, times: Array, values: dict[str, Any], **others: Any) -> "CoolingCurve":
        """Return the mean of independent replicas, with standard errors for two or more of them.

        Args:
            times: t, s, shape (times,).
            values: fields of the curve by name, each of shape (replicas, times).
            others: further fields, used unchanged.
        """
        means: dict[str, Any] = {name: jnp.mean(value, axis=0) for name, value in values.items()}
        num_replicas = len(values["temperature"])
        if num_replicas > 1:
            for name in {"temperature", "displacement", "rotational_temperature"} & set(values):
                # At t = 0 all replicas agree, and the derivative of a root at 0 is not finite.
                deviation = jnp.std(jax.lax.stop_gradient(values[name]), axis=0, ddof=1)
                means[f"{name}_error"] = deviation / num_replicas**0.5
        return cls(times=times, **means, replicas=cls(times=times, **values), **others)

    def with_saved(self, each: Any) -> "CoolingCurve":
        """Return this curve with saved arrays of its replicas, their mean and its standard error.

        Args:
            each: tree of arrays of shape (replicas, times, ...).
        """
        assert self.replicas is not None
        error, count = None, len(self.replicas.temperature)
        if count > 1:
            each_held = jax.lax.stop_gradient(each)
            error = jax.tree.map(lambda x: jnp.std(x, axis=0, ddof=1) / count**0.5, each_held)
        return dataclasses.replace(
            self,
            saved=jax.tree.map(lambda x: jnp.mean(x, axis=0), each),
            saved_error=error,
            replicas=dataclasses.replace(self.replicas, saved=each),
        )

    def check(self, place: Callable[[int], str] = "point {}".format) -> None:
        """Check that this can be a measured curve: finite and positive values, increasing times.

        At t = 0, where the state of the gas was prepared, an error and a displacement may be 0.
        Traced curves are not checked.

        Args:
            place: returns the name of a point, given its index, for error messages.

        Raises:
            ValueError: naming the first wrong point, and saying what to do.
        """
        if isinstance(self.times, Tracer) or isinstance(self.temperature, Tracer):
            return
        times = np.asarray(self.times)
        if times.ndim != 1 or times.size < MIN_POINTS:
            raise ValueError(
                f"a curve needs at least {MIN_POINTS} points, got {times.size}; "
                "measure the cooling at more times"
            )
        for column, field in COLUMNS.items():
            values = getattr(self, field)
            if values is not None and not isinstance(values, Tracer):
                _check_column(column, np.asarray(values), times, place)
        for column, field in COMPUTED_COLUMNS.items():
            values = getattr(self, field)
            if values is not None and np.shape(values) != times.shape:
                raise ValueError(
                    f"{column} has shape {np.shape(values)}, but there are {times.size} times; "
                    "give one value for each time"
                )
        not_later = np.flatnonzero(np.diff(times) <= 0)
        if not_later.size:
            i = int(not_later[0]) + 1
            raise ValueError(
                f"{place(i)}: t is {times[i]:g} after {times[i - 1]:g}; times must increase: "
                "sort the rows by time and remove repeated ones"
            )


def _check_column(
    column: str,
    values: np.ndarray,
    times: Float[np.ndarray, "times"],
    place: Callable[[int], str],
) -> None:
    if values.shape != times.shape:
        raise ValueError(
            f"{column} has shape {values.shape}, but there are {times.size} times; "
            "give one value for each time"
        )
    zero_allowed = np.zeros(times.shape, bool)
    if column != "T":
        zero_allowed[0] = column == "t" or times[0] == 0
    wrong = ~np.isfinite(values) | ~((values > 0) | zero_allowed & (values == 0))
    if np.any(wrong):
        i = int(np.argmax(wrong))
        raise ValueError(
            f"{place(i)}: {column} is {values[i]:g}, it must be a positive number"
            + ("" if column == "T" else " (zero is allowed only in a first row at t = 0)")
            + "; correct or remove this row"
        )


class Run(NamedTuple):
    """Options of one run, which `jaxgran.cool` makes from its arguments.

    Attributes:
        key: key of the random numbers; None stands for `jax.random.key(0)`. Deterministic models
            ignore it.
        progress: whether to show a progress bar on a terminal.
        checkpoint: file to which the run is saved and from which it is resumed, or None.
        save: function of the particles of each replica, or "particles". Its value at each time
            becomes `CoolingCurve.saved`. None saves nothing.
        trajectory: file to which the particles are written at each time, or None.

    >>> jaxgran.Run(progress=False).checkpoint is None
    True
    """

    key: PRNGKeyArray | None = None
    progress: bool = False
    checkpoint: str | Path | None = None
    save: Callable[..., Any] | str | None = None
    trajectory: str | Path | None = None


DEFAULTS = Run()
"""A silent run with the default random numbers, which saves nothing."""

QUANTITY_UNITS = {
    "times": "s",
    "temperature": "m^2/s^2",
    "temperature_error": "m^2/s^2",
    "displacement": "m^2",
    "displacement_error": "m^2",
    "sonine": "1",
    "third_sonine": "1",
    "collisions": "1",
    "diffusion": "m^2/s",
    "rotational_temperature": "m^2/s^2",
    "rotational_temperature_error": "m^2/s^2",
    "velocity_correlation": "m^2/s^2",
    "elastic_energy": "J",
    "dissipated_energy": "J",
    "regularised": "1",
    "flow_share": "1",
    "derivative_bias": "1",
}
"""Unit of each quantity of a curve, by the name of its field."""

COLUMNS = {
    "t": "times",
    "T": "temperature",
    "T_err": "temperature_error",
    "msd": "displacement",
    "msd_err": "displacement_error",
    "T_rot": "rotational_temperature",
    "T_rot_err": "rotational_temperature_error",
}
"""Columns of measured quantities in a file, and their fields of `CoolingCurve`."""

COMPUTED_COLUMNS = {
    "a2": "sonine",
    "a3": "third_sonine",
    "collisions": "collisions",
    "D": "diffusion",
    "velocity_correlation": "velocity_correlation",
    "elastic_energy": "elastic_energy",
    "dissipated_energy": "dissipated_energy",
    "regularised": "regularised",
    "flow_share": "flow_share",
    "derivative_bias": "derivative_bias",
}
"""Columns of further quantities, in SI, which a fit does not use, and their fields."""

MIN_POINTS = 3
"""Smallest number of times of a measured curve."""


def import_extra(name: str, extra: str = "notebook") -> Any:
    """Import a module that an extra of jaxgran installs.

    Raises:
        ModuleNotFoundError: if it is not installed, naming the extra.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise ModuleNotFoundError(
            f'this needs {name}: pip install "jaxgran[{extra}]"', name=name
        ) from None


def _known_quantities(curve: CoolingCurve) -> dict[str, np.ndarray]:
    """Return the known quantities of a single curve by name, without the times.

    Raises:
        ValueError: for several curves in one, as `jax.vmap` returns them.
    """
    if np.ndim(curve.times) != 1:
        raise ValueError(
            f"the times of this curve have shape {np.shape(curve.times)}: take one curve, as in "
            "jax.tree.map(lambda x: x[0], curves)"
        )
    known = {name: getattr(curve, name, None) for name in QUANTITY_UNITS if name != "times"}
    return {name: np.asarray(values) for name, values in known.items() if values is not None}


def _to_dataset(curve: CoolingCurve) -> Any:
    xarray = import_extra("xarray")

    def variable(name: str, *dims: str, values: np.ndarray) -> tuple:
        return dims, values, {"units": QUANTITY_UNITS[name], "long_name": name.replace("_", " ")}

    variables = {
        name: variable(name, "time", values=x) for name, x in _known_quantities(curve).items()
    }
    if curve.replicas is not None:
        for name in variables.keys() & QUANTITY_UNITS.keys():
            values = getattr(curve.replicas, name)
            if values is not None:
                variables[f"{name}{OF_REPLICAS}"] = variable(
                    name, "replica", "time", values=np.asarray(values)
                )
    if curve.particles is not None:
        for name, unit in (("position", "m"), ("velocity", "m/s")):
            values = np.asarray(getattr(curve.particles, name))
            variables[name] = (("replica", "particle", "axis"), values, {"units": unit})
    variables |= _saved_variables(curve)
    time = variable("times", "time", values=np.asarray(curve.times))
    attributes = {} if curve.status is None else {"status": int(curve.status)}
    return xarray.Dataset(variables, coords={"time": time}, attrs=attributes)


def _saved_variables(curve: CoolingCurve) -> dict[str, tuple]:
    """Return dimensions, values and attributes of each array that ``save=`` returned."""
    are_particles, variables = isinstance(curve.saved, Particles), {}
    for name, array in saved_arrays(curve).items():
        unit = saved_unit(name, are_particles)
        attributes = {} if unit is None else {"units": unit}
        dims = saved_dimensions(name, np.ndim(array), are_particles)
        variables[name] = dims, np.asarray(array), attributes
    return variables


TIME, REPLICA = "time", "replica"
SAVED = "saved"
OF_REPLICAS = "_of_replicas"
"""Ending of the names of arrays that have an axis of replicas."""

_MEAN, _ERROR, _EACH = SAVED, f"{SAVED}_error", f"{SAVED}{OF_REPLICAS}"

_PARTICLE_DIMENSIONS = {
    "position": (REPLICA, "particle", "axis"),
    "velocity": (REPLICA, "particle", "axis"),
    "angular_velocity": (REPLICA, "particle", "rotation_axis"),
    "box_side": ("axis",),
}
"""Dimensions after the time of saved `Particles`."""

_PARTICLE_UNITS = {"position": "m", "velocity": "m/s", "angular_velocity": "1/s", "box_side": "m"}


def is_saved(name: str) -> bool:
    """Return whether an array of this name comes from `saved_arrays`."""
    return name.partition(".")[0] in (_MEAN, _ERROR, _EACH)


def saved_arrays(curve: CoolingCurve) -> dict[str, Any]:
    """Return the saved arrays of a curve, named by their places in the tree.

    A mean is named as ``saved.S.0``, its standard error ``saved_error.S.0``, and the values of each
    replica ``saved_of_replicas.S.0``.
    """
    return {
        _saved_name(part, path): leaf
        for part, tree in _saved_trees(curve).items()
        for path, leaf in jax.tree.flatten_with_path(tree)[0]
    }


def with_saved_arrays(
    curve: CoolingCurve, like: CoolingCurve, arrays: dict[str, Any]
) -> CoolingCurve:
    """Return a curve with these saved arrays, in trees of the structure that `like` has."""
    trees = {}
    for part, tree in _saved_trees(like).items():
        paths, structure = jax.tree.flatten_with_path(tree)
        trees[part] = jax.tree.unflatten(
            structure, [arrays[_saved_name(part, path)] for path, _ in paths]
        )
    if _EACH in trees:
        assert curve.replicas is not None
        replicas = dataclasses.replace(curve.replicas, saved=trees.pop(_EACH))
        curve = dataclasses.replace(curve, replicas=replicas)
    return dataclasses.replace(curve, **trees)


def saved_dimensions(name: str, ndim: int, are_particles: bool) -> tuple[str, ...]:
    """Return the labels of the axes of a saved array.

    Args:
        name: name of the array, from `saved_arrays`.
        ndim: number of its axes.
        are_particles: whether `Particles` are saved.
    """
    part, _, place = name.partition(".")
    if are_particles:
        return (TIME, *_PARTICLE_DIMENSIONS[place][: ndim - 1])
    first = (REPLICA, TIME) if part == _EACH else (TIME,)
    base = f"{SAVED}.{place}" if place else SAVED
    return *first, *(f"{base}.axis{k}" for k in range(ndim - len(first)))


def saved_unit(name: str, are_particles: bool) -> str | None:
    """Return the unit of a saved array, or None where a user's function determines it."""
    return _PARTICLE_UNITS[name.partition(".")[2]] if are_particles else None


def _saved_trees(curve: CoolingCurve) -> dict[str, Any]:
    """Return the saved trees of a curve by the first part of their names."""
    each = None if curve.replicas is None else curve.replicas.saved
    trees = {_MEAN: curve.saved, _ERROR: curve.saved_error, _EACH: each}
    return {part: tree for part, tree in trees.items() if tree is not None}


def _saved_name(part: str, path: tuple[Any, ...]) -> str:
    """Return the name of an array at a place in a tree.

    Raises:
        ValueError: for a key of a dictionary that would make the name ambiguous.
    """
    keys = [jax.tree_util.keystr((key,), simple=True) for key in path]
    for key in keys:
        if "." in key or "/" in key:
            raise ValueError(
                f"save returns a dictionary with the key {key!r}: keys name arrays of a store "
                'or of an xarray.Dataset. Leave "." and "/" out'
            )
    return ".".join([part, *keys])
