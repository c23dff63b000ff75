"""Sweeps: many gases, over the devices of one or several processes, kept in a store.

`sweep` is the call, `batch` the gases and their labels, `program` what a device runs, `store` the
chunks on the disk.
"""
