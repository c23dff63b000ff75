"""The command line: `jaxgran fit`, `jaxgran cool` and `jaxgran choose`."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import jax
from cyclopts import App, CycloptsError, Parameter

from jaxgran.cli.models import Model
from jaxgran.cli.programs import use_compilation_cache

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
            from jaxgran.cli.joint import run_joint

            run_joint(list(curves), drops, onto_plate, options, started)
        else:
            run_fit(options, started)

    fit.__doc__ = FIT
    app.command(fit)
    from jaxgran.cli.scene import choose, cool

    app.command(cool)
    app.command(choose)
    return app
