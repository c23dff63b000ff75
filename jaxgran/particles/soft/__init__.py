"""Soft spheres: every contact is resolved by time steps, in blocks of steps.

- `candidates`: the pairs that may touch in a block.
- `steps`: the time steps of these pairs.
- `linearised`: the same together with tangents.
- `block`: from block to block.
- `scene`, `observation`: the gas in reduced units, and the records.

May import the modules directly under `particles`, except for `driver`, `pure` and `simulation`, and
the floors below `particles`; not `hard` nor `stochastic`. Is imported by `models` only.
"""
