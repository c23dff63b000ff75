"""Cooling curves: one type for measured and for simulated ones, and its validation.

The options of one run, as opposed to the description of a model.

Curves as tables of xarray and pandas, which are imported here when they are asked for.

What `save` makes of the particles: arrays by name, and their dimensions.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import fields, replace
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

from jaxgran._utils.formatting import Rows, format_quantity, html_table, text_table
from jaxgran._utils.validation import array_if_listed


class Run(NamedTuple):
    """The options of one run. `jaxgran.cool` makes it from its arguments.

    Attributes:
        key: of the random numbers; None is `jax.random.key(0)`. Deterministic models ignore it.
        progress: show a progress bar on a terminal.
        checkpoint: file to which the run is saved and from which it is resumed; None for none.
        save: a function of the particles of each replica, or "particles", whose value at each time
            is `CoolingCurve.saved`; None for nothing.
        trajectory: file to which the particles are written at each time; None for none.

    >>> jaxgran.Run(progress=False).checkpoint is None
    True
    """

    key: PRNGKeyArray | None = None
    progress: bool = False
    checkpoint: str | Path | None = None
    save: Callable[..., Any] | str | None = None
    trajectory: str | Path | None = None


DEFAULTS = Run()
"""A silent run with the default random numbers, not saved."""


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
"""Units of the quantities of a curve, by the names of its fields."""


def import_extra(name: str, extra: str = "notebook") -> Any:
    """A module of an extra.

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


def quantities(curve: Any) -> dict[str, np.ndarray]:
    """What is known at each time, by name, without the times.

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


def to_dataset(curve: Any) -> Any:
    """The `xarray.Dataset` of `CoolingCurve.to_xarray`."""
    xarray = import_extra("xarray")

    def described(name: str, *dims: str, values: np.ndarray) -> tuple:
        return dims, values, {"units": QUANTITY_UNITS[name], "long_name": name.replace("_", " ")}

    found = {name: described(name, "time", values=x) for name, x in quantities(curve).items()}
    if curve.replicas is not None:
        for name in found.keys() & QUANTITY_UNITS.keys():
            values = getattr(curve.replicas, name)
            if values is not None:
                each = described(name, "replica", "time", values=np.asarray(values))
                found[f"{name}_of_replicas"] = each
    if curve.particles is not None:
        for name, unit in (("position", "m"), ("velocity", "m/s")):
            values = np.asarray(getattr(curve.particles, name))
            found[name] = (("replica", "particle", "axis"), values, {"units": unit})
    found |= _saved_variables(curve)
    time = described("times", "time", values=np.asarray(curve.times))
    attributes = {} if curve.status is None else {"status": int(curve.status)}
    return xarray.Dataset(found, coords={"time": time}, attrs=attributes)


def _saved_variables(curve: Any) -> dict[str, tuple]:
    """What ``save=`` made of the particles, by name: dimensions, values and attributes."""

    whole, found = isinstance(curve.saved, Particles), {}
    for name, leaf in saved_arrays(curve).items():
        unit = saved_unit(name, whole)
        attributes = {} if unit is None else {"units": unit}
        found[name] = saved_dimensions(name, np.ndim(leaf), whole), np.asarray(leaf), attributes
    return found


def to_frame(curve: Any) -> Any:
    """The `pandas.DataFrame` of `CoolingCurve.to_pandas`."""
    pandas = import_extra("pandas")
    columns = quantities(curve)
    return pandas.DataFrame(columns, index=pandas.Index(np.asarray(curve.times), name="times"))


MIN_POINTS = 3
"""The smallest number of times of a measured curve."""

COLUMNS = {
    "t": "times",
    "T": "temperature",
    "T_err": "temperature_error",
    "msd": "displacement",
    "msd_err": "displacement_error",
    "T_rot": "rotational_temperature",
    "T_rot_err": "rotational_temperature_error",
}
"""Measured quantities: names of the columns of a file, and the fields of `CoolingCurve`."""

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
"""Columns of further quantities, which a fit does not use, and their fields; in SI."""


class Particles(NamedTuple):
    """Positions and velocities of all particles of all replicas at one time.

    Attributes:
        position: in [0, box_side), m, shape (replicas, N, d).
        velocity: m/s, same shape.
        box_side: side of the periodic cube (d = 3) or square (d = 2), m; of a container its side,
            or d sides.
        angular_velocity: of rough spheres, 1/s, shape (replicas, N, 3), in a plane (replicas, N,
            1); None of smooth ones.

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
    # A run-time type checker lets everything pass, so that a wrong type is reported in words.
    UserParticles = Any

_number_field = partial(eqx.field, converter=array_if_listed)


class CoolingCurve(eqx.Module):
    """Temperature, and what else is known, of a cooling gas at given times; measured or computed.

    All arrays have the shape of `times`, those of `replicas` a first axis of replicas besides.

    Attributes:
        times: t, s, increasing.
        temperature: T = <v^2>/d, m^2/s^2.
        displacement: mean square displacement <dr^2> since t = 0, m^2; None if unknown.
        sonine: a_2, second Sonine coefficient of the velocity distribution; None if unknown.
        third_sonine: a_3, the third one; None if unknown.
        collisions: collisions per particle since t = 0; None if unknown.
        diffusion: self-diffusion coefficient D(t), m^2/s; None if unknown.
        temperature_error: standard error of T, m^2/s^2, of a measured or stochastic curve.
        displacement_error: standard error of <dr^2>, m^2.
        rotational_temperature: T_rot = I <w^2>/(d_rot m), m^2/s^2, of rough spheres; None if
            unknown.
        rotational_temperature_error: its standard error, m^2/s^2.
        velocity_correlation: <v(0) . v(t)>/d, m^2/s^2, of particle models.
        elastic_energy: energy of the contacts per particle, J, of soft spheres.
        dissipated_energy: energy dissipated since t = 0 per particle, J, of soft and hard spheres.
            The sum of (d/2) m T, (d_rot/2) m T_rot, elastic and dissipated energy is constant
            where nothing drives the gas: what drag takes counts as dissipated.
        regularised: impacts per particle, of hard spheres, that were made elastic to prevent
            inelastic collapse.
        flow_share: share of the kinetic energy in the longest waves of the flow, of spheres in
            periodic boxes: see `jaxgran.observables.flow_share`.
        derivative_bias: by which share a projected derivative of ln T is too large, as estimated
            from this share in boxes longer than L_c (`jaxgran.models.error_model`).
        replicas: the curve of each replica, with arrays of shape (replicas, times).
        particles: the final state of a particle model.
        saved: what `cool(save=...)` made of the particles at each time, first axes (times, ...),
            the mean over replicas; where it is "particles", `Particles` of shape (times, replicas,
            N, d).
        saved_error: its standard error, if there are two or more replicas.
        status: 0, or the faults of a run under `jax.jit` or `jax.vmap`, where nothing can be
            raised; values are then nan. `jaxgran.explain_status` puts it into words.

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
        """The curve as an `xarray.Dataset`, with units; needs the extra `notebook`.

        Quantities have the dimension time, those of replicas, with the ending _of_replicas, replica
        and time, positions and velocities replica, particle and axis. What ``save=`` made of the
        particles is named by its place, as ``saved.S.0``, with its standard error in
        ``saved_error.S.0`` and that of each replica in ``saved_of_replicas.S.0``.

        Raises:
            ValueError: for several curves in one, as `jax.vmap` returns them, and where a key of a
                saved dictionary holds "." or "/".
            ModuleNotFoundError: without xarray.
        """
        return to_dataset(self)

    def to_pandas(self) -> Any:
        """The curve as a `pandas.DataFrame`, a row for each time; needs the extra `notebook`.

        Raises: as `to_xarray`.
        """
        return to_frame(self)

    @property
    def _words(self) -> tuple[str, Rows]:
        """Title and rows of a short account of the curve."""
        first = last = ratio = ""
        if not any(isinstance(x, Tracer) for x in (self.times, self.temperature)):
            first, last = (format_quantity(np.asarray(self.times)[..., i], "s") for i in (0, -1))
            T = np.asarray(self.temperature)
            ratio = format_quantity(T[..., -1] / T[..., 0])
            first, last = f", t = {first}", f" to {last}"
        known = [f.name for f in fields(self) if getattr(self, f.name) is not None]
        rows = [("T over its first value", ratio or "traced")]
        rows += [("known", ", ".join(name for name in known if name not in ("times", "status")))]
        if self.status is not None:
            rows.append(("status", format_quantity(self.status)))
        return f"CoolingCurve of {np.shape(self.times)[-1]} times{first}{last}", rows

    @classmethod
    def of_replicas(cls, times: Array, values: dict[str, Any], **others: Any) -> "CoolingCurve":
        """The mean curve of independent replicas, with standard errors if there are two or more.

        Args:
            times: t, s, shape (times,).
            values: fields of the curve by name, each of shape (replicas, times).
            others: further fields, taken over as they are.
        """
        means: dict[str, Any] = {name: jnp.mean(each, axis=0) for name, each in values.items()}
        num_replicas = len(values["temperature"])
        if num_replicas > 1:
            for name in {"temperature", "displacement", "rotational_temperature"} & set(values):
                # At t = 0 all replicas agree, and the derivative of a root at 0 is not finite.
                deviation = jnp.std(jax.lax.stop_gradient(values[name]), axis=0, ddof=1)
                means[f"{name}_error"] = deviation / num_replicas**0.5
        return cls(times=times, **means, replicas=cls(times=times, **values), **others)

    def with_saved(self, each: Any) -> "CoolingCurve":
        """This curve of replicas with a tree saved of each, of arrays (replicas, times, ...)."""
        assert self.replicas is not None
        error, count = None, len(self.replicas.temperature)
        if count > 1:
            each_held = jax.lax.stop_gradient(each)
            error = jax.tree.map(lambda x: jnp.std(x, axis=0, ddof=1) / count**0.5, each_held)
        return replace(
            self,
            saved=jax.tree.map(lambda x: jnp.mean(x, axis=0), each),
            saved_error=error,
            replicas=replace(self.replicas, saved=each),
        )

    def check(self, place: Callable[[int], str] = "point {}".format) -> None:
        """Check that this can be a measured curve: finite, positive, at increasing times.

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
    """Check the values of one measured quantity: one for each time, finite and positive."""
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
            + ("" if column == "T" else " (zero is allowed in a first row at t = 0 only)")
            + "; correct or remove this row"
        )


TIME, REPLICA = "time", "replica"
SAVED = "saved"
OF_REPLICAS = "_of_replicas"
"""The ending of the names of records that have an axis of replicas."""

_MEAN, _ERROR, _EACH = SAVED, f"{SAVED}_error", f"{SAVED}{OF_REPLICAS}"

_PARTICLE_DIMENSIONS = {
    "position": (REPLICA, "particle", "axis"),
    "velocity": (REPLICA, "particle", "axis"),
    "angular_velocity": (REPLICA, "particle", "rotation_axis"),
    "box_side": ("axis",),
}
"""Dimensions after the time, where the particles themselves are saved."""

_PARTICLE_UNITS = {"position": "m", "velocity": "m/s", "angular_velocity": "1/s", "box_side": "m"}

Leaves = dict[str, Any]
"""Arrays by name."""


def is_saved(name: str) -> bool:
    """Whether a record is one of these."""
    return name.partition(".")[0] in (_MEAN, _ERROR, _EACH)


def saved_arrays(curve: CoolingCurve) -> Leaves:
    """The arrays that a curve has saved, named by their places: ``saved.S.0``.

    The standard error is ``saved_error.S.0``, and that of each replica
    ``saved_of_replicas.S.0``.
    """
    return {
        _saved_name(part, path): leaf
        for part, tree in _saved_parts(curve).items()
        for path, leaf in jax.tree.flatten_with_path(tree)[0]
    }


def with_saved_arrays(curve: CoolingCurve, like: CoolingCurve, found: Leaves) -> CoolingCurve:
    """A curve with these arrays in the trees in which another one has them."""
    trees = {}
    for part, tree in _saved_parts(like).items():
        paths, structure = jax.tree.flatten_with_path(tree)
        trees[part] = jax.tree.unflatten(
            structure, [found[_saved_name(part, path)] for path, _ in paths]
        )
    if _EACH in trees:
        assert curve.replicas is not None
        replicas = dataclasses.replace(curve.replicas, saved=trees.pop(_EACH))
        curve = dataclasses.replace(curve, replicas=replicas)
    return dataclasses.replace(curve, **trees)


def saved_dimensions(name: str, ndim: int, whole: bool) -> tuple[str, ...]:
    """Labels of the axes of one member's array.

    Args:
        name: of `leaves`.
        ndim: number of its axes.
        whole: whether the particles themselves are saved.
    """
    part, _, place = name.partition(".")
    if whole:
        return (TIME, *_PARTICLE_DIMENSIONS[place][: ndim - 1])
    first = (REPLICA, TIME) if part == _EACH else (TIME,)
    own = f"{SAVED}.{place}" if place else SAVED
    return *first, *(f"{own}.axis{k}" for k in range(ndim - len(first)))


def saved_unit(name: str, whole: bool) -> str | None:
    """The unit of an array; None where a user's function determines it."""
    return _PARTICLE_UNITS[name.partition(".")[2]] if whole else None


def _saved_parts(curve: CoolingCurve) -> dict[str, Any]:
    """The trees of a curve that hold what was saved, by the beginnings of their names."""
    each = None if curve.replicas is None else curve.replicas.saved
    trees = {_MEAN: curve.saved, _ERROR: curve.saved_error, _EACH: each}
    return {part: tree for part, tree in trees.items() if tree is not None}


def _saved_name(part: str, path: tuple[Any, ...]) -> str:
    """The name of an array at a place in a tree.

    Raises:
        ValueError: for a key of a dictionary that would make it ambiguous.
    """
    keys = [jax.tree_util.keystr((key,), simple=True) for key in path]
    for key in keys:
        if "." in key or "/" in key:
            raise ValueError(
                f"save returns a dictionary with the key {key!r}: keys name arrays of a store "
                'or of an xarray.Dataset, leave "." and "/" out'
            )
    return ".".join([part, *keys])
