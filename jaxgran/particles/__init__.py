"""Simulation of particles: spheres in periodic boxes, and velocities without positions (DSMC).

- `run`: a run of any kind of particles, as a function of arrays (jit, vmap, derivatives) or from
  the host (progress, checkpoints, trajectories, growing arrays, replicas on several devices).
- `dynamics`: the interface of a kind of particles. `soft`, `hard` and `dsmc` implement it.
- `spheres`: the state and the motion that soft and hard spheres share.
- `start`: initial conditions, random or given by the user.
- `elements`: drag, the kicks of a drive, and rough impacts.
- `neighbours`: neighbour lists in periodic boxes. `bit_masks`: positions of the set bits of masks.
  `capacity`: lengths of the arrays of a compiled run.
- `observables`: public functions of particles. `snapshot`: particles and saved records in SI.
"""
