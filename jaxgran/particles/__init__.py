"""Simulation of particles: spheres in periodic boxes, and velocities without positions (DSMC).

From the bottom: `compaction`, `sweep_and_prune`, `neighbours` (the only module that imports jax_md)
and `capacity` are tools; `initial` and `user_start` are states before a run, `observables` and
`snapshot` what is seen of one; `state` and `dynamics` are what `soft` and `hard` spheres have in
common; `stochastic` is DSMC; a `simulation` is run by `pure` (a function of arrays: jit, vmap,
derivatives) or by `driver` (from the host: progress, checkpoints, trajectories, arrays that grow;
`programs` are those it has compiled).

May import: checks, scene, data, theory, tangents. Imported by: models.
"""
