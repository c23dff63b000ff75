"""Direct simulation Monte Carlo (DSMC): velocities that change by random collisions.

- `collision_rule`: which candidate pairs collide, and what a collision does.
- `collisions`: one step of many collisions.
- `simulation`: a whole run, as a pure function and by the driver on the host.

May import the modules directly under `particles` and what they may import; not `soft` nor `hard`.
Is imported by `models` only.
"""
