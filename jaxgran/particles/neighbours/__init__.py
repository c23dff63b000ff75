"""Neighbour lists of spheres in periodic boxes, built by sweep and prune, by cells or by jax-md.

Compiled code cannot make an array whose length depends on the number of pairs. Arrays have a fixed
capacity instead, and the number of pairs is counted, so that the caller notices an overflow.

- `lists`: the list of pairs, by any of the three methods, and which of them is the fastest.
- `pairs`: what a search finds, and the pairs with their offsets.
- `sweep`: sweep and prune, for boxes of up to some thousands of particles.
- `cells`: lists by cells, for larger boxes.
- `comparisons`: comparisons of whole numbers, which `sweep` and `cells` share.
- `jax_md_list`: lists by jax-md; the only module that imports jax_md.
- `selection`: some pairs of a list, and the particles that belong to them.
"""
