"""Models of a cooling gas.

- `cool`: the cooling curve of a gas by any model.
- `base`: the interface of a model.
- `kinetic_theory`, `dsmc`, `hard_spheres`, `soft_spheres`: the models, fastest first;
  `particle_model` is the base of the last three, and `spheres` of the last two. `array_sizes`
  has the sizes of the arrays of a compiled run, and `members` runs a batch in one array.
- `linearise`: the program that fits, diagnoses and the choice of a model share.
- `choose`: choice of a model, by the errors that `error_model` estimates.
- `checks`: checks of arguments and scenes; `limitations`: limits of validity of the models.

No module outside this package knows a model by its class, except for the default.

May import: _utils, scene, data, theory, gradients, particles. Imported by: fitting, sweeps, cli.
"""
