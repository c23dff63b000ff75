"""Derivatives of particle runs for times after which chaos makes plain derivatives useless.

- `rule`: the rule of differentiation of a whole run, for forward and reverse mode, by projected
  tangents or by differences of runs.
- `tangents`: the tangents of gases of lasting contacts and of instantaneous impacts.

May import `scene` and `theory`; is imported by `particles` and `models`. Nothing is re-exported.
"""
