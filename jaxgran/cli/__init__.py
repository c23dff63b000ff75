"""The command `jaxgran`: fit a curve, compute one, choose a model."""
