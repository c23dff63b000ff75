"""Soft spheres: every contact is resolved by time steps, in blocks of steps.

- `forces`: the forces, and the time steps of spheres that may touch.
- `dynamics`: the sequence of blocks, with tangents and records.

May import the modules directly under `particles`, except for `run`, and the layers below
`particles`; not `hard` nor `dsmc`. Imported by `models` only.
"""
