"""The cache of compiled programs, which saves later commands their compilation."""

import os
import platform
from pathlib import Path

import jax
from platformdirs import user_cache_path

NO_CACHE_VARIABLE = "JAXGRAN_NO_CACHE"
"""An environment variable: any value but 0 disables the compilation cache."""


def use_compilation_cache(folder: Path | None = None) -> bool:
    """Let JAX store the programs that this process compiles, and load those stored before.

    The cache is not used if `NO_CACHE_VARIABLE` disables it, if JAX already has a cache folder
    (JAX_COMPILATION_CACHE_DIR), or if others can access the folder: its files are programs that JAX
    runs.

    Args:
        folder: created with access for the user alone; by default a folder of this command in the
            user's cache folder.

    Returns:
        Whether the cache is used.
    """
    disabled = os.environ.get(NO_CACHE_VARIABLE, "0") != "0"
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
        stat = folder.stat()
    except OSError:
        return False
    if hasattr(os, "getuid") and (stat.st_uid != os.getuid() or stat.st_mode & 0o077):
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
