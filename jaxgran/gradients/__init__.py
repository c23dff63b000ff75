"""Derivatives of particle runs beyond the time after which chaos makes plain ones useless.

- `thermal`: tangents of positions and velocities, projected onto T at regular intervals.
- `rates`: averages from which derivatives in time are estimated.
- `rotation`: tangents of spins of a gas of contacts that rub, projected onto T_rot.
- `impact`: tangents of a gas of instantaneous impacts, projected at every impact.
- `paths`: what a change of the temperature does to displacements and the velocity correlation.
- `rule`: the rule of differentiation of a whole run, for forward and reverse mode.
- `limits`: what a rule refuses (second derivatives) and what it does not know (nan).

May import `scene` and `theory`; is imported by `particles` and `models`. Nothing is re-exported.
"""
