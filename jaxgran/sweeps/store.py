"""The chunks of a sweep on the disk: a Zarr group, which `xarray.open_zarr` reads with labels.

The group is made whole under another name and then renamed, so that of several processes the first
makes it. A chunk's values are written before its number in the array `finished`, which is a digest
of them: a chunk that was under way when a process died counts as not begun.
"""

import hashlib
import os
import shutil
import tempfile
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxgran.data.description import differences
from jaxgran.data.tables import needed
from jaxgran.sweeps.batch import Batch
from jaxgran.sweeps.layout import empty, labels
from jaxgran.sweeps.program import Records, joined

FORMAT = 1
"""Of the group."""

CHUNK, FINISHED = "chunk", "finished"
MOST_NAMED = 4
"""Differences that are named in an error."""


class Store(NamedTuple):
    """An open store.

    Attributes:
        path: of the group.
        group: the `zarr.Group`.
        names: of the records, sorted.
        num_members: of the sweep.
        chunk: members of a chunk.
    """

    path: Path
    group: Any
    names: tuple[str, ...]
    num_members: int
    chunk: int

    def rows(self, number: int) -> slice:
        """The members of a chunk."""
        return slice(number * self.chunk, min((number + 1) * self.chunk, self.num_members))

    def finished(self) -> np.ndarray:
        """Whether each chunk has been written, by whichever process.

        Raises:
            ValueError: if that is not known any more.
        """
        return _values(self.path, self.group[FINISHED]) != 0

    def write(self, number: int, records: Records) -> None:
        """Write a chunk, and then that it is finished."""
        for name in self.names:
            self.group[name][self.rows(number)] = records[name]
        self.group[FINISHED][number] = _digest(records)

    def check(self) -> None:
        """Check every finished chunk.

        Raises:
            ValueError: naming the first one that does not hold what was written.
        """
        for number in np.flatnonzero(self.finished()):
            self.read(int(number))

    def read(self, number: int) -> Records:
        """The records of a finished chunk.

        Raises:
            ValueError: if it does not hold what was written.
        """
        rows = self.rows(number)
        try:
            records = {name: np.asarray(self.group[name][rows]) for name in self.names}
            whole = _digest(records) == self.group[FINISHED][number]
        except Exception as error:  # whatever a codec raises for a file that was cut off
            raise self._damaged(number, f" ({error})") from None
        if not whole:
            raise self._damaged(number)
        return records

    def read_all(self) -> Records:
        """The records of all members, once all chunks are finished."""
        return joined([self.read(number) for number in range(len(self.finished()))])

    def _damaged(self, number: int, why: str = "") -> ValueError:
        rows = self.rows(number)
        return ValueError(
            f"{self.path}: chunk {number} (members {rows.start} to {rows.stop - 1}) is half "
            f"written or was changed{why}: copy the store again, or name another one"
        )


def stored_chunk(path: str | Path) -> int | None:
    """The chunk size of a store; None if there is no such store yet."""
    path = Path(path)
    return None if _absent(path) else int(_opened(path).attrs["chunk"])


def opened(
    path: str | Path,
    batch: Batch,
    times: np.ndarray,
    shapes: Records,
    description: dict[str, str],
    chunk: int,
    whole: bool = False,
) -> Store:
    """The store of a sweep, made now if there is none.

    Args:
        path: a folder that is empty or does not exist, or the store of the same sweep.
        batch: the members.
        times: t, s.
        shapes: types and shapes of the records of one member.
        description: all that determines the results.
        chunk: members of a chunk.
        whole: whether the particles themselves are saved.

    Raises:
        ValueError: for a folder or file that is something else, the store of another sweep or of
            another version, and for a store that is damaged.
        OSError: if it cannot be written.
        ModuleNotFoundError: without the extra `sweep`.
    """
    path = Path(path)
    if _absent(path):
        _make(path, batch, times, shapes, description, chunk, whole)
    group = _opened(path)
    _check_same(path, dict(group.attrs), description)
    for name, found in labels(batch, times).items():
        stored = _values(path, _array(path, group, name, found[1]))
        if not np.array_equal(stored, found[1], equal_nan=True):
            raise _not_whole(path, f"other values in {name!r}")
    for name, of_one in shapes.items():
        _array(path, group, name, of_one, len(batch))
    _array(path, group, FINISHED, _flags(len(batch), chunk))
    return Store(path, group, tuple(sorted(shapes)), len(batch), chunk)


def _array(path: Path, group: Any, name: str, like: Any, *members: int) -> Any:
    """An array of a store, of the type and shape that it must have.

    Raises:
        ValueError: if there is no such array.
    """
    try:
        found = group[name]
        kind = (found.shape, found.dtype)
    except Exception as error:  # whatever zarr raises where something is lost or cut off
        raise _not_whole(path, f"no array {name!r} ({error})") from None
    if kind != ((*members, *like.shape), like.dtype):
        raise _not_whole(path, f"an array {name!r} of {kind[1]} and shape {kind[0]}")
    return found


def _values(path: Path, array: Any) -> np.ndarray:
    try:
        return np.asarray(array[...])
    except Exception as error:  # whatever a codec raises for a file that was cut off
        raise _not_whole(path, f"a damaged array {array.basename!r} ({error})") from None


def _not_whole(path: Path, has: str) -> ValueError:
    return ValueError(
        f"{path} has {has} and is not whole: copy the store again, or name another one"
    )


def _flags(num_members: int, chunk: int) -> np.ndarray:
    """A digest for each chunk, 0 before it is finished."""
    return np.zeros(-(-num_members // chunk), np.uint64)


def _absent(path: Path) -> bool:
    return not path.exists() or (path.is_dir() and not any(path.iterdir()))


def _opened(path: Path) -> Any:
    zarr = needed("zarr", "sweep")
    try:
        if path.is_file():
            raise ValueError("it is a file")
        group = zarr.open_group(str(path), mode="r+", use_consolidated=False)
        attributes = dict(group.attrs)
        chunk, described = attributes.get("chunk"), attributes.get("description")
        if not (isinstance(chunk, int) and chunk > 0 and isinstance(described, dict)):
            raise ValueError("its attributes do not describe a sweep")
    except Exception as error:  # whatever zarr raises for a folder that holds something else
        raise ValueError(
            f"{path} is no store of a sweep ({error}): name another folder, or remove it"
        ) from None
    return group


def _check_same(path: Path, attributes: dict[str, Any], description: dict[str, str]) -> None:
    own = version("jaxgran")
    version_of, form = attributes.get("version"), attributes.get("format")
    if (form, version_of) != (FORMAT, own):
        raise ValueError(
            f"{path} was written by jaxgran {version_of} in format {form}, this is {own} with "
            f"format {FORMAT}, which may compute other numbers: finish the sweep "
            "with that version, or name another store"
        )
    differ = differences(attributes["description"], description)
    if differ:
        more = f" and {len(differ) - MOST_NAMED} more" if len(differ) > MOST_NAMED else ""
        raise ValueError(
            f"{path} belongs to another sweep: {'; '.join(differ[:MOST_NAMED])}{more}. Name "
            "another store, or remove it to begin anew"
        )


def _make(
    path: Path,
    batch: Batch,
    times: np.ndarray,
    shapes: Records,
    description: dict[str, str],
    chunk: int,
    whole: bool,
) -> None:
    """Make the group with all labels and no chunk, at once; leave it if another was faster."""
    zarr = needed("zarr", "sweep")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        partial.chmod(0o777 & ~_umask())
        group = zarr.open_group(str(partial), mode="w", zarr_format=3)
        for name, (dims, values, attributes) in labels(batch, times).items():
            array = group.create_array(
                name,
                shape=values.shape,
                dtype=values.dtype,
                dimension_names=dims,
                attributes=attributes,
            )
            array[...] = values
        for name, of_one in shapes.items():
            empty(group, name, of_one, len(batch), chunk, whole)
        group.create_array(
            FINISHED,
            shape=_flags(len(batch), chunk).shape,
            chunks=(1,),
            dtype=np.uint64,
            fill_value=0,
            dimension_names=(CHUNK,),
            attributes={"long_name": "digest of the values of a finished chunk, else 0"},
        )
        group.attrs.update(
            {
                "format": FORMAT,
                "version": version("jaxgran"),
                "chunk": chunk,
                "description": description,
                "coordinates": " ".join(sorted(batch.labels())),
            }
        )
        with warnings.catch_warnings():
            # The names and types of the arrays do not change any more.
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(str(partial))
        os.rename(partial, path)
    except OSError:
        shutil.rmtree(partial, ignore_errors=True)
        if _absent(path):
            raise
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _digest(records: Records) -> np.uint64:
    """A number > 0 that tells records apart."""
    digest = hashlib.sha256()
    for name in sorted(records):
        values = np.ascontiguousarray(records[name])
        digest.update(f"{name} {values.dtype} {values.shape}".encode())
        digest.update(values.tobytes())
    return np.uint64(int.from_bytes(digest.digest()[:8], "big") | 1)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
