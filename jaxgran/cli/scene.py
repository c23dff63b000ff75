"""The commands that begin with a scene: `cool` and `choose`."""

import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import jax
import jax.numpy as jnp

import jaxgran
from jaxgran.cli.models import named
from jaxgran.cli.programs import use_compilation_cache
from jaxgran.data.files import check_writable, read_text
from jaxgran.data.header import header_count, header_number
from jaxgran.models.selection import NUM_PARTICLES, default_models

Model = Literal["kinetic-theory", "dsmc", "hard-spheres", "soft-spheres"]
POINTS = 50
"""Times of a curve that is computed without a measured one."""


def cool(
    scene: Path,
    /,
    *,
    until: float | None = None,
    model: Model = "kinetic-theory",
    particles: int | None = None,
    replicas: int = 1,
    key: int = 0,
    out: Path = Path("cooling.csv"),
    overwrite: bool = False,
    no_cache: bool = False,
) -> None:
    """Compute the cooling curve of a scene; write it as CSV, and its picture beside it.

    Args:
        scene: TOML file with eta, diameter, density, Y, nu, T0 and A (SI), or a curve's CSV file
            whose header has them.
        until: last time, s; by default the times of the CSV file.
        model: how closely to look.
        particles: of a particle model, in each replica; by default the scene's N.
        replicas: of a particle model.
        key: of a particle model's random start.
        out: CSV file to write; the picture has the same name, with .png.
        overwrite: replace these files.
        no_cache: compile everything anew, see `jaxgran fit --help`.
    """
    if not no_cache:
        use_compilation_cache()
    picture = out.with_suffix(".png")
    if picture == out:
        raise ValueError(f"--out {out} is the name of the picture; give the CSV file another one")
    told = _read(scene, until)
    for file in (out, picture):
        if file.exists() and not overwrite:
            raise ValueError(f"{file} exists; name another --out or say --overwrite")
        check_writable(file)
    from jaxgran import plotting  # needs matplotlib, which `choose` does without

    size = next(n for n in (particles, told.size, NUM_PARTICLES) if n is not None)
    chosen = named(default_models(size, replicas))[model]
    curve = jaxgran.cool(told.gas, told.times, model=chosen, key=jax.random.key(key))
    jaxgran.write_curve(out, curve, told.header, overwrite=overwrite)
    ratio = float(curve.temperature[-1] / curve.temperature[0])
    print(f"{model}: T falls to {ratio:.3g} of its first value in {told.times[-1]:.3g} s")
    title = f"{scene.stem}: {chosen.name}, T falls to {ratio:.3g} of its first value"
    plotting.save_curves({chosen.name: (curve, None)}, title, picture)
    print(f"written  {out}\n         {picture}")


def choose(
    scene: Path,
    /,
    *,
    until: float | None = None,
    tolerance: float = 0.02,
    no_cache: bool = False,
) -> None:
    """Say which model is the cheapest that is accurate enough for a scene, and why.

    Args:
        scene: TOML file with eta, diameter, density, Y, nu, T0 and A (SI), and N where the gas is
            in a box, or a curve's CSV file whose header has them.
        until: last time, s; by default that of the CSV file.
        tolerance: relative error of T that is allowed.
        no_cache: compile everything anew, see `jaxgran fit --help`.
    """
    if not no_cache:
        use_compilation_cache()
    told = _read(scene, until)
    choice = jaxgran.choose_model(told.gas, told.times, tolerance, told.size)
    for reason in choice.reasons:
        print(reason)


def _read(path: Path, until: float | None) -> SimpleNamespace:
    """The gas, the times, N and the header of a scene."""
    measured = None
    if path.suffix == ".toml":
        header = _toml(path)
    else:
        curve, header = jaxgran.read_curve(path)
        measured = curve.times
    if "A" not in header:
        raise ValueError(f"{path} does not give A, in s; add it, or find it by jaxgran fit")
    gas = jaxgran.read_gas(header)
    gas = gas.replace(dissipative_constant=header_number(header, "A"))
    times = measured
    if until is not None:
        first = float(gas.mean_free_time) / 10
        if not first < until < float("inf"):
            raise ValueError(f"--until must lie above {first:.3g} s, got {until:g}")
        times = jnp.geomspace(first, until, POINTS)
    if times is None:
        raise ValueError(f"{path} has no times; give the last one, in s, as --until")
    size = header_count(header, "N")
    return SimpleNamespace(gas=gas, times=times, size=size, header=header)


def _toml(path: Path) -> dict[str, str]:
    """The keys of a TOML file as those of a header."""
    try:
        values = tomllib.loads(read_text(path, "eta, diameter, ..."))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: not TOML ({error}); write lines such as eta = 0.05") from None
    units = [key for key in ("length_unit", "time_unit") if key in values]
    if units:
        raise ValueError(f"{path}: a TOML scene is in SI; convert it and leave out {units[0]}")
    return {key: str(value) for key, value in values.items()}
