"""The models of a cooling gas.

`base` is the interface that every model has; `kinetic_theory`, `dsmc`, `hard_spheres` and
`soft_spheres` are the models, cheapest first; `spheres` is what the last two share; `checks` and
`error_model` judge scenes; `selection` chooses a model. No module outside this package knows a model by
its class, except for the default.

May import: checks, scene, data, theory, tangents, particles. Imported by: cooling, fitting.
"""
