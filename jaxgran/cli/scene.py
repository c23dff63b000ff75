"""The scene of `jaxgran cool`, `jaxgran choose` and `jaxgran plan`, from a file."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
from jaxtyping import Array, Float

import jaxgran
from jaxgran.data.files import name_in_errors
from jaxgran.data.header import gas_of_header
from jaxgran.data.header_values import header_count, header_number
from jaxgran.data.measurement_header import guesses_of_header
from jaxgran.data.scene_file import Experiment, read_scene_file
from jaxgran.scene.parameters import symbol_of
from jaxgran.scene.walls import container_volume_ratio

NUM_POINTS = 50
"""Number of times of a curve that is computed for --until."""


@dataclass(frozen=True)
class Scene:
    """A gas and what a command computes of it.

    Attributes:
        gas: the gas.
        times: of its cooling curve, since the gas had T_0, s.
        size: N; None if neither the file nor a container gives it.
        header: entries of the file, in SI.
    """

    gas: jaxgran.Gas
    times: Float[Array, "times"]
    size: int | None
    header: dict[str, str]


@dataclass(frozen=True)
class SceneFile:
    """Content of a TOML file.

    Attributes:
        gas: the gas.
        header: entries of the scene, in SI.
        experiment: the planned experiment; None without a table [experiment].
    """

    gas: jaxgran.Gas
    header: dict[str, str]
    experiment: Experiment | None


def read_scene(path: Path, until: float | None, *, fits_A: bool = False) -> Scene:
    """Return the scene of a TOML file or of a measured curve.

    Args:
        path: of the file.
        until: the last time, s; None for the times of a curve.
        fits_A: whether A is fitted where a curve has none.

    Raises:
        ValueError: for a file without A and eps, with guesses, or without times.
    """
    t0 = 0.0
    times = None
    if path.suffix == ".toml":
        with name_in_errors(path):
            file = read_toml(path)
        gas = file.gas
        header = file.header
    else:
        measurement = jaxgran.read_measurement(path)
        gas = measurement.gas
        header = dict(measurement.header)
        t0 = header_number({"t0": "0"} | header, "t0")
        times = measurement.curve.times - t0
        if fits_A and not has_dissipation(header):
            gas = _gas_by_fit(measurement)
            header["A"] = repr(float(gas.value("dissipative_constant")))
            print(f"A = {float(header['A']):.4g} s, by a fit of this curve")
    if not has_dissipation(header):
        raise ValueError(
            f"{path} does not give A, in s, or eps, a constant restitution. Add one, or estimate A "
            "with jaxgran fit."
        )
    if guesses := guesses_of_header(header):
        symbols = ", ".join(map(symbol_of, guesses))
        raise ValueError(f"{path}: {symbols} is a guess. Give its value.")
    if until is not None:
        times = _times_until(until, gas)
    if times is None:
        raise ValueError(f"{path} has no times. Give the last one, in s, as --until.")
    if times[0] < 0:
        raise ValueError(
            f"{path}: the gas began at t0 = {t0:g} s, after the first time. Correct t0."
        )
    size = header_count(header, "N")
    if size is None and gas.container is not None:
        size = round(1 / container_volume_ratio(gas, 1))
    return Scene(gas, times, size, header)


def read_toml(path: Path) -> SceneFile:
    """Return the content of a TOML file; warn of unusual values."""
    header, experiment = read_scene_file(path)
    gas, questions = gas_of_header(header)
    for question in questions:
        warnings.warn(f"{path}: {question}", stacklevel=2)
    return SceneFile(gas, header, experiment)


def has_dissipation(header: dict[str, str]) -> bool:
    """Tell whether a header has A, or a constant restitution."""
    return not {"A", "eps"}.isdisjoint(header)


def _gas_by_fit(measurement: jaxgran.Measurement) -> jaxgran.Gas:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # on the fit
        return jaxgran.fit(measurement, quick=True).gas


def _times_until(until: float, gas: jaxgran.Gas) -> Float[Array, "times"]:
    """Return times from a tenth of the mean free time to the last one."""
    first = float(gas.mean_free_time) / 10
    if not first < until < float("inf"):
        raise ValueError(
            f"--until must lie above {first:.3g} s (mean free time / 10), got {until:g}"
        )
    return jnp.geomspace(first, until, NUM_POINTS)
