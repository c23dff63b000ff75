"""Density and flow in a grid of cells."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.particles.observables.moments import centred


def cell_density(
    position: Float[Array, "particles d"], side: ArrayLike, cells: int
) -> Float[Array, "*grid"]:
    """Density over its mean in a grid of cells^d equal cells, shape (cells, ..., cells).

    Args:
        position: of any periodic images.
        side: of the periodic box.
        cells: along each side, >= 1.

    >>> float(jnp.mean(observables.cell_density(position, 1.0, 4)))
    1.0
    """
    n, d = position.shape
    number = jnp.bincount(_cells(position, side, cells), length=cells**d)
    return (number * (cells**d / n)).reshape((cells,) * d)


def cell_velocity(
    position: Float[Array, "particles d"],
    velocity: Float[Array, "particles d"],
    side: ArrayLike,
    cells: int,
) -> Float[Array, "*grid d"]:
    """The flow: mean of v - u in each cell of a grid, shape (cells, ..., cells, d); nan in empty
    cells.

    Args:
        position, velocity: of one box; positions of any periodic images.
        side: of the periodic box.
        cells: along each side, >= 1.

    >>> observables.cell_velocity(position, velocity, 1.0, 4).shape
    (4, 4, 4, 3)
    """
    d = position.shape[-1]
    place, v = _cells(position, side, cells), centred(velocity)
    number = jnp.bincount(place, length=cells**d)
    total = jax.ops.segment_sum(v, place, num_segments=cells**d)
    return (total / number[:, None]).reshape((cells,) * d + (d,))  # 0/0 is nan


def number_fluctuation(
    position: Float[Array, "particles d"], side: ArrayLike, cells: int
) -> Float[Array, ""]:
    """Variance over mean of the number of particles in the cells of a grid.

    1 for independent particles up to ``1/cells^d``, less in a fluid of hard spheres, more where
    clusters as large as a cell are.

    Args:
        position: of any periodic images.
        side: of the periodic box.
        cells: along each side, >= 1.

    >>> bool(abs(observables.number_fluctuation(position, 1.0, 5) - 1) < 0.5)
    True
    """
    n, d = position.shape
    return jnp.var(cell_density(position, side, cells)) * (n / cells**d)


def _cells(position: Float[Array, "particles d"], side: ArrayLike, cells: int) -> Array:
    """The number of the cell of each particle."""
    if not (isinstance(cells, int) and cells >= 1):
        raise ValueError(f"cells must be a whole number >= 1, got {cells!r}")
    turns = position / jnp.asarray(side)
    place = jnp.floor((turns - jnp.floor(turns)) * cells).astype(int)
    place = jnp.minimum(place, cells - 1)  # where rounding gave a whole turn
    powers = np.array([cells**k for k in reversed(range(position.shape[-1]))])
    return jnp.sum(place * powers[None], axis=-1)
