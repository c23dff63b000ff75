"""Fits of the parameters of a gas to measured cooling curves.

- `fit`: the public function `fit`, the checks of its arguments and warnings.
- `parameters`: the free parameters in an unconstrained scale, initial guesses, priors.
- `residuals`: weighted residuals of a measurement with their derivatives, their statistics, errors
  from few replicas.
- `optimise`: all measurements and unknowns of a fit, and the search.
- `stochastic`: fits of stochastic models by a search through repeated simulations.
- `result`: `Fit`, its assembly from the linearised residuals, and goodness of fit.
- `error_budget`: errors that depend on the fitted gas: of the clock, few particles, derivatives.
- `alternatives`: alternative explanations of a curve, and the range of the parameters over them.
- `diagnosis`: interpretation of a fit in words, and `log_likelihood` for samplers.
- `plan`, `candidates`, `twins`: the range to expect of an experiment, additions to it, and curves
  by theory for what may be true.
- `imitate`: runs of a fitted scene by particles, each of them fitted.

This package may import all packages below it and `jaxgran.models`. It knows models by the interface
of `jaxgran.AbstractModel` only, except `KineticTheory`, the default model, and the particle models
that `imitate` runs. `jaxgran`, `jaxgran.plotting`, `jaxgran.cli` and experiments import it. It
re-exports nothing.
"""
