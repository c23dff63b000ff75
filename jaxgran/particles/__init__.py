"""Simulation of particles: spheres in periodic boxes, and velocities without positions (DSMC).

- `observables`: public functions of particles. `snapshot`: particles and saved records in SI.
- `neighbours`: periodic boxes and neighbour lists; the only module that imports jax_md.
  `capacity`: lengths of the arrays of a compiled run.
- `setup`: initial conditions, random or given by the user.
- `state`, `dynamics`: the state of spheres and the interface of their dynamics, which the packages
  `soft` and `hard` implement.
- `run`: runs of spheres as a function of arrays (jit, vmap, derivatives) or from the host
  (progress, checkpoints, trajectories, growing arrays), and replicas on several devices.
- `dsmc`: direct simulation Monte Carlo.
"""
