"""The words in which a fit says what it concludes (`jaxgran.fitting.conclusions`)."""

from collections.abc import Iterable
from typing import Any

MESSAGES = {
    # the first line
    "estimate alone": "{symbol} = {estimate:.4g} +- {error:.2g} {unit} {conditional}",
    "estimate and range": "{symbol} = {estimate:.3g} {unit}, 95 % range {low:.3g} to {high:.3g} "
    "{unit}",
    "range alone": "{range} (95 %)",
    "between": "{symbol} is between {low:.3g} and {high:.3g} {unit}",
    "below": "{symbol} is below {high:.3g} {unit}",
    "above": "{symbol} is above {low:.3g} {unit}",
    "unknown": "{symbol} is not determined",
    "constant": "{headline}. Impacts of constant restitution, eps = {eps:.3g}, explain the data "
    "{how_well}; A would then have no meaning",
    "narrowing": "with no {effects}, {range}. If this absence is known, declare `absent: {names}`; "
    "if the effect is present, describe it by {given}",
    # parts of it
    "as well": "equally well",
    "better": "better",
    # the verdict
    "not converged": "The search did not converge: do not trust its estimates.",
    "not consistent": "{model_is} not consistent with {data}: do not trust the estimates. "
    "{preferred} {remedy}",
    "not trusted": "{Model} cannot be trusted in this scene, although the fit to {data} is good. "
    "{remedy}",
    "determined": "{model_is} consistent with {data}, {who_determines} {symbol}: {range}. {edge}",
    "not determined": "{model_is} consistent with {data}, but {symbol} is not determined: {why}. "
    "{edge}",
    "not compared": "{model_is} consistent with {data}. Alternatives were not compared: the range "
    "of {symbol} that they allow is not known. {edge}",
    # parts of it
    "law preferred": "The data prefer a model with {name}.",
    "preferred": "The data prefer a model with {name}, in which {value}.",
    "value": "{symbol} = {estimate:.3g} {unit}",
    "model is": "{Model} is",
    "models are": "{Model} are",
    "drops alone": "which determine",
    "one curve": "which determines",
    "mainly drops": "and the impacts determine",
    "mainly the curve": "and the curve determines",
    "mainly the curves": "and the curves determine",
    "all together": "which together determine",
    "edge": "The scene is at the edge of the model's validity.",
    "other minima": "other values of the parameters fit {data} equally well",
    "possible": "{name} cannot be excluded; over all explanations {range}",
    # reasons
    "chi2": "reduced chi^2 is {reduced:.3g} for {degrees} degrees of freedom (probability by "
    "chance: {chance})",
    "scatters more": "the data scatter more about the model than their errors and N equal spheres "
    "allow; possible causes: another effect, a mixture of sizes, eps that scatters, fewer grains "
    "than given, or noise of the measurement{as_few}",
    "scatters less": "the curve scatters less than N equal spheres do; possible causes: walls that "
    "cool the grains, more grains than given, or smoothing of the curve",
    "rising": "T rises from {first:.3g} to {last:.3g} m^2/s^2, and nothing drives this gas: "
    "check the order of the rows and the noise of the measurement, or give drive_strength",
    "box": "the box of {number} spheres {walls}",
    "gravity": "gravity is taken as absent: in one simulated box with walls of restitution 0.8, "
    "a gravity of 0.1 m/s^2 made A 9 % too small",
    "errors too large": "the residuals are smaller than the errors of T allow by chance: these "
    "errors are too large, or they are common to the points",
    "scatter of eps": "eps of the impacts scatters by {scatter:.2g} beyond its errors",
    "scatter": "the curve scatters as {number:g} +- {error:g} grains do",
    "of each": "{label}: chi^2 is {chi2:.3g} for {number} points; its weight in {symbol} is "
    "{weight:.2f}",
    "assumptions": "the model assumes {all}",
    "absent": "known to be absent: {names}",
    "quick": "alternatives were not compared, as requested",
    "driven": "alternatives were not compared: the gas is driven",
    "not computed": "alternatives not computed: {names}; the range does not allow for them",
    "of particles": "the range over alternatives comes from kinetic theory, shifted to the fitted "
    "curve",
    "is preferred": "{name} added to the model decreases -2 ln L by {improvement:.3g}, which "
    "happens by chance in less than 1 % of fits; in this case {range}",
    "law is preferred": "{name}, {eps:.3g}, in place of the fitted law decreases -2 ln L by "
    "{improvement:.3g}, which happens by chance in less than 1 % of fits: A has no meaning then",
    "law is possible": "{name}, {eps:.3g}, in place of the fitted law cannot be excluded: A would "
    "then have no meaning",
    "outside": "the estimate {estimate:.3g} lies outside this range, because the estimate assumes "
    "that the preferred alternative is absent",
    "is possible": "{name} cannot be excluded; in this case {range}; errors {factor:g} times "
    "smaller would exclude this explanation or make it negligible",
    "outliers": "far outliers at {places}: check them and their error bars; without them {symbol} "
    "is {value:.3g} +- {error:.2g}",
    "errors of T": "T scatters more than its grains can: the fit adds an independent error of "
    "{percent:.2g} % to each T, beside every other effect. {advice}",
    "distant": "nearly every T differs from the fitted one by more than a factor of {ratio:g}: "
    "alternatives were not compared; check the units, the scale of T and T0",
    "max_steps": "the search did not converge: free fewer parameters, or in Python increase "
    "max_steps",
    "simulations": "{number} simulations were run; their noise is at most {share:.0f} % of the "
    "standard error",
    "few particles": "{number} particles are too few for their noise to be known, and cool faster "
    "than a gas: give the model {least} or more",
    "undetermined": "{data} {do} not determine {names}: {why}; free fewer parameters",
    "another minimum": "-2 ln L has another, equally good minimum at {places}: {data} {do} not "
    "distinguish them",
    "slopes": "the error of the derivatives through particles is estimated as {share:.2g} %, which "
    "the standard error includes: use more replicas or, if the gas has a flow, differences=0.3 (in "
    "Python)",
    # parts of them
    "chance": "{percent:.2g} %",
    "nearly certain": "over 99 %",
    "as few": "; about {number:g} grains would scatter as much",
    "far from walls": "far from walls",
    "in vacuum": "in vacuum",
    "homogeneous": "at homogeneous density",
    "in some": "{what} ({labels})",
    "errors are given": "If T_err are errors of the measurement, say so: `errors: measured`",
    "no errors are given": "Give T_err if they are known",
    "weak": "the computed values hardly depend on {names} {hint}",
    "combination": "the computed values depend only on a combination of {names} {hint}",
    "forgets": "(a cooling gas forgets its initial temperature)",
    "A and Y": "(in a gas of hard spheres A and Y enter only as A Y^(2/5))",
}
"""Sentences, and parts of them, by name, with places for values."""

DATA = {
    "curve": {"data": "this curve", "do": "does", "fit": "fits"},
    "impacts": {"data": "these impacts", "do": "do", "fit": "fit"},
    "measurements": {"data": "these measurements", "do": "do", "fit": "fit"},
}
"""Words for what was fitted, with the verbs that agree with it."""

SPHERES = {
    "diameter_sd": "smooth spheres of one material, whose sizes differ as given",
    "friction": "equal spheres of constant friction",
    "surface": "equal, rough spheres of constant beta_t",
    "": "equal, smooth spheres",
}
"""What a model assumes of spheres with an element, the first one that they have; "" for none."""

SEPARATORS = {
    "names": ", ",
    "both": " and ",
    "neither": " and no ",
    "places": " and at ",
}
"""What stands between the parts of a list."""


class Message:
    """A sentence, or a part of one, that `str` puts into words.

    Attributes:
        name: its name in `MESSAGES`.
        values: of its places; messages among them are put into words, too.
        of: the label of the measurement that it is about, which then stands before it.

    >>> print(Message("scatter", of="dense", number=250, error=40))
    dense: the curve scatters as 250 +- 40 grains do
    """

    def __init__(self, name: str, /, *, of: str = "", **values: Any):
        self.name = name
        self.values = values
        self.of = of

    def __str__(self) -> str:
        """Return the words, without the blanks that empty values leave."""
        words = MESSAGES[self.name].format(**self.values)
        words = words.replace("  ", " ").replace(" ,", ",").strip()
        return f"{self.of}: {words}" if self.of else words


def listed(separator: str, parts: Iterable[Any]) -> str:
    """Return parts of a sentence as a list, with a separator of `SEPARATORS` between them."""
    return SEPARATORS[separator].join(map(str, parts))
