"""Hard spheres: instantaneous impacts, predicted and executed in windows of time.

- `walls`: when spheres meet the walls of a container.
- `prediction`: the next impact of each pair, and until when each path is final.
- `candidates`: the pairs that may touch in a window.
- `effects`: what an impact does.
- `impacts`: the execution of the impacts of a window.
- `drive`: random kicks.
- `tangents`, `following`: derivatives at each impact, and after a window.
- `windows`: from window to window.
- `initial_internal`: what hard spheres have besides the state of all spheres.
- `observation`: the records.

May import the modules directly under `particles`, except for `driver`, `pure` and `simulation`, and
the floors below `particles`; not `soft` nor `stochastic`. Is imported by `models` only.
"""
