"""Progress of a run on a terminal, and the compiled programs of this process."""

import sys
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
from tqdm import tqdm

from jaxgran._utils.tracing import near_map_limit
from jaxgran.particles.dynamics import AbstractProcess


def progress_bar(end: float, now: float, progress: bool, label: str | None = None) -> tqdm:
    """Return a bar of the time of a run, which appears on a terminal after some seconds."""
    return tqdm(
        total=end,
        initial=now,
        disable=None if progress else True,
        delay=3,
        desc=label,
        bar_format="{l_bar}{bar}| {elapsed} elapsed, {remaining} left{postfix}",
    )


_COMPILED: set[Hashable] = set()
"""Keys of the programs of this process, see `described_program`."""


def described_program(process: AbstractProcess, state: Any) -> Hashable:
    """Return a key of the compiled program: structure, shapes and dtype of its arguments."""
    leaves, structure = jax.tree.flatten((process, state))
    return structure, *(x.shape for x in leaves), leaves[-1].dtype


def drop_programs_near_limit(program: Hashable) -> None:
    """Drop all programs of this process before a new one, near the limit of memory maps."""
    if program not in _COMPILED and near_map_limit():
        jax.clear_caches()
        _COMPILED.clear()


@contextmanager
def compiling(program: Hashable, progress: bool) -> Iterator[None]:
    """Show "compiling ..." on a terminal during the first call of a program in this process.

    Without `progress` nothing is shown. The progress bar follows.
    """
    text = "compiling ..."
    shown = program not in _COMPILED and progress and sys.stderr.isatty()
    _COMPILED.add(program)
    if shown:
        print(f"\r{text}", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if shown:
            print(f"\r{' ' * len(text)}\r", end="", file=sys.stderr, flush=True)
