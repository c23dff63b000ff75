"""Kinetic theory: averages over impacts, the equations of a homogeneous gas, and their solver.

Imports `_utils`, `data` and `scene` only; `gradients`, `particles`, `models` and the packages above
may import it.
"""
