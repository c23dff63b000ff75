"""The command line: `jaxgran fit`, `jaxgran plan`, `jaxgran cool` and `jaxgran choose`."""

import gc
import os
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import jax
from cyclopts import App, CycloptsError, Parameter

import jaxgran
from jaxgran.cli.cache import use_compilation_cache
from jaxgran.cli.options import (
    KINETIC_THEORY,
    FitOptions,
    FreeParameter,
    ModelName,
    Several,
    WholeNumber,
    check_tolerance,
    models_by_name,
)
from jaxgran.cli.output import check_new, list_written
from jaxgran.cli.scene import read_scene
from jaxgran.data.curve_archive import ARCHIVE_SUFFIX
from jaxgran.data.curve_file import CSV_SUFFIXES
from jaxgran.data.files import check_writable
from jaxgran.data.header_keys import TRACK_KEYS
from jaxgran.models.checks import check_volume
from jaxgran.models.choose import NUM_PARTICLES, default_models

OF_MEASUREMENTS = (
    "T_from",
    "T_of",
    "tracked",
    "T_scale",
    "T_scale_err",
    "errors",
    "T0_of",
    "t0",
    "t0_err",
    *TRACK_KEYS,
)
"""Header keys of a measured curve that do not hold for a computed one."""


APP = App(
    name="jaxgran",
    help="Cooling granular gases: fit a measured curve, plan one, compute one, choose a model.",
    default_parameter=Parameter(negative=()),
    suppress_keyboard_interrupt=False,
)


def start() -> int:
    """Run `main` as a process of its own: the entry point of the command `jaxgran`.

    Tracing makes many objects that stay. Searching them for garbage seldom, and not at the end,
    saves 1.3 s of the 6.6 s of processor time that the fit of the README takes.

    Returns:
        The exit code.
    """
    gc.set_threshold(1_000_000)
    try:
        return main()
    finally:
        gc.freeze()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Invalid input gives one line on stderr and the exit code 2, Ctrl-C 130.

    Args:
        arguments: of the command line, by default of this process.

    Returns:
        The exit code.
    """
    jax.config.update("jax_enable_x64", True)
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            # A damaged cache is compiled again.
            warnings.filterwarnings("ignore", "Error (read|writ)ing persistent compilation cache")
            warnings.showwarning = lambda text, *_: print(f"warning: {text}", file=sys.stderr)
            APP(words, exit_on_error=False, print_error=False, result_action="return_value")
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of the output has ended, as `head` does; files are written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except CycloptsError as error:
        reason = " ".join(str(error).split())
        print(f"error: {reason} See jaxgran --help.", file=sys.stderr)
        return 2
    except (ValueError, OSError, RuntimeError, OverflowError, ModuleNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


@APP.command
def fit(*curves: Path, options: FitOptions | None = None) -> None:
    """Estimate the dissipative constant A from one measured cooling curve or several.

    Prints a table and a line of JSON; writes a picture and a JSON file.

    Args:
        curves: CSV file: header lines `# key: value` (eta, diameter, density, Y, nu, T0; in SI or
            with units), a line of column names, and rows t,T[,T_err]. Several files are fitted
            jointly: they share the parameters of the material (A, Y, ...).
    """
    started = time.perf_counter()
    options = FitOptions() if options is None else options
    check_tolerance(options.tolerance)
    if not options.no_cache:
        use_compilation_cache()
    from jaxgran.cli.fit import run_fit

    if not (*curves, *options.drop_test):
        raise ValueError("no curve is given. Name a file: jaxgran fit CURVE.csv.")
    run_fit(curves, options, started)


@APP.command
def plan(
    experiment: Path,
    /,
    *,
    free: Annotated[tuple[FreeParameter, ...], Several] = (),
    set: Annotated[tuple[str, ...], Several] = (),
    out: Path | None = None,
    overwrite: bool = False,
    report: bool = False,
    no_cache: bool = False,
) -> None:
    """Compute which range of A an experiment will give, and what would narrow it.

    Prints a table; writes a picture and a JSON file.

    Args:
        experiment: TOML file of a scene (see `jaxgran cool`; errors such as eta_err are priors)
            with a table [experiment]: times (s; a list, or {number, first, last}), T_err (relative,
            .02 is 2 %) and, where planned, T_rot_err and msd_err, N, replicas, absent. Or the CSV
            file of a measured curve: the plan starts at its fit.
        free: Parameters to fit, the first of which is planned for; by default A, and T0 if T has
            no errors.
        set: Header values KEY=VALUE that replace values of a CSV file.
        out: Picture to write, by default NAME-plan.png; the JSON file has the same name with .json.
        overwrite: Replace existing files.
        report: Write a web page with the table and the picture, too; needs the extra `report`.
        no_cache: Disable the compilation cache (same as JAXGRAN_NO_CACHE=1).
    """
    if not no_cache:
        use_compilation_cache()
    from jaxgran.cli.plan import run_plan

    run_plan(experiment, free=free, given=set, out=out, overwrite=overwrite, page=report)


@APP.command
def cool(
    scene: Path,
    /,
    *,
    until: float | None = None,
    model: ModelName = "kinetic-theory",
    particles: WholeNumber | None = None,
    replicas: WholeNumber = 1,
    key: WholeNumber = 0,
    out: Path = Path("cooling.csv"),
    overwrite: bool = False,
    no_cache: bool = False,
) -> None:
    """Compute the cooling curve of a scene; write it as a CSV file and a picture.

    Args:
        scene: TOML file with eta, diameter, density, Y, nu, T0 and A (SI; eps, a constant
            restitution, may replace Y, nu and A), or the CSV file of a curve with these keys in its
            header.
        until: Last time, s; needed for a TOML file, by default the times of the CSV file.
        model: Model to use.
        particles: Number of particles per replica (particle models only; default: N from the
            scene).
        replicas: Number of replicas (particle models only).
        key: Seed of the random initial state (particle models only).
        out: CSV file to write; the picture has the same name with .png.
        overwrite: Replace existing files.
        no_cache: Disable the compilation cache (same as JAXGRAN_NO_CACHE=1).
    """
    if not no_cache:
        use_compilation_cache()
    picture = out.with_suffix(".png")
    if picture == out:
        raise ValueError(f"--out must not end in .png, got {out}. The picture is named after it.")
    if out.suffix not in (ARCHIVE_SUFFIX, *CSV_SUFFIXES):
        raise ValueError(f"--out must end in .csv or .npz, got {out}.")
    given = read_scene(scene, until)
    for file in (out, picture):
        check_new(file, overwrite)
        check_writable(file)
    from jaxgran import plotting  # needs matplotlib, which `choose` does not need

    size = next(n for n in (particles, given.size, NUM_PARTICLES) if n is not None)
    chosen = jaxgran.KineticTheory()
    if model != KINETIC_THEORY:
        chosen = models_by_name(default_models(size, replicas))[model]
        check_volume(given.gas, size)
    curve = jaxgran.cool(given.gas, given.times, model=chosen, key=jax.random.key(key))
    header = {name: x for name, x in given.header.items() if name not in OF_MEASUREMENTS}
    if chosen.stochastic:  # a later fit takes its error budget from them
        header |= {"N": str(size), "replicas": str(replicas)}
    jaxgran.write_curve(out, curve, header, overwrite=overwrite)
    ratio = float(curve.temperature[-1] / curve.temperature[0])
    title = f"{scene.stem}: {chosen.name}, T falls to {ratio:.3g} of its first value"
    plotting.save_curves({chosen.name: (curve, None)}, title, picture)
    print(f"{model}: T falls to {ratio:.3g} of its first value in {given.times[-1]:.3g} s")
    print(list_written([out, picture]))


@APP.command
def choose(
    scene: Path,
    /,
    *,
    until: float | None = None,
    tolerance: float = 0.02,
    no_cache: bool = False,
) -> None:
    """Print the fastest model that is accurate enough for a scene, and the reasons.

    Args:
        scene: TOML file with eta, diameter, density, Y, nu, T0 and A (SI), and N for a gas in a
            box, or the CSV file of a curve with these keys in its header. If the header has no A,
            A is fitted to the curve.
        until: Last time, s; needed for a TOML file, by default the last time of the CSV file.
        tolerance: Allowed relative error of T.
        no_cache: Disable the compilation cache (same as JAXGRAN_NO_CACHE=1).
    """
    check_tolerance(tolerance)
    if not no_cache:
        use_compilation_cache()
    given = read_scene(scene, until, fits_A=True)
    choice = jaxgran.choose_model(given.gas, given.times, tolerance, given.size)
    for reason in choice.reasons:
        print(reason)
