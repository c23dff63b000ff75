"""Result of a fit: estimates, errors by cause, the range over all explanations, and its file."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxgran._utils.formatting import format_quantity, text_table
from jaxgran._utils.json_tree import NotStorable, from_json, to_json
from jaxgran.data import files
from jaxgran.data.measurement import START_TIME, Measurement
from jaxgran.fitting.alternatives import Alternative
from jaxgran.fitting.search import Trace
from jaxgran.models.base import AbstractModel
from jaxgran.scene.parameters import symbol_of, unit_of

MAX_ROWS = 20
"""Number of estimates up to which a fit lists each element of its vectors."""

CONDITIONAL = "assuming no other effect"
"""Name of estimates and standard errors that hold if the scene is complete."""

DETERMINED = "determined"
NOT_DETERMINED = "not determined"
NOT_CONSISTENT = "not consistent"
"""Grades of `Fit.grade`."""

RESULT = "result"
"""Entry of a JSON file that holds a `Fit`."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit of p free parameters.

    In a fit of several measurements `gas` and `curve` are dictionaries by label, and the name of a
    parameter that a measurement has separately begins with its label: "dense: t0". Arrays are those
    of NumPy.

    Attributes:
        names: names of the free parameters.
        model: the fitted model; None where the result was read from a file.
        model_name: its name in a sentence.
        measurements: what was fitted, by label; "" is the label of a single measurement.
        gas: the fitted gas, including fitted values of all parameters that have priors.
        curve: the cooling curve of the fitted gas at the measured times; for a stochastic model
            the curve of the last simulation, one step before the estimate. None for a drop test.
        estimate: estimates of the free parameters, SI, shape (p,).
        covariances: covariances of the estimates, SI, shape (p, p), by the source of the error:
            "measurement", the errors of the data; "few particles", the randomness of single
            collisions of N grains; "model", the error of the model's cooling rate in this scene;
            "model of T_rot" and "model of <dr^2>", the error of a common factor of these values;
            "calibration", the common scale of T; the name of a prior, for each of them; and for a
            stochastic model "simulation", its noise, and "slope", the bias of its derivatives.
        ranges: 95 % range of each free parameter, SI, over all explanations that the data do not
            exclude; {} where the alternatives were not compared.
        alternatives: other explanations of the data, those that fit best first.
        chi2: sum of squares of all independent residuals of unit variance.
        degrees_of_freedom: number of residuals minus number of parameters.
        p_value: probability of residuals as large by chance, of the quantity that fits worst.
        smooth_p_value: probability of residuals as small by chance.
        log_likelihood: largest value of ln L, up to a constant.
        residuals: independent residuals of unit variance, by label and by field of the curve, or
            "drop test".
        scatter: the variance by the collisions of N grains over what theory gives for N (for 1000
            grains where N is not known), and its standard error, by label.
        errors_of_T: relative standard deviation of independent errors of T, by label, for curves
            without errors that scatter more than their grains can.
        scales: numbers that describe each fitted gas: phi, tau_c (s), t_c/tau_c, beta at sqrt(2
            T_0), eps at the thermal speeds of t = 0 and of the last T, the mean free path and the
            side of a cube of N grains (m), by label.
        start_time: t0, the time at which the gas had T_0 and began to cool, s, by label; 0 unless
            free.
        weights: fraction of the information on each estimate from each measurement, by label.
        undetermined: the parameters that the data do not determine, or only in a combination.
        other_minima: estimates at other minima of -2 ln L that are as good, shape (others, p).
        converged: True if the search reached its tolerance.
        iterations: steps of all searches, or simulations by a stochastic model.
        trace: course of a gradient descent; None for other searches.
        grade: "determined" if the model is consistent with the data, and no explanation that they
            allow changes the first parameter by more than 10 % beyond its error; "not determined"
            if the model is consistent alone; "not consistent" if the search did not converge, the
            misfit is significant, the data prefer an alternative, or the model has a decisive
            limitation in the scene.
        headline: the first free parameter with its range.
        narrowing: which knowledge would narrow this range, and to which one; "" if none would.
        verdict: a sentence that says what `grade` does, and what to do if the model is not
            consistent.
        reasons: reasons for the verdict, one sentence each.

    >>> A, error = result.value("dissipative_constant")
    >>> f"{float(A):.3g} s", sorted(result.error_budget)
    ('3e-06 s', ['few particles', 'measurement', 'model'])
    >>> result.headline[:24], result.grade
    ('A = 3e-06 s, 95 % range ', 'not determined')
    """

    names: tuple[str, ...]
    model: AbstractModel | None
    model_name: str
    measurements: dict[str, Measurement]
    gas: Any
    curve: Any
    estimate: Float[np.ndarray, "p"]
    covariances: dict[str, Float[np.ndarray, "p p"]]
    ranges: dict[str, tuple[np.ndarray, np.ndarray]]
    alternatives: tuple[Alternative, ...]
    chi2: float
    degrees_of_freedom: int
    p_value: float
    smooth_p_value: float
    log_likelihood: float
    residuals: dict[str, dict[str, np.ndarray]]
    scatter: dict[str, tuple[float, float]]
    errors_of_T: dict[str, float]
    scales: dict[str, dict[str, float]]
    start_time: dict[str, float]
    weights: dict[str, np.ndarray]
    undetermined: tuple[str, ...]
    other_minima: Float[np.ndarray, "others p"]
    converged: bool
    iterations: int
    trace: Trace | None = None
    grade: str = ""
    headline: str = ""
    narrowing: str = ""
    verdict: str = ""
    reasons: tuple[str, ...] = ()

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Covariance of the estimates, SI: the sum of all parts."""
        return np.sum(list(self.covariances.values()), axis=0)

    @property
    def standard_error(self) -> Float[np.ndarray, "p"]:
        """One standard deviation of each estimate, SI, from all known sources of error.

        It assumes that the scene has no effect that is missing in the measurement: see `ranges`.
        """
        return np.sqrt(np.diag(self.covariance))

    @property
    def error_budget(self) -> dict[str, Float[np.ndarray, "p"]]:
        """The parts of `standard_error`, SI; their squares add up to its square."""
        return {name: np.sqrt(np.diag(part)) for name, part in self.covariances.items()}

    @property
    def reduced_chi2(self) -> float:
        """chi^2 per degree of freedom."""
        return self.chi2 / self.degrees_of_freedom

    def value(self, name: str) -> tuple[Any, Any]:
        """Return the estimate and the standard error of a parameter.

        For a vector these are vectors; "coefficients[0]" is the name of one of its elements.

        Raises:
            ValueError: for a parameter that was not free.
        """
        if name in self.element_names:
            at = self.element_names.index(name)
        elif name in self.names_of_elements:
            at = np.flatnonzero([vector == name for vector in self.names_of_elements])
        else:
            raise ValueError(f"{name!r} was not free; free were {', '.join(self.names)}")
        return self.estimate[at], self.standard_error[at]

    @property
    def element_names(self) -> tuple[str, ...]:
        """Name of each element of `estimate`: "coefficients[0]" is the first of a vector."""
        places = [(name, i) for name, shape in self._shapes.items() for i in np.ndindex(shape)]
        return tuple(name + (f"[{','.join(map(str, i))}]" if i else "") for name, i in places)

    @property
    def names_of_elements(self) -> list[str]:
        """Name of the parameter of each element of `estimate`."""
        return [name for name, shape in self._shapes.items() for _ in range(int(np.prod(shape)))]

    @property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters."""
        gases = by_label(self.gas)
        shapes = {}
        for name in self.names:
            label, _, short = name.rpartition(": ")
            gas = gases.get(label, next(iter(gases.values())))
            shapes[name] = ()
            if short != START_TIME and gas is not None:
                shapes[name] = np.shape(gas.value(short))
        return shapes

    def __repr__(self) -> str:
        """Table of the range, the estimates and the goodness of fit."""
        rows = [("", text) for text in (self.narrowing, self.verdict) if text]
        rows.append((CONDITIONAL, ""))
        shown = list(zip(self.names, self.names, strict=True))
        if len(self.estimate) <= MAX_ROWS:
            shown = list(zip(self.element_names, self.names_of_elements, strict=True))
        for element, name in shown:
            value = " +- ".join(format_quantity(x, unit_of(name)) for x in self.value(element))
            value = "not determined" if name in self.undetermined else value
            rows.append((symbol_of(element), value))
        chi2 = f"{format_quantity(self.reduced_chi2)}, p = {format_quantity(self.p_value)}"
        course = "" if self.trace is None else f": {self.trace.reason}"
        rows.append(("reduced chi^2", chi2))
        rows.append(("converged", f"{self.converged}{course}"))
        return text_table(self.headline, rows)

    def save(self, path: str | Path, *, overwrite: bool = False, **entries: Any) -> None:
        """Write the result to a JSON file that `Fit.load` reads.

        The model, and gases and measurements with a law of a user, are left out.

        Args:
            path: the file.
            overwrite: whether an existing file may be replaced.
            entries: further entries of the file, as JSON takes them.

        Raises:
            ValueError: if the file exists and `overwrite` is False.
            OSError: naming the path, if it cannot be written.

        >>> result.save("fit.json", overwrite=True)
        >>> jaxgran.Fit.load("fit.json").headline == result.headline
        True
        """
        path = files.checked_path(path, "a JSON file")
        if path.exists() and not overwrite:
            raise ValueError(f"{path} exists; choose another name or set overwrite=True")
        stored = {}
        for f in dataclasses.fields(self):
            try:
                stored[f.name] = None if f.name == "model" else to_json(getattr(self, f.name))
            except NotStorable:
                stored[f.name] = None
        text = json.dumps(entries | {RESULT: stored}, indent=1, allow_nan=False) + "\n"
        files.write_atomically(path, lambda file: file.write(text.encode()))

    @classmethod
    def load(cls, path: str | Path) -> "Fit":
        """Read a result from a file that `save`, or the command ``jaxgran fit``, wrote.

        Raises:
            ValueError: for another file.
        """
        path = files.checked_path(path, "a JSON file of a fit")
        with files.name_in_errors(path):
            try:
                stored = json.loads(path.read_text("utf-8"))[RESULT]
                return cls(**{name: from_json(value) for name, value in stored.items()})
            except (KeyError, TypeError, AttributeError, json.JSONDecodeError) as error:
                raise ValueError(
                    f"not a fit that this version of jaxgran wrote ({error!r:.80}); give the JSON "
                    "file of jaxgran.Fit.save or of jaxgran fit"
                ) from None


def by_label(of_fit: Any) -> dict[str, Any]:
    """Return `Fit.gas` or `Fit.curve` as a dictionary, in which a single one has the label ""."""
    return of_fit if isinstance(of_fit, dict) else {"": of_fit}


def prefix_of(label: str) -> str:
    """Return what stands before a sentence on a measurement; nothing without a label."""
    return f"{label}: " if label else ""
