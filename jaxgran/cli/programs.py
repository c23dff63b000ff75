"""Compiled programs that the commands keep for the next time, in the user's cache folder."""

import os
import platform
from pathlib import Path

import jax
from platformdirs import user_cache_path

from jaxgran.checks.kept_programs import keep_in

SWITCH = "JAXGRAN_NO_CACHE"
"""An environment variable: set to anything but 0, nothing is kept."""


def keep_programs(folder: Path | None = None) -> bool:
    """Let JAX keep what it compiles in this process, and take what it kept before.

    Nothing is kept if `SWITCH` says so, if a folder of JAX's own is set
    (JAX_COMPILATION_CACHE_DIR), or if the folder cannot be written to. Programs are found again by
    what they compute, the versions of JAX and XLA, and the processor.

    Args:
        folder: by default that of this command in the user's cache folder.

    Returns:
        Whether programs are kept in that folder.
    """
    if (
        os.environ.get(SWITCH, "0") != "0"
        or jax.config.values["jax_compilation_cache_dir"] is not None
    ):
        return False
    folder = user_cache_path("jaxgran") / "programs" if folder is None else folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    if not os.access(folder, os.W_OK | os.X_OK):
        return False
    _compile_for_avx2()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    keep_in(folder)
    return True


def _compile_for_avx2() -> None:
    """Compile for AVX2, so that kept programs are loaded without a page of warnings.

    For newer instructions XLA adds to a program hints for tuning (prefer-no-gather,
    prefer-no-scatter), which it takes for features of the processor when it loads the program, does
    not find, and warns of (openxla/xla, issue 44565). XLA reads this variable when it starts, with
    the first array.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if platform.machine().lower() in ("x86_64", "amd64") and "xla_cpu_max_isa" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_max_isa=AVX2".strip()
