"""The command line: `jaxgran fit`, `jaxgran cool` and `jaxgran choose`.

The commands that begin with a scene: `cool` and `choose`.
"""

import sys
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
from cyclopts import App, CycloptsError, Parameter

import jaxgran
from jaxgran.cli.common import Model, models_by_name, use_compilation_cache
from jaxgran.data.files import check_writable, header_count, header_number, read_text
from jaxgran.models.choose import NUM_PARTICLES, default_models

FixedModel = Literal["kinetic-theory", "dsmc", "hard-spheres", "soft-spheres"]
POINTS = 50
"""Times of a curve that is computed without a measured one."""


def cool(
    scene: Path,
    /,
    *,
    until: float | None = None,
    model: FixedModel = "kinetic-theory",
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
    chosen = models_by_name(default_models(size, replicas))[model]
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


Several = Parameter(consume_multiple=True)
FREE = Literal[
    "A",
    "T0",
    "t0",
    "Y",
    "nu",
    "eta",
    "diameter",
    "beta_t",
    "reduced_inertia",
    "T_rot_0",
    "container_side",
    "wall_restitution",
    "wall_beta_t",
    "tangential_damping",
    "friction",
    "gamma",
    "drive_strength",
]


FIT = """\
Find the dissipative constant A of a measured cooling curve, or of several.

Prints a table and a line of JSON; writes a picture and a JSON file.

Args:
    curves: CSV file: header lines `# key: value` (eta, diameter, density, Y, nu, T0; SI),
        a line of column names, and rows t,T[,T_err]. Several files are fitted jointly:
        they share what belongs to the material (A, Y, ...).
    drop_test: CSV file, or several, of columns v,eps,eps_err: single impacts of the
        spheres of the first curve, fitted jointly with it.
    onto_plate: those impacts are on a thick plate of the same material.
    model: auto takes the cheapest whose estimated error is within the tolerance.
    tolerance: of T, relative, for the model auto.
    particles: of a particle model, in each replica; by default the file's N.
    replicas: of a particle model.
    key: of a particle model's random start.
    free: what to fit; by default A, and T0 where T has no errors.
    set: KEY=VALUE, header values to use instead of the file's.
    out: folder to write to; by default a new one under results.
    overwrite: replace files in that folder.
    explain: print the error budget as a table, and say what each part is.
    no_cache: compile everything anew; else compiled programs are kept in the user's cache
        folder for the next time. So does the environment variable JAXGRAN_NO_CACHE=1.
"""
"""What `jaxgran fit --help` says."""


def main(
    arguments: Sequence[str] | None = None,
    *,
    started: float | None = None,
    default_curve: Path | None = None,
) -> int:
    """Run a command; bad input is answered with one line and the exit code 2.

    Args:
        arguments: of the command line, by default those of this process.
        started: when the job began, of `time.perf_counter`, for the seconds that are printed.
        default_curve: that `fit` takes if none is given.

    Returns:
        The exit code.
    """
    app = _app(time.perf_counter() if started is None else started, default_curve)
    jax.config.update("jax_enable_x64", True)
    try:
        app(
            sys.argv[1:] if arguments is None else list(arguments),
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
    except CycloptsError as error:
        reason = " ".join(str(error).split())
        print(f"error: {reason} See jaxgran --help.", file=sys.stderr)
        return 2
    except (ValueError, OSError, RuntimeError, OverflowError, ModuleNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _app(started: float, default_curve: Path | None) -> App:
    app = App(
        name="jaxgran",
        help="Cooling granular gases: fit a curve, compute one.",
        default_parameter=Parameter(negative=()),
    )

    def fit(
        *curves: Path,
        drop_test: Annotated[list[Path] | None, Several] = None,
        onto_plate: bool = False,
        model: Model = "kinetic-theory",
        tolerance: float = 0.02,
        particles: int | None = None,
        replicas: int = 3,
        key: int = 0,
        free: Annotated[list[FREE] | None, Several] = None,
        set: Annotated[list[str] | None, Several] = None,  # noqa: A002
        out: Path | None = None,
        overwrite: bool = False,
        explain: bool = False,
        no_cache: bool = False,
    ) -> None:
        if not no_cache:
            use_compilation_cache()
        from jaxgran.cli.fit import FitOptions, run_fit

        if not curves and default_curve is not None:
            curves = (default_curve,)
        if not curves:
            raise ValueError("no curve is given; name a file: jaxgran fit CURVE.csv")
        told = model, tolerance, particles, replicas, key, [*map(str, free or [])], list(set or [])
        options = FitOptions(curves[0], *told, out, overwrite, explain)
        drops = list(drop_test or [])
        if len(curves) + len(drops) > 1:
            from jaxgran.cli.fit import run_joint

            run_joint(list(curves), drops, onto_plate, options, started)
        else:
            run_fit(options, started)

    fit.__doc__ = FIT
    app.command(fit)

    app.command(cool)
    app.command(choose)
    return app
