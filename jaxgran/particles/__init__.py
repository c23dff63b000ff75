"""Simulation of particles: spheres in periodic boxes, and velocities without positions (DSMC).

From the bottom: `compaction`, `sweep_and_prune`, `neighbours` (the only module that imports jax_md)
and `capacity` are tools; `initial`, `user_start` and `observables` are states before and after;
`state` and `dynamics` are what `soft` and `hard` spheres have in common; `stochastic` is DSMC; a
`simulation` is run by `pure` (a function of arrays: jit, vmap, derivatives) or by `driver` (from
the host: progress, checkpoints, arrays that grow).

May import: checks, scene, data, theory, tangents. Imported by: models.
"""
