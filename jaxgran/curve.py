"""CoolingCurve: one type for measured and for simulated curves, and its file format."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxgran.checkpoint import write_whole
from jaxgran.gas import Gas, sphere_mass
from jaxgran.restitution import Viscoelastic

MIN_POINTS = 3
COLUMNS = {
    "t": "times",
    "T": "temperature",
    "T_err": "temperature_error",
    "msd": "displacement",
    "msd_err": "displacement_error",
}
"""Columns of a curve file and the fields they fill; t and T are required."""

GAS_KEYS = ("eta", "diameter", "density", "Y", "nu", "T0")
"""Header keys, beside N, without which a file does not tell the gas."""


class Particles(NamedTuple):
    """Every particle of every replica at one time, SI.

    Attributes:
        position: in [0, box_side), m, shape (replicas, N, d).
        velocity: m/s, same shape.
        box_side: of the periodic cube (square), m.
    """

    position: Float[Array, "replicas N d"]
    velocity: Float[Array, "replicas N d"]
    box_side: Float[Array, ""]


class CoolingCurve(eqx.Module):
    """How a gas cooled and spread, measured or computed. All arrays have the shape of `times`.

    Attributes:
        times: t, s, increasing.
        temperature: T = <v^2>/d, m^2/s^2.
        displacement: mean square displacement <dr^2> since t = 0, m^2; None if unknown.
        sonine: a_2, the excess kurtosis of the velocities; None if unknown.
        collisions: collisions per particle since t = 0; None if unknown.
        diffusion: self-diffusion coefficient D(t), m^2/s; None if unknown.
        temperature_error: standard error of T, of a measured or stochastic curve.
        displacement_error: standard error of <dr^2>.
        velocity_correlation: <v(0) . v(t)>/d, m^2/s^2, of particle models.
        elastic_energy, dissipated_energy: per particle, J; with (d/2) m T they add up to the
            energy at the start. Of soft spheres; of hard ones the dissipated energy.
        regularised: collisions per particle that were made elastic lest the gas collapse; of hard
            spheres.
        replicas: the same curve of each replica, all arrays of shape (replicas, times).
        particles: the last state of a particle model.
        status: 0, or what went wrong under `jax.jit` or `jax.vmap`, where nothing can be raised
            (values are then nan); `jaxgran.status.explain` says it in words.
    """

    times: Float[Array, "times"]
    temperature: Float[Array, "times"]
    displacement: Float[Array, "times"] | None = None
    sonine: Float[Array, "times"] | None = None
    collisions: Float[Array, "times"] | None = None
    diffusion: Float[Array, "times"] | None = None
    temperature_error: Float[Array, "times"] | None = None
    displacement_error: Float[Array, "times"] | None = None
    velocity_correlation: Float[Array, "times"] | None = None
    elastic_energy: Float[Array, "times"] | None = None
    dissipated_energy: Float[Array, "times"] | None = None
    regularised: Float[Array, "times"] | None = None
    replicas: "CoolingCurve | None" = None
    particles: Particles | None = None
    status: Int[Array, ""] | None = None

    @classmethod
    def of_replicas(cls, times: Array, values: dict[str, Any], **others: Any) -> "CoolingCurve":
        """The mean over replicas, with its standard error if there are two or more."""
        found: dict[str, Any] = {name: jnp.mean(each, axis=0) for name, each in values.items()}
        num_replicas = len(values["temperature"])
        if num_replicas > 1:
            for name in ("temperature", "displacement"):
                # Where all replicas agree, at t = 0, a root has no derivative.
                deviation = jnp.std(jax.lax.stop_gradient(values[name]), axis=0, ddof=1)
                found[f"{name}_error"] = deviation / num_replicas**0.5
        return cls(times=times, **found, replicas=cls(times=times, **values), **others)

    def check(self, place: Callable[[int], str] = "point {}".format) -> None:
        """Raise ValueError if this cannot be a measured curve. Traced values pass unseen.

        A first point at t = 0 may have zero error: the state in which the gas was prepared.

        Args:
            place: names a point, given its index.
        """
        if isinstance(self.times, Tracer) or isinstance(self.temperature, Tracer):
            return
        times = np.asarray(self.times)
        if times.ndim != 1 or times.size < MIN_POINTS:
            raise ValueError(
                f"a curve needs at least {MIN_POINTS} points, got {times.size}; "
                "measure the cooling at more times"
            )
        fields = {column: getattr(self, field) for column, field in COLUMNS.items()}
        for column, values in fields.items():
            if values is None or isinstance(values, Tracer):
                continue
            if np.shape(values) != times.shape:
                raise ValueError(
                    f"{column} has shape {np.shape(values)}, but there are {times.size} times; "
                    "give one value a time"
                )
            values = np.asarray(values)
            prepared = np.zeros(times.shape, bool)
            if column != "T":
                prepared[0] = column == "t" or times[0] == 0
            wrong = ~np.isfinite(values) | ~((values > 0) | prepared & (values == 0))
            if np.any(wrong):
                i = int(np.argmax(wrong))
                raise ValueError(
                    f"{place(i)}: {column} is {values[i]:g}, it must be a positive number"
                    + ("" if column == "T" else " (zero is allowed in a first row at t = 0 only)")
                    + "; mend or remove this row"
                )
        late = np.flatnonzero(np.diff(times) <= 0)
        if late.size:
            i = int(late[0]) + 1
            raise ValueError(
                f"{place(i)}: t is {times[i]:g} after {times[i - 1]:g}; times must increase: "
                "sort the rows by time and remove repeated ones"
            )


def read_curve(path: str | Path) -> tuple[CoolingCurve, dict[str, str]]:
    """Read a measured cooling curve from a CSV file.

    The file has header lines ``# key: value``, a line that names the columns, and the rows::

        # eta: 0.05
        t,T,T_err,msd
        0.0,1.0e-2,0,0
        7.8e-3,9.79e-3,8.0e-6,1.7e-6

    Columns (SI): t, T, and where measured T_err, msd, msd_err; see `COLUMNS`.

    Args:
        path: the file.

    Returns:
        The curve and the header as a dictionary of strings.

    Raises:
        ValueError: saying what is wrong, in which line, and what to do.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path") from None
    except (UnicodeDecodeError, IsADirectoryError):
        raise ValueError(
            f"{path}: not a text file; give a CSV file with the columns t,T[,T_err][,msd]"
        ) from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); check its rights") from None
    if "\x00" in text:
        raise ValueError(f"{path}: a binary file; give a CSV file with the columns t,T[,T_err]")
    if not text.strip():
        raise ValueError(f"{path}: the file is empty; it needs the columns t,T[,T_err][,msd]")

    header: dict[str, str] = {}
    names: list[str] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    for i, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if line.startswith("#"):
            key, colon, value = line[1:].partition(":")
            if colon:
                header[key.strip()] = value.strip()
        elif line and not names:
            names = _column_names(path, i, line)
        elif line:
            rows.append(_row(path, i, line, names))
            lines.append(i)
    columns = jnp.asarray(np.array(rows, dtype=float).reshape(len(rows), len(names)).T)
    fields = {COLUMNS[name]: column for name, column in zip(names, columns, strict=True)}
    if len(rows) < MIN_POINTS:
        raise ValueError(
            f"{path}: {len(rows)} rows of numbers, at least {MIN_POINTS} are needed; "
            "measure the cooling at more times"
        )
    curve = CoolingCurve(**fields)
    curve.check(lambda i: f"{path}, line {lines[i]}")
    return curve, header


def _column_names(path: Path, i: int, line: str) -> list[str]:
    names = [name.strip() for name in line.split(",")]
    unknown = [name for name in names if name not in COLUMNS]
    missing = [name for name in ("t", "T") if name not in names]
    if unknown or missing or len(set(names)) < len(names):
        raise ValueError(
            f"{path}, line {i}: the columns are {', '.join(names)}; "
            + (f"missing: {', '.join(missing)}; " if missing else "")
            + (f"not known: {', '.join(unknown)}; " if unknown else "")
            + f"name them t,T and, where measured, {', '.join(list(COLUMNS)[2:])}, each once"
        )
    return names


def _row(path: Path, i: int, line: str, names: list[str]) -> list[float]:
    cells = line.split(",")
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != len(names) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"{path}, line {i}: expected {len(names)} finite numbers ({','.join(names)}), "
            f"got {line!r}; mend or remove this row"
        )
    return values


def read_gas(header: dict[str, str]) -> Gas:
    """The gas of a curve's header, with A = 0: the constant that a fit is to find.

    Args:
        header: N, eta, diameter (m), density (kg/m^3), Y (Pa), nu, T0 (m^2/s^2) and, if not 3,
            dimension, as `read_curve` returns it.

    Raises:
        ValueError: for a missing key or a value that is not a number in its range.
    """
    missing = [key for key in GAS_KEYS if key not in header]
    if missing:
        raise ValueError(
            f"the header lacks {', '.join(missing)}; add lines such as '# {missing[0]}: VALUE' "
            f"(needed: {', '.join(GAS_KEYS)}; SI units)"
        )
    values = {key: header_number(header, key) for key in GAS_KEYS}
    law = Viscoelastic(values["Y"], values["nu"], 0.0)
    return Gas(
        law,
        diameter=values["diameter"],
        mass=sphere_mass(values["diameter"], values["density"]),
        packing_fraction=values["eta"],
        temperature=values["T0"],
        dimension=header_count(header, "dimension") or 3,
    )


def header_number(header: dict[str, str], key: str) -> float:
    """The number under a key of a curve's header; ValueError if it is not one."""
    try:
        return float(header[key])
    except ValueError:
        raise ValueError(f"header line {key}: {header[key]!r} is not a number") from None


def header_count(header: dict[str, str], key: str) -> int | None:
    """A positive whole number of a curve's header, such as N; None if it is not given."""
    if key not in header:
        return None
    number = header_number(header, key)
    if not (number >= 1 and number == int(number)):
        raise ValueError(f"header line {key}: must be a positive whole number, got {header[key]!r}")
    return int(number)


def write_curve(
    path: str | Path, curve: CoolingCurve, header: dict[str, str], *, overwrite: bool = False
) -> None:
    """Write a curve in the format that `read_curve` reads.

    Args:
        path: the file; an existing one is kept unless `overwrite`.
        curve: t, T and, where present, T_err, msd, msd_err are written.
        header: lines ``# key: value``.
        overwrite: whether an existing file may be replaced.

    Raises:
        ValueError: if the file exists and `overwrite` is False.
        OSError: naming the path, if it cannot be written; an earlier file is then kept.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists; choose another name or say overwrite=True")
    fields = {name: getattr(curve, field) for name, field in COLUMNS.items()}
    present = {name: np.asarray(v) for name, v in fields.items() if v is not None}
    lines = [f"# {key}: {value}" for key, value in header.items()]
    lines.append(",".join(present))
    lines += [",".join(f"{x:.17g}" for x in row) for row in zip(*present.values(), strict=True)]
    text = "\n".join(lines) + "\n"
    write_whole(path, lambda f: f.write(text.encode()))
