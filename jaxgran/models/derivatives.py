"""How the derivatives of models of spheres are taken: projected, by differences, or plainly."""

from collections.abc import Callable
from functools import partial
from typing import Any

from jaxgran.checks.validation import Domain, plain_number
from jaxgran.data.run import Run
from jaxgran.scene.gas import Gas
from jaxgran.tangents.differences import by_differences
from jaxgran.tangents.rule import Inputs, Outputs, differentiable

STEPS = Domain(0.0, 0.5, high_allowed=True)
"""Steps of differences: the lower one of alpha must leave it positive."""


def check_step(differences: Any, projected: bool) -> None:
    """Raise ValueError for a step of differences out of range, or beside plain derivatives."""
    if differences is None:
        return
    advice = "In the logarithm of an impact's loss: 0.3, or None for projected derivatives."
    plain_number("differences", differences, STEPS, advice)
    if not projected:
        raise ValueError(
            f"differences = {differences} and projection = None ask for two kinds of derivative: "
            "leave one of them out"
        )


def check_gas(differences: float | None, gas: Gas) -> None:
    """Raise ValueError for a gas whose derivatives are not known by differences."""
    if differences is not None and gas.elements:
        raise ValueError(
            "derivatives by differences are known for smooth spheres in free flight, and this gas "
            f"has {', '.join(gas.elements)}: leave differences out of the model, or take "
            "differences of runs yourself"
        )


def with_rule(
    outputs: Callable[..., Outputs],
    run: Run,
    differences: float | None,
    projected: bool,
    held: Callable[[Any], Any],
) -> Callable[[Inputs], Outputs]:
    """A run with its rule of differentiation.

    Args:
        outputs: the run, of inputs, directions, and options.
        run: the options.
        differences: step of differences of whole runs; None for none.
        projected: whether derivatives are projected; if not they are plain.
        held: see `jaxgran.tangents.rule.differentiable`.
    """
    outputs = partial(outputs, run=run)
    if not projected:
        return outputs
    if differences is not None:
        further = partial(outputs, run=Run(run.key, run.progress))  # which write no files
        outputs = by_differences(outputs, further, differences)
    return differentiable(outputs, lambda scene: scene.material, held)
