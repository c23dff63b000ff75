"""Soft spheres: every contact is resolved by time steps, in blocks of steps.

May import the modules directly under `particles` and what they may import; not `hard` nor
`stochastic`. Is imported by `models` only.
"""
