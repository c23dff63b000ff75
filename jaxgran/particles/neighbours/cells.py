"""Neighbour lists by cells, for boxes of many particles.

A box is divided into cells whose edge is at least the cutoff. A row is a line of cells along the
last axis, the longest one, and is divided four times finer. The particles are sorted by row, and in
a row by cell. Particles in cells of a row one after the other then stand one after the other, too:
each particle is compared with a contiguous run in its own row, and with one in each of half of the
neighbouring rows.

Copies of the particles at the ends of a row, its images, continue it periodically at both ends. A
particle or an image has a slot: its place in the array of all rows with their images.
"""

import itertools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt32

from jaxgran.particles.bit_masks import WORD, packed, pairs_where, take
from jaxgran.particles.neighbours.comparisons import (
    STEPS,
    num_words_ahead,
    reach_in_steps,
    squared_reach,
)
from jaxgran.particles.neighbours.pairs import ListedPairs

MIN_PER_CELL = 3
"""Smallest mean number of particles in a cell, before a row is divided finer. Smaller cells would
need longer arrays."""

CELLS_WITHIN_CUTOFF = 4
"""Number of cells of a row in an edge of the cells across it. Finer cells shorten the runs, from 3
to 2.25 edges."""

MIN_AROUND = 3
"""Number of cells around the box below which a neighbouring cell would be one on both sides."""

MAX_AROUND = 2000
"""Largest number of cells around the box, by which rounding errors in single precision stay below
`EDGE_MARGIN`."""

EDGE_MARGIN = 1e-3
"""Relative margin of the edge of a cell over the cutoff."""


class CellGrid(NamedTuple):
    """Division of a box into cells.

    Attributes:
        around: cells around the box along an axis across the rows; 1 if only one fits.
        around_row: cells around the box along a row.
        cells_in_reach: cells of a row within the cutoff; 0 if the box is one cell.
        occupied: numbers of cells along each axis between the first and the last particle. Cells
            beyond them are empty, and have no place in arrays.
    """

    around: Int[Array, ""]
    around_row: Int[Array, ""]
    cells_in_reach: Int[Array, ""]
    occupied: Int[Array, "d"]


class SortedParticles(NamedTuple):
    """Particles of all boxes, sorted by cell.

    Attributes:
        index: their indices.
        cell: index of the cell of each, of the cells of all boxes.
        row: row of the cell.
        place: place of the cell in its row.
    """

    index: Int[Array, "n"]
    cell: Int[Array, "n"]
    row: Int[Array, "n"]
    place: Int[Array, "n"]


class Rows(NamedTuple):
    """Rows of cells.

    Attributes:
        start: number of sorted particles before each cell.
        length: particles in each row.
        shift: slot of a sorted particle in each row, less its index.
    """

    start: Int[Array, "cells"]
    length: Int[Array, "rows"]
    shift: Int[Array, "rows"]


class SlotRun(NamedTuple):
    """Successive slots with which each sorted particle is compared.

    Attributes:
        first: first slot.
        count: number of slots.
    """

    first: Int[Array, "n"]
    count: Int[Array, "n"]


def expected_run(num_particles: int, cutoff: float, dimension: int) -> float:
    """Return the expected number of particles in a run of cells of a homogeneous gas.

    Args:
        num_particles: number of particles in a box.
        cutoff: over the side of a cube that the particles fill.
        dimension: dimension d.
    """
    most = (num_particles / MIN_PER_CELL) ** (1 / dimension)
    around = int(min((1 - EDGE_MARGIN) / cutoff, most))
    if around < MIN_AROUND:
        return float(num_particles)
    edges = 2 + 1 / CELLS_WITHIN_CUTOFF
    return num_particles * edges / around**dimension


@partial(jax.jit, static_argnames=("replicas", "capacity", "ahead"))
def pairs_by_cells(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    *,
    replicas: int,
    capacity: int,
    ahead: int,
) -> ListedPairs:
    """Find all pairs closer than a cutoff, in each of several equal periodic boxes.

    The work grows as N. Coordinates are rounded to whole numbers of `STEPS`. A box of fewer than
    three cells a side is one cell, in which every particle is compared with all following ones.

    Args:
        position: positions of all particles, replica after replica, in [0, side).
        side: side of the boxes.
        cutoff: distance in the same unit, > 0 and at most half a side.
        replicas: number of boxes.
        capacity: largest number of pairs that can be returned.
        ahead: largest number of particles in a run with which a particle can be compared.

    Returns:
        i and j with i < j; the number of pairs, of which the first `capacity` are returned; and the
        length of the longest run. If that exceeds `ahead`, pairs are missing. Pairs slightly beyond
        the cutoff may be included, by at most a part in 10^6 of the cutoff and 10^-8 of the side
        (in float32: 10^-6).

    Raises:
        ValueError: if the number of particles times `ahead` is too large for 32-bit indices.
    """
    total, dimension = position.shape
    n = total // replicas
    num_runs = (3 ** (dimension - 1) + 1) // 2
    num_words = num_words_ahead("cells", min(ahead, n), total, num_runs)
    reach = reach_in_steps(cutoff, side, position.dtype)
    finite = jnp.all(jnp.isfinite(position))
    unit, lowest, extent = _along_axes(jnp.where(finite, position / side, 0.0))
    max_cells = max(n // MIN_PER_CELL, 1)
    grid = _cell_grid(extent, reach / STEPS, max_cells)
    particles = _sort_by_cell(_cells_of_particles(unit, lowest, grid, replicas), grid)
    rows = _rows(particles.cell, grid, max_cells, replicas, dimension)
    slot, particle = _slots(grid, rows, particles)
    runs = _runs(grid, rows, particles, slot)
    longest = jnp.where(finite, jnp.max(jnp.stack([run.count for run in runs])), 0)
    steps = [((x - 0.5) * STEPS).astype(jnp.int32) for x in unit]
    here = [take(x, particles.index) for x in steps]
    there = [take(x, particle) for x in steps]
    square = squared_reach(reach)

    def compare_block(carry: tuple) -> tuple:
        block, words = carry
        begin = WORD * block
        near = [
            _near_in_window(here, there, SlotRun(run.first + begin, run.count - begin), square)
            for run in runs
        ]
        return block + 1, words.at[block].set(jnp.stack(near))

    def unfinished(carry: tuple) -> Array:
        block, _ = carry
        return (WORD * block < longest) & (block < num_words)

    words = jnp.zeros((num_words, num_runs, total), jnp.uint32)
    _, words = jax.lax.while_loop(unfinished, compare_block, (jnp.zeros((), jnp.int32), words))
    first = jnp.concatenate([run.first for run in runs])

    def pair_of(word: Int[Array, "rows"], bit: Int[Array, "rows"]) -> tuple[Array, Array]:
        block = jax.lax.div(word, jnp.int32(num_runs * total))
        place = word - block * jnp.int32(num_runs * total)
        other = take(first, place) + WORD * block + bit
        compared = jax.lax.rem(place, jnp.int32(total))
        return take(particles.index, compared), take(particle, other)

    i, j, count = pairs_where(words.ravel(), capacity, pair_of)
    return ListedPairs(i, j, count, lookahead=longest)


def _along_axes(
    unit: Float[Array, "n d"],
) -> tuple[Float[Array, "d n"], Float[Array, "d"], Float[Array, "d"]]:
    """Return coordinates over the side along each axis, with their minima and extents.

    The axis along which the particles extend farthest is the last one.
    """
    unit = unit.T
    unit = jnp.where(unit >= 1, 0.0, unit)  # by rounding
    lowest = jnp.min(unit, axis=1)
    extent = jnp.max(unit, axis=1) - lowest
    axes = jnp.argsort(extent)
    return unit[axes], lowest[axes], extent[axes]


def _cell_grid(extent: Float[Array, "d"], cutoff: ArrayLike, max_cells: int) -> CellGrid:
    """Return the cells of a box, of at least the cutoff, at most `max_cells` before refinement.

    Args:
        extent: distance of the last from the first particle along each axis, over the side.
        cutoff: over the side.
        max_cells: largest number of cells, of which rows have `CELLS_WITHIN_CUTOFF` times as many.
    """

    def occupied(around: Int[Array, "..."]) -> Int[Array, "d"]:
        return jnp.minimum((extent * around).astype(jnp.int32) + 1, around)

    def too_many(around: Int[Array, ""]) -> Bool[Array, ""]:
        return jnp.prod(occupied(around).astype(extent.dtype)) > max_cells

    around = jnp.clip((1 - EDGE_MARGIN) / cutoff, 1, MAX_AROUND).astype(jnp.int32)
    around = jax.lax.while_loop(too_many, lambda around: around - around // 10 - 1, around)
    one_cell = around < MIN_AROUND
    around = jnp.where(one_cell, 1, around)
    around_row = jnp.where(one_cell, 1, CELLS_WITHIN_CUTOFF * around)
    cells_in_reach = jnp.where(one_cell, 0, CELLS_WITHIN_CUTOFF).astype(jnp.int32)
    along_axis = jnp.full(len(extent), around).at[-1].set(around_row)
    return CellGrid(around, around_row, cells_in_reach, occupied(along_axis))


def _cells_of_particles(
    unit: Float[Array, "d n"], lowest: Float[Array, "d"], grid: CellGrid, replicas: int
) -> Int[Array, "n"]:
    """Return the index of the cell of each particle, of the cells of all boxes."""
    around = [*[grid.around] * (len(unit) - 1), grid.around_row]
    n = unit.shape[1] // replicas
    cell = jnp.repeat(jnp.arange(replicas, dtype=jnp.int32), n)
    for x, low, number, occupied in zip(unit, lowest, around, grid.occupied, strict=True):
        place = jnp.clip(((x - low) * number).astype(jnp.int32), 0, occupied - 1)
        cell = cell * occupied + place
    return cell


def _sort_by_cell(cell: Int[Array, "n"], grid: CellGrid) -> SortedParticles:
    """Return the particles in the order of their cells."""
    cell, index = _sorted_with_index(cell)
    along_row = grid.occupied[-1]
    row = jax.lax.div(cell, along_row)
    return SortedParticles(index, cell, row, place=cell - row * along_row)


def _sorted_with_index(values: Int[Array, "n"]) -> tuple[Int[Array, "n"], Int[Array, "n"]]:
    """Return values >= 0 in increasing order, and where each of them was."""
    n = len(values)
    index = jnp.arange(n, dtype=jnp.int32)
    if jax.dtypes.canonicalize_dtype(jnp.int64) != jnp.int64:
        values, index = jax.lax.sort((values, index), num_keys=1)
        return values, index
    # Sorting one integer of both takes a fifth of the time.
    bits = max((n - 1).bit_length(), 1)
    both = jax.lax.sort((values.astype(jnp.int64) << bits) | index)
    return (both >> bits).astype(jnp.int32), (both & (2**bits - 1)).astype(jnp.int32)


def _rows(
    cell: Int[Array, "n"], grid: CellGrid, max_cells: int, replicas: int, dimension: int
) -> Rows:
    """Return the rows of all boxes, from the cells of the sorted particles."""
    num_cells = replicas * max_cells * CELLS_WITHIN_CUTOFF
    counts = jnp.zeros(num_cells + 1, jnp.int32).at[cell + 1].add(1, mode="drop")
    start = jnp.cumsum(counts, dtype=jnp.int32)
    # Rows run along the longest axis: they are at most a power of the number of cells.
    num_rows = replicas * int(max_cells ** ((dimension - 1) / dimension) + 1)
    along_row = grid.occupied[-1]
    first = along_row * jnp.arange(num_rows, dtype=jnp.int32)

    def start_of(place: Int[Array, ""]) -> Int[Array, "rows"]:
        return start.at[first + jnp.minimum(place, along_row)].get(mode="clip")

    begin = start_of(jnp.zeros((), jnp.int32))
    end = start_of(along_row)
    images_before = end - start_of(grid.around_row - grid.cells_in_reach)
    images_after = start_of(grid.cells_in_reach) - begin
    images = jnp.cumsum(images_before + images_after, dtype=jnp.int32)
    return Rows(start, end - begin, images - images_after)


def _slots(
    grid: CellGrid, rows: Rows, particles: SortedParticles
) -> tuple[Int[Array, "n"], Int[Array, "slots"]]:
    """Return the slot of each sorted particle, and the particle in each slot, with images."""
    n = len(particles.index)
    slot = jnp.arange(n, dtype=jnp.int32) + take(rows.shift, particles.row)
    num_slots = 2 * n + WORD  # each particle has at most one image
    at_begin = particles.place < grid.cells_in_reach
    at_end = particles.place >= grid.around_row - grid.cells_in_reach
    turns = at_begin.astype(jnp.int32) - at_end.astype(jnp.int32)
    image = jnp.where(turns == 0, num_slots, slot + turns * take(rows.length, particles.row))
    particle = jnp.zeros(num_slots, jnp.int32).at[slot].set(particles.index)
    return slot, particle.at[image].set(particles.index, mode="drop")


def _runs(
    grid: CellGrid, rows: Rows, particles: SortedParticles, slot: Int[Array, "n"]
) -> list[SlotRun]:
    """Return the runs with which the sorted particles, in these slots, are compared.

    In its own row a particle is compared with the following ones.
    """
    reach = grid.cells_in_reach
    before = particles.place - reach
    after = particles.place + reach + 1
    runs = [SlotRun(slot + 1, _first_slot(grid, rows, particles.row, after) - slot - 1)]
    for row, exists in _neighbouring_rows(grid, particles.row):
        first = _first_slot(grid, rows, row, before)
        count = _first_slot(grid, rows, row, after) - first
        runs.append(SlotRun(first, jnp.where(exists, count, 0)))
    return runs


def _first_slot(
    grid: CellGrid, rows: Rows, row: Int[Array, "n"], place: Int[Array, "n"]
) -> Int[Array, "n"]:
    """Return the first slot of the cell at a place in a row, which images continue at both ends."""
    along_row = grid.occupied[-1]
    beyond = (place >= grid.around_row).astype(jnp.int32)
    turns = beyond - (place < 0).astype(jnp.int32)
    inside = jnp.minimum(place - turns * grid.around_row, along_row)
    start = take(rows.start, row * along_row + inside)
    return start + take(rows.shift, row) + turns * take(rows.length, row)


def _neighbouring_rows(
    grid: CellGrid, row: Int[Array, "n"]
) -> list[tuple[Int[Array, "n"], Bool[Array, "n"]]]:
    """Return half of the neighbours of each row, and whether each exists; each pair occurs once."""
    *across, _ = grid.occupied
    places = []  # of the row, along each axis across the rows
    box = row
    for number in reversed(across):
        quotient = jax.lax.div(box, number)
        places.insert(0, box - quotient * number)
        box = quotient
    neighbours = []
    for step in itertools.product((-1, 0, 1), repeat=len(across)):
        if step <= (0,) * len(across):
            continue
        other = box
        exists = grid.cells_in_reach > 0
        for x, by, number in zip(places, step, across, strict=True):
            neighbour = x + by
            neighbour = jnp.where(neighbour < 0, neighbour + grid.around, neighbour)
            neighbour = jnp.where(neighbour >= grid.around, neighbour - grid.around, neighbour)
            exists = exists & (neighbour < number)
            other = other * number + neighbour
        neighbours.append((jnp.where(exists, other, 0), exists))
    return neighbours


def _near_in_window(
    here: list[Int[Array, "n"]],
    there: list[Int[Array, "slots"]],
    run: SlotRun,
    square: Float[Array, ""],
) -> UInt32[Array, "n"]:
    """Return which of the first 32 slots of a run are within the cutoff, as bits.

    Args:
        here: coordinates of the particles, as whole numbers of `STEPS`.
        there: coordinates by slot.
        run: of each particle; it may be shorter than 32 slots, or over.
        square: of the cutoff in `STEPS`.
    """
    places = jnp.arange(WORD, dtype=jnp.int32)
    distance2 = jnp.zeros((len(run.first), WORD), jnp.float32)
    for x, others in zip(here, there, strict=True):
        apart = (_windows(others, run.first) - x[:, None]).astype(jnp.float32)
        distance2 = distance2 + apart * apart
    return packed((distance2 < square) & (places[None] < run.count[:, None]))


def _windows(values: Int[Array, "slots"], first: Int[Array, "n"]) -> Int[Array, "n 32"]:
    """Return 32 successive values for each index of a first one."""
    # Slices, which the compiler reads faster than values at 32 indices.
    dimensions = jax.lax.GatherDimensionNumbers(
        offset_dims=(1,), collapsed_slice_dims=(), start_index_map=(0,)
    )
    return jax.lax.gather(
        values, first[:, None], dimensions, (WORD,), mode=jax.lax.GatherScatterMode.CLIP
    )
