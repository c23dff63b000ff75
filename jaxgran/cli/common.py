"""The compilation cache of the commands, in the user's cache folder.

Models by the names that they have as arguments.

Files that the commands write, and header values given as arguments.
"""

import os
import platform
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import numpy as np
from platformdirs import user_cache_path

import jaxgran
from jaxgran.data.curve_file import ELEMENT_KEYS, GAS_KEYS, PRIOR_KEYS
from jaxgran.models.base import AbstractModel
from jaxgran.models.choose import default_models


def models_by_name(models) -> dict[str, AbstractModel]:
    """Models by their names as arguments: "soft-spheres"."""
    return {model.name.lower().replace(" ", "-"): model for model in models}


Model = Literal["kinetic-theory", "dsmc", "hard-spheres", "soft-spheres", "auto"]
"""Arguments of --model. Written down, for making the models would start XLA, whose settings a
command has still to choose (`jaxgran.cli.common`)."""

MODELS: tuple[str, ...] = get_args(Model)


def choose_or_make_model(options: Any, gas, curve, free, num_particles: int | None):
    """The model, and why it was chosen if it was."""
    size = num_particles if options.particles is None else options.particles
    replicas = options.replicas
    if options.model != "auto":
        model = models_by_name(default_models(2 if size is None else size, replicas))[options.model]
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
    (name,) = models_by_name([choice.model])
    return models_by_name(default_models(options.particles, replicas))[name], choice.reasons


def environment() -> dict:
    """Versions and device."""
    return {
        "versions": {name: version(name) for name in ("jaxgran", "jax", "diffrax", "optimistix")},
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
    }


def alternative_as_json(rival) -> dict[str, Any]:
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
    """Header values out of KEY=VALUE."""
    known = (*GAS_KEYS, "t0", *PRIOR_KEYS, *ELEMENT_KEYS, "N", "A", "dimension", "replicas")
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key not in known:
            raise ValueError(f"--set {pair}: give KEY=VALUE with KEY one of {', '.join(known)}")
        values[key] = value
    return values


def outputs(options: Any) -> tuple[Path, Path]:
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


SWITCH = "JAXGRAN_NO_CACHE"
"""An environment variable: set to anything but 0, it disables the compilation cache."""


def use_compilation_cache(folder: Path | None = None) -> bool:
    """Let JAX keep the programs that this process compiles, and load those it kept before.

    The cache is not used if `SWITCH` disables it, if JAX has a cache folder already
    (JAX_COMPILATION_CACHE_DIR), or if the folder is not the user's alone: its files are programs
    that JAX runs.

    Args:
        folder: created with access for the user alone; by default that of this command in the
            user's cache folder.

    Returns:
        Whether the cache is used.
    """
    disabled = os.environ.get(SWITCH, "0") != "0"
    if disabled or jax.config.values["jax_compilation_cache_dir"] is not None:
        return False
    folder = user_cache_path("jaxgran") / "compiled" if folder is None else folder
    if not _is_private(folder):
        return False
    _compile_for_avx2()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return True


def _is_private(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except OSError:
        return False
    if hasattr(os, "getuid") and (found.st_uid != os.getuid() or found.st_mode & 0o077):
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def _compile_for_avx2() -> None:
    """Compile for AVX2, so that JAX loads cached programs without a page of warnings.

    For newer instructions XLA adds tuning hints to a program (prefer-no-gather,
    prefer-no-scatter). When XLA loads the program it takes them for features of the processor, does
    not find them, and warns (openxla/xla, issue 44565). XLA reads this variable when it starts,
    with the first array.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if platform.machine().lower() in ("x86_64", "amd64") and "xla_cpu_max_isa" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_max_isa=AVX2".strip()
