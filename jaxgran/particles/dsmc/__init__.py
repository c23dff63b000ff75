"""Direct simulation Monte Carlo (DSMC): velocities that change by random collisions.

- `collisions`: candidate pairs, the outcome of their collisions, and subsets of the particles.
- `dynamics`: the steps of a run, with walls, a drive and drag, its state and its records.

May import the modules directly under `particles`, except for `run`, and the floors below; not
`soft` nor `hard`. Imported by `models` only.
"""
