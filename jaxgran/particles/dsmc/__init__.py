"""Direct simulation Monte Carlo (DSMC): velocities that change by random collisions.

- `collision_rule`: which candidate pairs collide, and what a collision does.
- `pairing`: which pairs are drawn in a step.
- `elements`: walls, a drive and drag; `portions`: of the particles, which they act on in a step.
- `tangents`: in the parameters of the law; `exchange`: of a scene with elements.
- `state`: of a run.
- `collisions`: one step of many collisions.
- `start`: the state at t = 0.
- `simulation`: a whole run as a pure function, and the parts of it that the host driver needs.

May import the modules directly under `particles`, except for `driver`, `pure` and `simulation`, and
the floors below `particles`; not `soft` nor `hard`. Is imported by `models` only.
"""
