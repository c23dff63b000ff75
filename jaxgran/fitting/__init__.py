"""Fits of the parameters of a gas to a measured cooling curve.

- `fit`: the public function: checks of its arguments, warnings; `checks`: those of all fits.
- `deterministic`: a fit through a model without noise; uses `comparison`, the weighted residuals,
  and `least_squares`, the minimisers (Levenberg-Marquardt, L-BFGS).
- `stochastic`: a fit through a model with noise; uses `gauss_newton`, the search through
  repeated simulations.
- `guess`: initial guesses from the measured curve.
- `parameters`: the free parameters as one array in a scale without bounds.
- `priors`: what is known of a gas besides the curve.
- `budget`: errors that follow from the fitted gas: of the model's clock there, of few particles.
- `joint`: one fit of several curves and drop tests.
- `likelihood`: `log_likelihood`, the same residuals for samplers.
- `result`: `Fit`, what a fit returns, and goodness of fit.
- `alternatives`: what else could have made the curve, and the range of the parameters then; uses
  `profile`, fits of the law and something besides, of a given amplitude, and `amplitudes`, what
  these say of one rival.
- `residuals`: statistics of residuals; `few_replicas`: errors that few replicas leave uncertain.
- `diagnosis`: what a fit means, in words.

The top floor: may import every other package. Models are known by `jaxgran.AbstractModel` only;
`KineticTheory` is imported as the default model. Is imported by `jaxgran` itself, by
`jaxgran.plotting` and by experiments. Nothing is re-exported.
"""
