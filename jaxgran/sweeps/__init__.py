"""Sweeps: many gases, over the devices of one or several processes, kept in a store.

`sweep` is the call, `batch` the gases and their labels, `program` what a device runs, `layout` the
arrays of a store, `store` its chunks on the disk.
"""
