"""Data: cooling curves and their files, checkpoints, and the options of a run.

Imports `checks` and `scene` only; every package above may import it.
"""
