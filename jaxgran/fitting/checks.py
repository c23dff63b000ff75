"""Checks of what a fit is given, shared by all kinds of fits."""

import numpy as np

from jaxgran.checks.tracing import any_traced
from jaxgran.checks.validation import no_type_check
from jaxgran.data.curve import COLUMNS, CoolingCurve
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_gas, checked_model
from jaxgran.scene.gas import Gas

MAGNITUDES = 1e-30, 1e30
"""Smallest and largest values of a measurement, SI."""

LEAST_ERROR = 1e-12
"""Least relative error of a measurement."""


@no_type_check
def check_curve(gas: Gas, curve: CoolingCurve) -> None:
    """Raise ValueError for anything but one gas and a curve that can have been measured."""
    checked_gas(gas)
    if not isinstance(curve, CoolingCurve):
        raise ValueError(f"curve must be a jaxgran.CoolingCurve, got {curve!r:.60}")
    curve.check()
    _check_magnitudes(curve)


def _check_magnitudes(curve: CoolingCurve) -> None:
    """Raise ValueError for values that are no measurement: mostly slips of the pen or of units."""
    if any_traced(curve):
        return
    smallest, largest = MAGNITUDES
    for column, field in COLUMNS.items():
        values = getattr(curve, field)
        if values is None:
            continue
        least, values = smallest, np.asarray(values)
        if column.endswith("_err"):
            least = LEAST_ERROR * np.asarray(getattr(curve, field.removesuffix("_error")))
        wrong = (values > 0) & ((values < least) | (values > largest))
        if np.any(wrong):
            i = int(np.argmax(wrong))
            raise ValueError(
                f"point {i}: {column} is {values[i]:g}, which cannot be measured (allowed are "
                f"{smallest:g} to {largest:g} in SI units, and errors above {LEAST_ERROR:g} of the "
                "value); correct or remove it"
            )


def unused_rotation(gas: Gas, curve: CoolingCurve) -> str | None:
    """Why a fit does not use the T_rot of a curve; None if it does, or if there is none."""
    if curve.rotational_temperature is None:
        return None
    if gas.surface is None:
        return (
            "the measured T_rot is not used, since the gas has no surface=jaxgran.Rough(...) "
            "(header key beta_t)"
        )
    lacking = {"T_err": curve.temperature_error, "T_rot_err": curve.rotational_temperature_error}
    names = [name for name, error in lacking.items() if error is None]
    if names:
        return f"the measured T_rot is not used, for want of {' and '.join(names)} to weigh it by"
    return None


@no_type_check
def check_deterministic(model: AbstractModel, user: str) -> None:
    """Raise ValueError for a model whose every curve has other noise."""
    checked_model(model)
    if model.stochastic:
        raise ValueError(
            f"{user} needs a model without noise, got {type(model).__name__}, which is stochastic: "
            "use jaxgran.KineticTheory()"
        )
