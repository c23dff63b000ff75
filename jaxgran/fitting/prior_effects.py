"""Changes of a computed curve by the standard errors of priors, by kinetic theory."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import Priors
from jaxgran.fitting.parameters import extra_parameters, prior_residuals
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import linearise, with_neutral_elements
from jaxgran.scene.gas import Gas


def prior_effects(
    gas: Gas, priors: Priors, computed: CoolingCurve, uses_rotation: bool
) -> dict[str, Float[np.ndarray, "values size"]]:
    """Return the changes of ln T and ln T_rot by one standard error of each prior.

    Kinetic theory gives the changes.

    Args:
        gas: the fitted gas.
        priors: the priors of the fit.
        computed: the computed curve of the fit.
        uses_rotation: whether the fit uses T_rot.
    """
    if not priors:
        return {}
    model = KineticTheory()
    varied = extra_parameters(priors, ())
    times = np.asarray(computed.times)
    complete = with_neutral_elements(gas, model)
    linear = linearise(model.simplified_for(gas), complete, times, varied)

    def of_logs(part: dict[str, Any]) -> np.ndarray:
        of_T = part["temperature"] / linear.values["temperature"][:, None]
        of_rotation = np.zeros_like(of_T)
        if uses_rotation:
            name = "rotational_temperature"
            of_rotation = part[name] / linear.values[name][:, None]
        return np.concatenate([of_T, of_rotation])

    values = {name: np.asarray(gas.value(name)) for name in varied}
    by_parameter = np.concatenate([of_logs(linear.by_float[n]) for n in varied], axis=1)
    rows = prior_residuals(priors, gas, values)
    by_residual = np.block(
        [
            [slopes.get(n, np.zeros((row.size, values[n].size))) for n in varied]
            for row, slopes in rows.values()
        ]
    )
    # Columns of the inverse are the changes of the parameters by one standard error of each prior.
    changes = by_parameter @ np.linalg.pinv(by_residual)
    ends = np.cumsum([given.size for given, _ in priors.values()])[:-1]
    return dict(zip(priors, np.split(changes, ends, axis=1), strict=True))
