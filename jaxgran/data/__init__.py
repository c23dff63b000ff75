"""Cooling curves and their files, particles and their files, checkpoints, and options of a run.

The package imports `jaxgran._utils` and `jaxgran.scene` only; every package above may import it.
"""
