"""Hard spheres: instantaneous impacts, predicted and executed in windows of time.

May import the modules directly under `particles` and what they may import; not `soft` nor
`stochastic`. Is imported by `models` only.
"""
