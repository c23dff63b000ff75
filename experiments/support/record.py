"""Run a script by parts, and write its results, its pictures and the figures of the documents.

A script run with ``--record`` writes its results to ``experiments/recorded/NAME.json``, with the
command, the version, the date, the machine and the precision of the run. Pages of the site take
their numbers from these files when it is built (``docs/recorded.py``).
"""

import argparse
import datetime
import inspect
import json
import os
import platform
import pprint
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxgran.data.files import write_atomically

EXPERIMENTS = Path(__file__).parents[1]
DATA = EXPERIMENTS / "data"
PICTURES = EXPERIMENTS.parent / "docs" / "pages" / "figures"
RECORDED = EXPERIMENTS / "recorded"
PACKAGES = ("jaxgran", "jax", "jax-md", "diffrax", "optimistix", "numpy", "scipy")
COUNTS = {1: "one", 2: "two", 4: "four", 8: "eight", 16: "sixteen"}
BEGAN = time.perf_counter()

Options = argparse.Namespace
"""Options of a script, which each of its parts takes."""


def run_parts(
    doc: str | None,
    *functions: Callable[[Options], Any],
    named: Mapping[str, Callable[[Options], Any]] | None = None,
    prefix: str = "",
    smoke: bool = True,
    default: Sequence[str] = (),
    **more: Any,
) -> dict[str, dict]:
    """Run the parts of a script that --only names, by default all, and write what they find.

    Args:
        doc: docstring of the script, its help.
        functions: the parts. Each takes the options and returns its results, or yields the rows
            of a table, which are printed as they come. "picture" among the results is a figure, or
            figures by name. Results are written to ``prefix + name`` in the folder --out, by
            default ``results/SCRIPT``, and with --record to ``figures/``, too.
        named: further parts by name.
        prefix: before the names of parts in the names of files.
        smoke: whether there are small runs of some seconds (--smoke).
        default: parts that run without --only, if not all.
        more: defaults of further options: numbers, words, or lists of these (of words any may be
            chosen); False for a flag; a type without a default. Names in capitals are positional.

    Returns:
        The results of the parts.
    """
    parts = {function.__name__: function for function in functions} | dict(named or {})
    as_written = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=doc, formatter_class=as_written)
    parser.set_defaults(smoke=False, only=list(default or parts))
    parser.add_argument("--out", type=Path, default=Path("results") / Path(sys.argv[0]).stem)
    parser.add_argument("--record", action="store_true", help="write figures of the documents")
    if smoke:
        parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    if len(parts) > 1:
        parser.add_argument("--only", nargs="+", choices=list(parts))
    for name, default in more.items():
        parser.add_argument(name if name.isupper() else f"--{name}", **settings_of(default))
    options = parser.parse_args()
    if options.record and options.smoke:
        parser.error("A smoke run is too small for the documents. Leave out --record.")
    jax.config.update("jax_enable_x64", True)
    results = {}
    for part in options.only:
        found = parts[part](options)
        results[part] = found if isinstance(found, dict) else {"rows": collected(found)}
        name = prefix + part
        pictures = results[part].pop("picture", {})
        pictures = pictures if isinstance(pictures, dict) else {name: pictures}
        pprint.pp(rounded(json.loads(as_json(results[part]))), width=100, compact=True)
        folders = (options.out, options.out), (RECORDED, PICTURES)
        for of_figures, of_pictures in folders[: 1 + options.record]:
            save(of_figures / f"{name}.json", **results[part])
            for picture, figure in pictures.items():
                figure.savefig(of_pictures / f"{picture}.png", dpi=110)
        print(f"written to {options.out / name}.json; {time.perf_counter() - BEGAN:.0f} s")
    return results


def settings_of(default: Any) -> dict[str, Any]:
    """Return settings of an option of argparse: see `run_parts`."""
    if default is False:
        return {"action": "store_true"}
    if isinstance(default, list):
        words = {"choices": default} if isinstance(default[0], str) else {}
        return {"nargs": "*", "type": type(default[0]), "default": default} | words
    is_type = isinstance(default, type)
    return {"type": default} if is_type else {"type": type(default), "default": default}


def rounded(found: Any) -> Any:
    """Return results with four digits, and long lists without their middle."""
    if isinstance(found, dict):
        return {name: rounded(x) for name, x in found.items()}
    if isinstance(found, list):
        few = found if len(found) <= 24 else [*found[:3], "...", *found[-3:]]
        return [rounded(x) for x in few]
    return float(f"{found:.4g}") if isinstance(found, float) else found


def as_json(found: dict, indent: int | None = 1) -> str:
    text = json.dumps(found, indent=indent, default=lambda array: np.asarray(array).tolist())
    return text + "\n"


def collected(rows: Iterable[dict]) -> list[dict]:
    """Return the rows, each of which is printed once it is there."""
    found = []
    for row in rows:
        print(row, flush=True)
        found.append(row)
    return found


def figures(name: str, default: Any = None) -> dict[str, Any]:
    """Return the last recorded results of this name; the default if there are none."""
    path = RECORDED / f"{name}.json"
    if default is not None and not path.exists():
        return default
    return json.loads(path.read_text(encoding="utf-8"))


def save(path: Path, **results) -> None:
    """Write results as JSON, with versions, date, machine, precision and seconds of the run.

    If writing fails, an older file is unchanged and an OSError names the path.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    text = as_json({"made_by": made_by()} | results)
    write_atomically(path, lambda f: f.write(text.encode()))


def made_by() -> dict[str, Any]:
    """Return command, version, date, machine, precision, seconds so far, and packages."""
    device = jax.devices()[0]
    cores = os.cpu_count() or 1
    of_cores = f"{COUNTS.get(cores, cores)}-core CPU"
    program = Path(sys.argv[0]).resolve()
    command = [program.name]
    if program.is_relative_to(EXPERIMENTS):
        command = ["python", str(program.relative_to(EXPERIMENTS.parent))]
    command += [Path(x).name if x.startswith((os.sep, "..", "~")) else x for x in sys.argv[1:]]
    return {
        "command": shlex.join(command),
        "version": version("jaxgran"),
        "date": datetime.date.today().isoformat(),
        "machine": of_cores if device.platform == "cpu" else f"{device.device_kind}, {of_cores}",
        "precision": "float64" if jax.config.read("jax_enable_x64") else "float32",
        "seconds": round(time.perf_counter() - BEGAN, 1),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in PACKAGES},
    }


def alternately(runs: Mapping[str, Callable], repeats: int) -> dict[str, list[float]]:
    """Return seconds of each call; the runs take turns, since the speed of a machine varies."""
    took = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            begin = time.perf_counter()
            jax.block_until_ready(run())
            took[name].append(time.perf_counter() - begin)
    return took


def seconds(run: Callable, repeats: int = 3) -> tuple[float, float]:
    """Return seconds of compilation (first call less a later one) and the median of later calls."""
    first, *later = alternately({"": run}, repeats + 1)[""]
    run_time = float(np.median(later))
    return max(first - run_time, 0.0), run_time


def process(
    *arguments: Any, folder: Path = EXPERIMENTS.parent, launch: Sequence = (), **variables: str
) -> str:
    """Return what Python prints in a separate process, with the version of jaxgran in a folder.

    Settings of JAX and of its caches are left out. The words of `launch` come before the command.

    Raises:
        SystemExit: with its messages, if it fails.
    """
    bare = {key: x for key, x in os.environ.items() if not key.startswith(("JAX", "XLA"))}
    path = os.pathsep.join(filter(None, [str(folder.resolve()), os.environ.get("PYTHONPATH")]))
    bare |= {"PYTHONPATH": path} | variables
    command = [*map(str, launch), sys.executable, *map(str, arguments)]
    done = subprocess.run(command, env=bare, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"the version in {folder} does not run:\n{done.stderr}")
    return done.stdout


def alone(function: Callable, *arguments: Any, launch: Sequence = ()) -> Any:
    """Return what a function of a script returns in a separate process; all are JSON."""
    script = Path(inspect.getfile(function)).resolve().relative_to(EXPERIMENTS.parent)
    code = (
        f"from {'.'.join(script.with_suffix('').parts)} import {function.__name__}\n"
        "import json, sys, jax\n"
        "from experiments.support.record import as_json\n"
        "jax.config.update('jax_enable_x64', True)\n"
        f"print(as_json({function.__name__}(*json.loads(sys.argv[1])), indent=None), end='')"
    )
    return json.loads(process("-c", code, json.dumps(arguments), launch=launch).splitlines()[-1])


def each_alone(function: Callable, jobs: Iterable[Sequence]) -> Iterator[dict]:
    """Return what a function returns for each job, in processes as many as there are cores."""
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        yield from pool.map(lambda arguments: alone(function, *arguments), jobs)


def of_version(folder: Path, task: str, curve: Path, num: int = 0) -> dict[str, Any]:
    """Return what a task of `support/version.py` finds with the version in a folder.

    Raises:
        SystemExit: if it fails, or if another version is imported.
    """
    script = EXPERIMENTS / "support" / "version.py"
    found = json.loads(process(script, task, curve, num, folder=folder).splitlines()[-1])
    if not Path(found["package"]).is_relative_to(folder.resolve()):
        raise SystemExit(f"the version in {folder} was not imported, but {found['package']}")
    return found["steps"]
