"""Hard spheres: instantaneous impacts, predicted and executed in windows of time.

- `prediction`: the next impact of each pair, on walls too, and until when each path is final.
- `candidates`: the pairs that may touch in a window.
- `impacts`: the effect of impacts, and its derivatives.
- `window`: the execution of all impacts of a window, and their sums.
- `window_length`: how long windows are.
- `drive`: random kicks at both ends of a window, and their heat.
- `dynamics`: the sequence of windows, with tangents.
- `records`: what a run records of its states.

May import the modules directly under `particles`, except for `run`, and the layers below
`particles`; not `soft` nor `dsmc`. Imported by `models` only.
"""
