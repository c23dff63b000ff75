"""Which dissipative constant A made this gas cool as it did?

    python experiments/fit_cooling_curve.py [CURVE.csv] [--free A T0] [--set Y=6e7] [--out DIR]
        [--model soft-spheres [--particles N] [--replicas R]] [--model auto [--tolerance 0.02]]

CURVE.csv holds header lines `# key: value` (N, eta, diameter, density, Y, nu, T0; SI units), a line
of column names and rows: t,T and, where measured, T_err, msd, msd_err, T_rot, T_rot_err. Spheres
are smooth, far from walls and in vacuum unless header lines say otherwise: beta_t, reduced_inertia,
T_rot_0 of rough ones; container_side, wall_restitution, wall_beta_t; gamma of drag. Lines eta_err,
diameter_err, density_err, Y_err, nu_err, T0_err are standard errors of the values beside them,
which then enter the error of the answer. A header line A is not used in the fit; the estimate is
compared with it. --model auto takes the cheapest model whose estimated
error, for the gas that kinetic theory fits, is within the tolerance, and says why. Prints a table
and one line of JSON, and writes a picture and a JSON file.
"""

import argparse
import json
import os
import platform
import sys
import time
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

started = time.perf_counter()

import jax  # noqa: E402
import numpy as np  # noqa: E402

import jaxgran  # noqa: E402
from jaxgran.data.curve_file import (  # noqa: E402
    GAS_KEYS,
    PRIOR_KEYS,
)
from jaxgran.data.files import write_whole  # noqa: E402
from jaxgran.data.header import header_count, header_number  # noqa: E402
from jaxgran.data.scene_keys import ELEMENT_KEYS  # noqa: E402
from jaxgran.fitting.fit import free_by_default  # noqa: E402
from jaxgran.models.base import AbstractModel  # noqa: E402
from jaxgran.models.selection import default_models  # noqa: E402
from jaxgran.plotting import plot_fit  # noqa: E402

HERE = Path(__file__).parent
DEFAULT_CURVE = HERE / "data" / "lammps_cooling_dilute.csv"
PARAMETERS = {
    "A": ("dissipative_constant", "s"),
    "T0": ("temperature", "m^2/s^2"),
    "Y": ("youngs_modulus", "Pa"),
    "nu": ("poisson_ratio", ""),
    "eta": ("packing_fraction", ""),
    "diameter": ("diameter", "m"),
    "beta_t": ("tangential_restitution", ""),
    "reduced_inertia": ("inertia", ""),
    "T_rot_0": ("rotational_temperature", "m^2/s^2"),
    "container_side": ("wall_side", "m"),
    "wall_restitution": ("wall_coefficient", ""),
    "wall_beta_t": ("wall_tangential_restitution", ""),
    "gamma": ("drag_rate", "1/s"),
}


def names_of(floats: tuple[str, ...]) -> list[str]:
    """Arguments of --free for floats of a gas."""
    return [key for key, (name, _) in PARAMETERS.items() if name in floats]


def named(models) -> dict[str, AbstractModel]:
    """Models by their names as arguments: "soft-spheres"."""
    return {model.name.lower().replace(" ", "-"): model for model in models}


MODELS = (*named(default_models(2)), "auto")


def main() -> int:
    options = parse()
    jax.config.update("jax_enable_x64", True)
    try:
        run(options)
    except (ValueError, OSError, RuntimeError, OverflowError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("curve", nargs="?", type=Path, default=DEFAULT_CURVE)
    parser.add_argument("--model", choices=MODELS, default="kinetic-theory")
    parser.add_argument(
        "--tolerance", type=float, default=0.02, help="of T, for --model auto (default: 0.02)"
    )
    parser.add_argument(
        "--particles", type=int, help="of a particle model, in each replica (default: the file's N)"
    )
    parser.add_argument("--replicas", type=int, default=3, help="of a particle model (default: 3)")
    parser.add_argument("--key", type=int, default=0, help="of a particle model's random start")
    parser.add_argument(
        "--free",
        nargs="+",
        choices=PARAMETERS,
        help="what to fit (default: A, and T0 where T has no errors)",
    )
    parser.add_argument(
        "--set",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="header values to use instead of the file's",
    )
    parser.add_argument("--out", type=Path, help="folder for the picture and the JSON file")
    parser.add_argument("--overwrite", action="store_true", help="replace files in --out")
    return parser.parse_args()


def run(options: argparse.Namespace) -> None:
    curve, header = jaxgran.read_curve(options.curve)
    header |= settings(options.set)
    with warnings.catch_warnings(record=True) as doubts:  # of units
        warnings.simplefilter("always", UserWarning)
        gas, priors = jaxgran.read_gas(header), jaxgran.read_priors(header)
    options.free = options.free or names_of(free_by_default(gas, curve))
    gas = with_given_constant(gas, header, options.free)
    n = header_count(header, "N")
    replicas = header_count(header, "replicas") or 1
    picture, record = outputs(options)
    free = tuple(PARAMETERS[key][0] for key in options.free)
    model, reasons = model_of(options, gas, curve, free, n)
    (model_name,) = named([model])
    imported = time.perf_counter() - started
    asked = {"free": free, "priors": priors, "num_particles": n, "replicas": replicas}
    result, first_seconds, fit_seconds = timed_fit(options, gas, curve, model, asked)
    diagnosis = jaxgran.diagnose(result, curve, n)
    rows = rows_of(options, result, diagnosis, header)
    print_scene(options, gas, curve, header, result)
    for doubt in doubts:
        print(f"check    {doubt.message}")
    print_impacts(result.gas, float(curve.temperature[-1]), n)
    print_model(model_name, result, reasons)
    print_rows(rows)
    print_budget(rows)
    print(f"\n{diagnosis.verdict}")
    for reason in diagnosis.reasons:
        print(f"  - {reason}")
    head = rows[0]
    answer = "not determined"
    if not np.isnan(head["estimate"]):
        answer = f"{head['estimate']:.4g} ± {head['std_err']:.2g} {head['unit']}"
    title = f"{options.curve.stem}: {head['parameter']} = {answer}\n{diagnosis.verdict}"
    picture.parent.mkdir(parents=True, exist_ok=True)
    plot_fit(result, curve, title, picture)
    summary = {
        **{row["parameter"]: row["estimate"] for row in rows},
        **{f"{row['parameter']}_std_err": row["std_err"] for row in rows},
        "model": model_name,
        "reduced_chi2": round(float(result.reduced_chi2), 4),
        "converged": bool(result.converged),
        **{f"{row['parameter']}_low": row["low"] for row in rows},
        **{f"{row['parameter']}_high": row["high"] for row in rows},
        "explains": diagnosis.explains,
        "seconds": round(time.perf_counter() - started, 2),
        "compile_seconds": round(first_seconds - fit_seconds, 2),
        "fit_seconds": round(fit_seconds, 4),
    }
    details = {
        "curve": options.curve.name,
        "chosen": reasons,
        "header": header,
        "parameters": rows,
        "covariance": np.asarray(result.covariance).tolist(),
        "diagnosis": {"verdict": diagnosis.verdict, "reasons": diagnosis.reasons},
        "rivals": [plain(rival) for rival in diagnosis.rivals],
        "import_seconds": round(imported, 2),
        **environment(),
    }
    summary = finite_or_null(summary)
    text = json.dumps(finite_or_null(summary | details), indent=2, allow_nan=False) + "\n"
    write_whole(record, lambda f: f.write(text.encode()))
    print(f"\nwritten  {picture}\n         {record}\n")
    print(json.dumps(summary, allow_nan=False))


def with_given_constant(gas, header, free: list[str]):
    """The gas with the header's A, where A is not fitted."""
    if "A" in header:
        given = gas.replace(dissipative_constant=header_number(header, "A"))
        return gas if "A" in free else given
    if "A" in free:
        return gas
    raise ValueError(
        f"--free {' '.join(free)} leaves A fixed, and the file does not give it: add --set A=VALUE "
        "(in s), or free A too"
    )


def model_of(options: argparse.Namespace, gas, curve, free, num_particles: int | None):
    """The model, and why it was chosen if it was."""
    size = num_particles if options.particles is None else options.particles
    replicas = options.replicas
    if options.model != "auto":
        model = named(default_models(2 if size is None else size, replicas))[options.model]
        if model.stochastic and size is None:
            raise ValueError(f"{options.curve} does not say N: give --particles")
        return model, ()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the diagnosis of the final fit says it
        first = jaxgran.fit(gas, curve, free=free)
    choice = jaxgran.choose_model(
        first.gas,
        curve.times,
        options.tolerance,
        size if num_particles is None else num_particles,
        replicas=replicas,
    )
    if options.particles is None:
        return choice.model, choice.reasons
    # Chosen for the box of the file's N, followed with as many particles as asked.
    (name,) = named([choice.model])
    return named(default_models(options.particles, replicas))[name], choice.reasons


def timed_fit(options: argparse.Namespace, gas, curve, model, asked: dict[str, Any]):
    """The fit, seconds of the first and of the last time that it was made."""

    def fit():
        begin = time.perf_counter()
        key = jax.random.key(options.key)
        result = jaxgran.fit(gas, curve, model=model, key=key, **asked)
        jax.block_until_ready(result.chi2)
        return result, time.perf_counter() - begin

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # said again, in words, by the diagnosis
        result, first_seconds = fit()
        fit_seconds = first_seconds
        if not model.stochastic:  # the second time without compilation
            result, fit_seconds = fit()
    return result, first_seconds, fit_seconds


def rows_of(options: argparse.Namespace, result, diagnosis, header) -> list[dict]:
    """Estimates and errors, a row for each parameter; nan where the curve determines none."""
    rows, unknown = [], result.undetermined()
    for key in options.free:
        name, unit = PARAMETERS[key]
        estimate, error = (float(x) for x in result.value(name))
        between = limits(diagnosis, name)
        if name in unknown:
            estimate, error, *between = 4 * [float("nan")]
        i = result.names.index(name)
        rows.append(
            {
                "parameter": key,
                "unit": unit,
                "estimate": estimate,
                "std_err": error,
                "error_budget": {part: float(x[i]) for part, x in result.error_budget.items()},
                **dict(zip(("low", "high"), between, strict=True)),
                "header": header_number(header, key) if key in header else None,
            }
        )
    return rows


def limits(diagnosis, name: str) -> list[float]:
    """The range of a parameter over all rivals that fit as well, 95 %; nan if there is none."""
    return [float(np.squeeze(x)) for x in diagnosis.ranges.get(name, (np.nan, np.nan))]


def print_scene(options: argparse.Namespace, gas, curve, header, result) -> None:
    T = np.asarray(curve.temperature)
    print(f"curve    {options.curve.name}: {T.size} points, t = 0 .. {curve.times[-1]:.3g} s,")
    print(f"         T falls to {T[-1] / T[0]:.3g} of its first value")
    if "T_from" in header:
        print(f"         {header['T_from']}")
    print(
        f"gas      phi = {float(gas.packing_fraction):.3g}, tau_c = "
        f"{float(gas.mean_free_time):.3g} s, t_c/tau_c = {float(gas.contact_fraction):.2g}, "
        f"beta_T0 = {float(result.gas.thermal_beta):.3g} (fitted)"
    )


def print_impacts(gas, last_T: float, num_particles: int | None) -> None:
    """What the fitted A means: eps at the rms impact speeds of the first and of the last T."""
    first, last = (float(gas.restitution(np.sqrt(2 * T))) for T in (gas.temperature, last_T))
    print(f"impacts  eps = {first:.3g} at the thermal speed of t = 0, {last:.3g} at the last one;")
    print(f"         mean free path {1e3 * float(gas.mean_free_path):.3g} mm", end="")
    if num_particles is not None:
        box = 1e3 * float(gas.box_side(num_particles))
        shape = "cube" if gas.dimension == 3 else "square"
        print(f", in a box of {box:.3g} mm if it is a {shape}", end="")
    print()
    if isinstance(gas.law, jaxgran.Viscoelastic):
        print("         A and Y enter as A Y^(2/5) where contacts are short: 10 % in Y is 4 % in A")


def print_model(name: str, result, reasons) -> None:
    steps = "simulations" if result.model.stochastic else "steps of least squares"
    print(f"model    {name}, {int(result.iterations)} {steps}")
    if reasons:
        print("chosen", "\n".join(f"         - {reason}" for reason in reasons).lstrip())


def print_rows(rows: list[dict]) -> None:
    print(f"\n{'':10}{'estimate':>13} {'+-':>10} {'95 %, with rivals':>24}  header's")
    for row in rows:
        print(f"{row['parameter']:4}{row['unit']:6}", end="")
        if np.isnan(row["estimate"]):
            print(f"{'not determined':>13}")
            continue
        between = f"{row['low']:.3g} .. {row['high']:.3g}"
        between = "not looked for" if np.isnan(row["low"]) else between
        print(f"{row['estimate']:13.5g} {row['std_err']:10.2g} {between:>24}", end="")
        if row["header"]:
            print(f"  {row['header']:.5g} ({100 * (row['estimate'] / row['header'] - 1):+.2f} %)")
        else:
            print()


def print_budget(rows: list[dict]) -> None:
    """The parts of each error, in per cent of the estimate, the largest first."""
    for row in rows:
        if np.isnan(row["estimate"]):
            continue
        parts = sorted(row["error_budget"].items(), key=lambda part: -part[1])
        shares = [f"{name} {100 * x / abs(row['estimate']):.2g} %" for name, x in parts if x > 0]
        print(f"error of {row['parameter']}: {', '.join(shares)}")


def environment() -> dict:
    """Versions and device."""
    return {
        "versions": {name: version(name) for name in ("jaxgran", "jax", "diffrax", "optimistix")},
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
    }


def plain(rival) -> dict[str, Any]:
    """A rival as JSON has it."""
    fields = rival._asdict().items()
    return {key: x.tolist() if isinstance(x, np.ndarray) else x for key, x in fields}


def finite_or_null(value: Any) -> Any:
    """The same lists and dictionaries with None, which is null in JSON, for nan and inf."""
    if isinstance(value, dict):
        return {key: finite_or_null(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_null(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def settings(pairs: list[str]) -> dict[str, str]:
    known = (*GAS_KEYS, *PRIOR_KEYS, *ELEMENT_KEYS, "N", "A", "dimension", "replicas")
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key not in known:
            raise ValueError(f"--set {pair}: give KEY=VALUE with KEY one of {', '.join(known)}")
        values[key] = value
    return values


def outputs(options: argparse.Namespace) -> tuple[Path, Path]:
    """Where to write; a new folder unless one is named, and nothing is written over unasked."""
    stem = f"{options.curve.stem}-{options.model}"
    folder = options.out
    if folder is None:
        folder, i = Path("results") / stem, 2
        while folder.exists():
            folder, i = Path("results") / f"{stem}-{i}", i + 1
    existing = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise ValueError(f"{existing} is no folder to write to; name another --out")
    files = folder / f"{stem}.png", folder / f"{stem}.json"
    for file in files:
        if file.exists() and not options.overwrite:
            raise ValueError(f"{file} exists; name another --out or say --overwrite")
    return files


if __name__ == "__main__":
    sys.exit(main())
