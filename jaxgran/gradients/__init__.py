"""Derivatives of particle runs for times after which chaos makes plain derivatives useless.

- `rule`: the rule of differentiation of a whole run, for forward and reverse mode.
- `tangents`: what a gas of lasting contacts, and a gas of instantaneous impacts, remember of a
  derivative.
- `differences`: derivatives by differences of whole runs instead.

May import `scene` and `theory`; is imported by `particles` and `models`. Nothing is re-exported.
"""
