"""Kinetic theory: averages over impacts, closed forms, and the shear modes of a large box.

Imports `checks` and `scene` only, no particles and no models; `tangents`, `particles`, `models` and
the packages above may import it.
"""
