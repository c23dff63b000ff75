"""Direct simulation Monte Carlo (DSMC): velocities that change by random collisions.

- `collisions`: the state of a run, and one step of many collisions, with walls, a drive and drag.
- `run`: initial states, records, a whole run as a pure function, and its parts for the host.

May import the modules directly under `particles` and the floors below; not `soft` nor `hard`.
Imported by: models.
"""
