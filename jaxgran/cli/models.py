"""Models by the names that they have as arguments."""

import warnings
from typing import Any, Literal, get_args

import jaxgran
from jaxgran.models.base import AbstractModel
from jaxgran.models.selection import default_models


def named(models) -> dict[str, AbstractModel]:
    """Models by their names as arguments: "soft-spheres"."""
    return {model.name.lower().replace(" ", "-"): model for model in models}


Model = Literal["kinetic-theory", "dsmc", "hard-spheres", "soft-spheres", "auto"]
"""Arguments of --model. Written down, for making the models would start XLA, whose settings a
command has still to choose (`jaxgran.cli.programs`)."""

MODELS: tuple[str, ...] = get_args(Model)


def model_of(options: Any, gas, curve, free, num_particles: int | None):
    """The model, and why it was chosen if it was."""
    size = num_particles if options.particles is None else options.particles
    replicas = options.replicas
    if options.model != "auto":
        model = named(default_models(2 if size is None else size, replicas))[options.model]
        if model.stochastic and size is None:
            raise ValueError(f"{options.curve} does not say N: give --particles")
        return model, ()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the diagnosis of the final fit says it
        first = jaxgran.fit(gas, curve, free=free)
    choice = jaxgran.choose_model(
        first.gas,
        curve.times,
        options.tolerance,
        size if num_particles is None else num_particles,
        replicas=replicas,
    )
    if options.particles is None:
        return choice.model, choice.reasons
    # Chosen for the box of the file's N, followed with as many particles as asked.
    (name,) = named([choice.model])
    return named(default_models(options.particles, replicas))[name], choice.reasons
