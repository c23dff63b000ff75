"""Cooling curves, measured or simulated: the type, its quantities, and its tables.

`QUANTITIES` names each quantity, its unit and its column in files. `CoolingCurve` holds quantities
at given times, `Particles` the particles, and `Run` the options of the run that computes a curve.
`to_arrays` names all arrays of a curve, as npz files, sweeps and xarray hold them.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxgran._utils import status as fault_status
from jaxgran._utils.formatting import format_quantity, text_table
from jaxgran._utils.validation import list_to_array


class Quantity(NamedTuple):
    """A quantity of a cooling curve.

    Attributes:
        field: of `CoolingCurve`.
        column: in a CSV file; its standard error has the column and field with _err and _error.
        unit: SI; "1" for a number without one.
        label: what it is, in words.
        measured: whether experiments measure it, so that a fit may use it.
    """

    field: str
    column: str
    unit: str
    label: str
    measured: bool = False

    @property
    def error(self) -> "Quantity":
        """The standard error of this quantity."""
        label = f"standard error of {self.label}"
        return Quantity(f"{self.field}_error", f"{self.column}_err", self.unit, label, True)


WITH_ERRORS = (
    Quantity("temperature", "T", "m^2/s^2", "temperature <v^2>/d", True),
    Quantity("displacement", "msd", "m^2", "mean square displacement", True),
    Quantity("rotational_temperature", "T_rot", "m^2/s^2", "T_rot = I <w^2>/(d_rot m)", True),
)
"""Quantities that have standard errors."""

QUANTITIES = {
    quantity.field: quantity
    for quantity in (
        Quantity("times", "t", "s", "time", True),
        *(part for measured in WITH_ERRORS for part in (measured, measured.error)),
        Quantity("sonine", "a2", "1", "second Sonine coefficient"),
        Quantity("third_sonine", "a3", "1", "third Sonine coefficient"),
        Quantity("size_ratio", "size_ratio", "1", "<v^2> of small over <v^2> of large spheres"),
        Quantity("collisions", "collisions", "1", "collisions per particle since t = 0"),
        Quantity("diffusion", "D", "m^2/s", "self-diffusion coefficient"),
        Quantity("velocity_correlation", "velocity_correlation", "m^2/s^2", "<v(0) . v(t)>/d"),
        Quantity("elastic_energy", "elastic_energy", "J", "energy of contacts per particle"),
        Quantity("dissipated_energy", "dissipated_energy", "J", "dissipated energy per particle"),
        Quantity("regularised", "regularised", "1", "impacts per particle made elastic"),
        Quantity("flow_share", "flow_share", "1", "share of kinetic energy in the longest waves"),
        Quantity("derivative_bias", "derivative_bias", "1", "bias of projected d ln T"),
    )
}
"""Quantities by field, in the order of the columns of a file."""

MIN_POINTS = 3
"""Smallest number of times of a measured curve."""


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
            (d_rot/2) m T_rot, elastic and dissipated energy is constant.
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
        if _is_known(self.times):
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
        labelled = {
            name: (dims, arrays[name], attrs)
            for name in arrays
            for dims, attrs in [label_of(name, arrays[name].ndim, are_particles)]
        }
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


def check_values(
    fields: dict[str, Any], status: Any = None, place: Callable[[int], str] = "point {}".format
) -> None:
    """Check the lengths of the fields of a curve, and the values of a measured one.

    Args:
        fields: by name; times are known.
        status: of a computed curve, the values of which are not checked.
        place: returns the name of a point, given its index, for error messages.

    Raises:
        ValueError: naming the first wrong point, and saying what to do.
    """
    times = np.asarray(fields["times"])
    known = {name: fields[name] for name in QUANTITIES if fields.get(name) is not None}
    for name, values in known.items():
        if np.shape(values)[-1:] != times.shape[-1:]:
            raise ValueError(
                f"{name} has shape {np.shape(values)}, but times have shape {times.shape}; give "
                "one value for each time"
            )
    if status is not None or times.ndim != 1:
        return
    for name, values in known.items():
        if QUANTITIES[name].measured and _is_known(values) and np.ndim(values) == 1:
            error = known.get(f"{name}_error")
            error = np.asarray(error) if _is_known(error) else np.zeros(1)
            _check_signs(QUANTITIES[name], np.asarray(values), error, times, place)
    not_later = np.flatnonzero(np.diff(times) <= 0)
    if not_later.size:
        i = int(not_later[0]) + 1
        raise ValueError(
            f"{place(i)}: t is {times[i]:g} after {times[i - 1]:g}; times must increase: sort "
            "the rows by time and remove repeated ones"
        )


def _check_signs(
    quantity: Quantity,
    values: np.ndarray,
    error: np.ndarray,
    times: np.ndarray,
    place: Callable[[int], str],
) -> None:
    column = quantity.column
    zero_allowed = np.zeros(values.shape, bool)
    zero_allowed[:1] = column != "T" and (column == "t" or times[0] == 0)
    allowed = (values > 0) | (error > 0) | (zero_allowed & (values == 0))
    wrong = ~(np.isfinite(values) & allowed)
    if not np.any(wrong):
        return
    i = int(np.argmax(wrong))
    zero = " (zero is allowed only in a first row at t = 0)" if column != "T" else ""
    advice = "correct or remove this row"
    if quantity in WITH_ERRORS and values[i] <= 0:
        advice += (
            f"; if noise was subtracted, give {quantity.error.column}: {column} may then be "
            "negative, and rows that are left out make A wrong"
        )
    raise ValueError(
        f"{place(i)}: {column} is {values[i]:g}, it must be a positive number{zero}; {advice}"
    )


NOISE = 3.0
"""T, or <dr^2>, over its error below which a row does not count as above the noise."""


def above_noise(curve: CoolingCurve) -> np.ndarray:
    """Return which rows can be compared in ln T without a model: all if every T is positive."""
    T = np.asarray(curve.temperature)
    if curve.temperature_error is None or np.all(T > 0):
        return T > 0
    return NOISE * np.asarray(curve.temperature_error) < T


def _is_known(values: Any) -> bool:
    """Return whether values are numbers, and neither traced nor None nor a placeholder."""
    is_array = isinstance(values, jax.Array | np.ndarray)
    return is_array and not isinstance(values, Tracer)


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
        starts: equilibrated random starts of earlier runs, which runs of spheres read and extend: a
            run that finds its gas there takes the positions and draws new velocities. None
            equilibrates each run.

    >>> jaxgran.extend.Run(progress=False).checkpoint is None
    True
    """

    key: PRNGKeyArray | None = None
    progress: bool = False
    checkpoint: str | Path | None = None
    save: Callable[..., Any] | str | None = None
    trajectory: str | Path | None = None
    starts: dict[str, Any] | None = None


DEFAULTS = Run()
"""A silent run with the default random numbers, which saves nothing."""


def import_extra(name: str, extra: str = "notebook") -> Any:
    """Import a module that an extra of jaxgran installs.

    Raises:
        ModuleNotFoundError: if it is not installed, naming the extra.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0]
        if error.name != package:
            raise
        raise ModuleNotFoundError(
            f'this needs {package}: pip install "jaxgran[{extra}]"', name=package
        ) from None


TIME = "time"
REPLICA = "replica"
STATUS = "status"
SAVED = "saved"
OF_REPLICAS = "_of_replicas"
"""Ending of the names of arrays that have an axis of replicas."""

_PARTICLES = {
    "position": ("m", REPLICA, "particle", "axis"),
    "velocity": ("m/s", REPLICA, "particle", "axis"),
    "box_side": ("m", "axis"),
    "angular_velocity": ("1/s", REPLICA, "particle", "rotation_axis"),
}
"""Unit and dimensions of the arrays of `Particles`."""


def to_arrays(curve: CoolingCurve) -> dict[str, Any]:
    """Return the arrays of a curve by name: `from_arrays` is the inverse.

    A quantity has the name of its field; its values by replica have the suffix _of_replicas. The
    final particles have the names of their fields. A saved array is named by its place in the tree:
    ``saved.S.0`` the mean, ``saved_error.S.0`` its standard error, ``saved_of_replicas.S.0`` the
    values of each replica.

    Raises:
        ValueError: for a key of a saved dictionary that would make a name ambiguous.
    """
    arrays = dict(zip(_names_of_leaves(curve), jax.tree.leaves(curve), strict=True))
    arrays.pop(f"times{OF_REPLICAS}", None)
    return arrays


def _names_of_leaves(curve: CoolingCurve) -> list[str]:
    """Return the name of each leaf of a curve, after a check that it is unique."""
    names = []
    for path, _ in jax.tree.flatten_with_path(curve)[0]:
        keys = [jax.tree_util.keystr((key,), simple=True) for key in path]
        for entry, key in zip(path, keys, strict=True):
            is_index = isinstance(entry, jax.tree_util.SequenceKey)
            if "." in key or "/" in key or (key.isdigit() and not is_index):
                raise ValueError(
                    f"save returns a dictionary with the key {key!r}: keys name arrays of a file "
                    'or of an xarray.Dataset. Use words without "." and "/"'
                )
        if keys[0] == "replicas":
            keys = [f"{keys[1]}{OF_REPLICAS}", *keys[2:]]
        names.append(".".join(keys[1:] if keys[0] == "particles" else keys))
    return names


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
        leaves = [arrays[name] for name in _names_of_leaves(like)]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)
    places = {}
    for name, array in arrays.items():
        group, _, place = name.partition(".")
        if group in _PARTICLES:
            name = f"particles.{name}"
        elif group.endswith(OF_REPLICAS):
            name = f"replicas.{group.removesuffix(OF_REPLICAS)}.{place}".rstrip(".")
        places[name] = array
    fields = _nest(places)
    replicas = fields.pop("replicas")
    known = {field.name for field in dataclasses.fields(CoolingCurve)}
    if unknown := sorted((fields.keys() | replicas.keys()) - known):
        raise ValueError(f"{unknown[0]} is not the name of an array of a curve")
    return CoolingCurve(**fields, replicas=CoolingCurve(**replicas) if len(replicas) > 1 else None)


def _nest(arrays: dict[str, Any]) -> Any:
    """Return an array, or a dictionary, a tuple or `Particles` of them, by their places."""
    if "" in arrays:
        return arrays[""]
    children: dict[str, dict[str, Any]] = {}
    for name, array in arrays.items():
        first, _, rest = name.partition(".")
        children.setdefault(first, {})[rest] = array
    nested = {name: _nest(inner) for name, inner in children.items()}
    if all(name.isdigit() for name in nested):
        return tuple(nested[str(k)] for k in range(len(nested)))
    is_particles = {*nested, "angular_velocity"} == {*Particles._fields}
    return Particles(**nested) if is_particles else nested


def label_of(
    name: str, ndim: int, are_particles: bool = False
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the dimensions and the attributes (units, long_name) of an array of a curve.

    Args:
        name: from `to_arrays`.
        ndim: number of its axes.
        are_particles: whether `Particles` are saved.
    """
    group, _, place = name.partition(".")
    first = (REPLICA, TIME) if group.endswith(OF_REPLICAS) else (TIME,)
    if group in _PARTICLES or (group == SAVED and are_particles):
        unit, *dims = _PARTICLES[place or group]
        dims = [*(first if place else ()), *dims]
        return tuple(dims[:ndim]), {"units": unit, "long_name": (place or group).replace("_", " ")}
    if group.startswith(SAVED):  # of a function of the user, who knows its unit
        base = f"{SAVED}.{place}" if place else SAVED
        axes = (f"{base}.axis{k}" for k in range(ndim - len(first)))
        return (*first, *axes), {"long_name": name.replace("_", " ")}
    quantity = QUANTITIES[group.removesuffix(OF_REPLICAS)]
    return first, {"units": quantity.unit, "long_name": quantity.label}
