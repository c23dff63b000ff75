"""Compiled programs that are kept in files, so that the next process need not even trace them.

JAX's persistent cache keeps what XLA has compiled, and finds it by the lowered program: tracing and
lowering remain, which take longer than the rest of a second fit. What is kept here is found by the
arguments of the function and the code that it is of.

For functions that take seconds to trace. The commands say where files are kept
(`jaxgran.cli.programs`), and without that nothing is.
"""

import functools
import hashlib
import io
import os
import pickle
import platform
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import numpy as np
from jax.experimental.compilation_cache.compilation_cache import reset_cache
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from jaxgran.checks.tracing import any_traced

Function = TypeVar("Function", bound=Callable[..., Any])

DEPENDENCIES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "lineax", "optimistix")
"""Packages whose code is in the programs."""

QUICKLY: dict[str, bool | str] = {"xla_cpu_use_fusion_emitters": False}
"""Options of XLA: on a CPU its emitters of fusions take half of the time of a compilation, and the
programs of fits run as fast without."""

MOST_KEPT = 100
"""Files of a folder; beyond that the one unused for longest is removed."""

_FOLDER: list[Path] = []


def keep_in(folder: Path | None) -> None:
    """Keep the programs of functions that are `kept` in a folder, from now on; None keeps none.

    The folder should belong to the user alone: its files are unpickled.
    """
    _FOLDER[:] = [] if folder is None else [folder]


class Place(NamedTuple):
    """Where an array was in a pytree: its number among them, and its type."""

    number: int
    shape: tuple[int, ...]
    dtype: str
    weak: bool


class Program(NamedTuple):
    """A compiled function of a list of arrays, and the pytree that is made of what it returns."""

    run: Callable[[list], list]
    result: Any


def kept(function: Function) -> Function:
    """`equinox.filter_jit` of a function whose compiled programs are kept in the folder, if one is.

    A program is found again by the values of all arguments that are no arrays, the types of those
    that are, the source of jaxgran, the versions of what it is built on and the processor. A file
    that is damaged or cannot be read is made again. Arguments of classes that belong to none of
    these packages, such as a user's own law, are compiled as ever.
    """
    return _kept(function, eqx.filter_jit(function))


def kept_in_one(function: Function) -> Function:
    """A function of few operations: one program that is kept where programs are, else as it is.

    In a process that keeps programs each operation on a number would be one more to be found.
    """
    return _kept(function, function)


def kept_property(function: Callable[[Any], Any]) -> Any:
    """A property whose function is `kept_in_one`."""
    return property(kept_in_one(function))


def _kept(function: Function, otherwise: Callable) -> Function:
    programs: dict[str, Program] = {}

    @functools.wraps(function)
    def call(*args, **kwargs):
        if not _FOLDER or jax.device_count() > 1:
            return otherwise(*args, **kwargs)
        arrays, outline = _taken_apart((args, kwargs))
        name = None if any_traced(arrays) else _name(function, outline)
        if name is None:
            return otherwise(*args, **kwargs)
        program = programs.get(name)
        if program is None:
            file = _FOLDER[0] / name
            program, computed = _read(file, arrays)
            if program is None or computed is None:
                program = _made(function, outline, arrays, file)
                computed = program.run(arrays)
            programs[name] = program
        else:
            computed = program.run(arrays)
        return _put_together(program.result, computed)

    return cast(Function, call)


def _taken_apart(tree: Any) -> tuple[list, Any]:
    """The arrays of a pytree, and the pytree with a `Place` for each of them."""
    leaves, structure = jax.tree.flatten(tree)
    arrays, others = [], []
    for leaf in leaves:
        if eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic):
            weak = bool(getattr(leaf, "weak_type", False))
            others.append(Place(len(arrays), leaf.shape, str(leaf.dtype), weak))
            arrays.append(leaf)
        else:
            others.append(leaf)
    return arrays, structure.unflatten(others)


def _put_together(outline: Any, arrays: list) -> Any:
    def filled(leaf):
        return arrays[leaf.number] if isinstance(leaf, Place) else leaf

    return jax.tree.map(filled, outline, is_leaf=lambda leaf: isinstance(leaf, Place))


def _made(function: Callable, outline: Any, arrays: list, file: Path) -> Program:
    """The program compiled anew, and written to a file if it can be."""
    results = []

    def of_arrays(arrays: list) -> list:
        args, kwargs = _put_together(outline, arrays)
        computed, result = _taken_apart(function(*args, **kwargs))
        results.append(result)
        return computed

    of_arrays.__name__ = function.__name__
    lowered = jax.jit(of_arrays).lower(arrays)
    with _no_other_cache():
        try:
            compiled = lowered.compile(compiler_options=QUICKLY)
        except (RuntimeError, ValueError):  # an XLA that has no such option
            compiled = lowered.compile()
    program = Program(compiled, results[-1])
    try:
        payload = pickle.dumps((serialize(compiled)[0], compiled.out_tree.num_leaves, results[-1]))
    except (ValueError, NotImplementedError, TypeError, AttributeError, pickle.PicklingError):
        return program  # of a kind that JAX cannot keep
    _write(file, hashlib.sha256(payload).digest() + payload)
    return program


@contextmanager
def _no_other_cache() -> Iterator[None]:
    """Compile anew: what JAX takes from its own cache cannot be written again."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    reset_cache()  # which else goes on as it began
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        reset_cache()


def _read(file: Path, arrays: list) -> tuple[Program, list] | tuple[None, None]:
    """The program of a file and what it makes of these arrays; None of one that is of no use."""
    try:
        content = file.read_bytes()
        os.utime(file)
    except OSError:
        return None, None
    digest, payload = content[:32], content[32:]
    if hashlib.sha256(payload).digest() != digest:
        return None, None
    takes = jax.tree.structure(((arrays,), {}))
    _find_lapack()
    try:
        executable, number, result = pickle.loads(payload)
        returns = jax.tree.structure([0] * number)
        program = Program(deserialize_and_load(executable, takes, returns), result)
        return program, jax.block_until_ready(program.run(arrays))
    except Exception:  # whatever XLA raises for what another build of it has written
        return None, None


@functools.cache
def _find_lapack() -> None:
    """Let JAX look up LAPACK, which it does on lowering; a program that finds none crashes."""
    jax.jit(jax.lax.linalg.cholesky).lower(np.ones((1, 1), np.float32))


def _write(file: Path, content: bytes) -> None:
    """Write a file whole or not at all, and remove old ones; a full disk is no fault of a fit."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".part", delete=False) as part:
            part.write(content)
        os.replace(part.name, file)
        there = sorted(file.parent.glob("*.program"), key=lambda path: path.stat().st_mtime)
        for old in there[:-MOST_KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return


class _Pickler(pickle.Pickler):
    """Of what belongs to this package and those that it is built on alone."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type) or callable(obj) and hasattr(obj, "__qualname__"):
            package = obj.__module__.partition(".")[0]
            if package not in (*DEPENDENCIES, "jaxgran", "builtins", "copyreg", "collections"):
                raise pickle.PicklingError(f"{package} is not known to stay the same")
        return NotImplemented


def _name(function: Callable, outline: Any) -> str | None:
    """The name of the file of a program; None where what it depends on cannot be told."""
    told = io.BytesIO()
    pickler = _Pickler(told, protocol=5)
    pickler.fast = True  # else it tells equal objects from the same one, which processes differ in
    try:
        pickler.dump(outline)
    except (pickle.PicklingError, TypeError, AttributeError, ValueError):
        return None
    own = f"{function.__module__}.{function.__qualname__} {jax.config.values['jax_enable_x64']}"
    digest = hashlib.sha256("\n".join([own, *_surroundings()]).encode() + told.getvalue())
    return f"{function.__name__}-{digest.hexdigest()}.program"


@functools.cache
def _surroundings() -> tuple[str, ...]:
    """What programs depend on besides their arguments: code, versions and the device."""
    device = jax.devices()[0]
    versions = (f"{name} {version(name)}" for name in DEPENDENCIES)
    built = device.device_kind, device.client.platform_version, os.environ.get("XLA_FLAGS", "")
    return platform.python_version(), _processor(), *built, *versions, _source()


def _source() -> str:
    """A digest of all modules of this package."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _processor() -> str:
    """The processor and its instructions; where they cannot be read, this machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    flags = [line for line in lines if line.startswith(("flags", "Features"))]
    return f"{platform.machine()} {flags[0] if flags else platform.node()}"
