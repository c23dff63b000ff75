"""Fits of the parameters of a gas to measured cooling curves.

- `fit`: the public function `fit`, the checks of its arguments and warnings.
- `setup`: what a user asks for, as a `problem` with a first guess (`guesses`): `rows` are the
  measured values, which `measured_rows` makes of a measurement, `parameters` the unknowns on an
  unconstrained scale, with what is known of them.
- `prediction`, `comparison`: a curve by a model with its derivatives, and its independent
  residuals, the `innovations` by a Kalman filter (`kalman`); `likelihood`: the public function of
  the gas.
- `search`: the maximum of the likelihood; `simulations`: the same for stochastic models,
  `simulated_errors` the errors of its estimate, some of them by `prior_effects`, and
  `simulated_fit` its result.
- `estimate`: the searches of a fit and the tests of what they found; `assemble`: its numbers, with
  errors by cause (`information`); `result`: the class `Fit`.
- `goodness`, `outliers`: tests of the fit, and far values.
- `alternatives`: alternative explanations of a curve, and the range of the parameters over them;
  `kinds` is the table of them, `profiles` the fits with each.
- `conclusions`: what a fit concludes, in words: `headline` is its first line, `verdict` its grade,
  `reasons` the reasons for it; `report` shows them.
- `learnt_law`: eps(v) of a fitted law, with its band.
- `plan`, `candidates`, `twins`: the range to expect of an experiment, additions to it, and curves
  by theory for what may be true.
- `imitate`: runs of a fitted scene by particles, each of them fitted.

This package may import all packages below it. It knows models by the interface of
`jaxgran.extend.AbstractModel` only, except `KineticTheory`, the default model, and the particle
models that `imitate` runs. It re-exports nothing.
"""
