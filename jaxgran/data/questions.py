"""Questions about unusual values of measured data and their headers.

Each question names the value, what is usual, and the factor that would make it usual. The reader
turns it into a warning; the values are used as they are.
"""

from typing import Any

QUESTIONS = {
    # keys of a header
    "unknown keys": "ignoring unknown header keys: {unknown}. Known keys are {known}, and errors "
    "such as eta_err",
    "another gas": "{key} is {given:g} in this header, but {used:.4g} in the gas that is used: "
    "impacts of other spheres need a header of all of them, read without this gas",
    # units
    "unusual": "{name} is {value:.6g} {base}, where usual values are {low:g} to {high:g}: "
    "{question}",
    "T0 is 1": "T0 is 1 m^2/s^2: is the temperature divided by its first value? Then give T0 in "
    "m^2/s^2, and multiply T by it",
    "large error": "{key}_err is {error:.6g} {unit}, larger than {key} itself, {value:.6g} {unit}: "
    "an error without a unit is read in the unit of {key}. If it is in {unit}, write {unit} after "
    "it",
    "large error of a number": "{key}_err is {error:.6g}, larger than {key} itself, {value:.6g}: "
    "check it",
    # errors
    "T_err and N": "T_err is {comparison} than the scatter of T of N = "
    "{number:g} particles in {replicas:g} run(s): do N, replicas and T_err belong to this curve, "
    "and is T_err a standard error of the mean?",
    "digits": "{column}_err = {error:.2g} is smaller than the rounding error of {column} (its last "
    "digit, {digit:.2g}, over sqrt(12); both in SI). The fit adds the rounding error. Write more "
    "digits of {column}",
    # the start and the loss
    "late start": "by the first rows, extrapolated, T is T0 = {T0:g} m^2/s^2 at t = {begin:.6g} s, "
    "not at t = 0: did the clock start before the gas began to cool? Then subtract this time from "
    "t, or fit it: --free A t0",
    "loss": "T falls to a half in {halving:.3g} mean free times of the header's gas (eta, "
    "diameter, T0), where usual values are {low:.2g} to {high:.2g}: {question}",
    # the definition of T
    "mean_speed": "mean_speed is read as the speed in three dimensions. If it contains only the "
    "two components that one camera sees, T is 0.62 of the true one and A 37 % too large: name the "
    "column mean_speed_xy then, and mean_speed_xyz otherwise",
    "scale": "T is {first:.4g} at first, {ratio:.3g} times the header's T0 = {T0:g} m^2/s^2: "
    "{question}. If T is right, correct T0",
    # impacts
    "sign of eps_t": "{name} falls as impacts become more grazing, and Coulomb's law makes it rise "
    "to 1: is it beta_t = -{name}? Then change its sign",
    # tracks
    "no track": "{number} positions that belong to no track are left out",
    "identities": "{left_out}: {too_long} are longer than the distribution of speeds allows, and "
    "{swapped} shorter if two particles exchange their identities; check the tracks",
    "median": "T by the mean square of the speeds is {percent:+.2g} % from T by their median: "
    "identities may be wrong, or the gas may consist of unequal parts",
    "localisation": "localisation_error adds up to {percent:.2g} % to T, too much for an accurate "
    "correction: leave out the last frames",
    "unknown localisation": "localisation_error not given, and estimated as {error:.2g} m; measure "
    "it and add it to the header",
    "impacts": "impacts between frames take up to {percent:.2g} % from T, too much for an accurate "
    "correction: use frames closer together",
    "rate": "velocities change {ratio:.2g} times as fast as impacts at this eta and diameter "
    "change them: check these and the tracks",
}
"""Questions by name, with places for values and for parts."""

PARTS = {
    # units
    "any unit": "check its unit",
    "any unit of T": "check its unit (kelvin times 1.38e-23 J/K over the mass are m^2/s^2)",
    "unit of a key": "is it in {unit}? Then write {name}: {in_si:.6g}, or {name}: {value:g} {unit}",
    "unit of a column": "is it in {unit}? Then write {name} ({unit}) as the name of the column",
    # errors
    "larger": "at least {ratio:.2g} times larger",
    "smaller": "at least {ratio:.2g} times smaller",
    # the start and the loss
    "unit of t": "is t in {units}? Then name the column t ({unit}).",
    "any unit of the header": "are t, eta, diameter and T0 in the units that the file says?",
    "steps": " Or is t counted in steps or frames? Then multiply t by the duration of one",
    # the definition of T
    "definition": "is the column {words}? Then {rename}multiply {what} by {factor:.6g}",
    "rename": "name the column {column}, or ",
    "any definition": "are T and T0 both <v^2>/d, averaged over the grains, in m^2/s^2? (Not in "
    "kelvin, not the energy of all N grains, not T over its first value)",
}
"""Parts of questions by name, with places for values."""


def ask(name: str, /, **values: Any) -> str:
    """Return a question of `QUESTIONS` with its values."""
    return QUESTIONS[name].format(**values)


def part(name: str, /, **values: Any) -> str:
    """Return a part of a question, of `PARTS`, with its values."""
    return PARTS[name].format(**values)
