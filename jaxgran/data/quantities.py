"""Quantities of a cooling curve: their names, units and columns in files."""

from typing import NamedTuple


class Quantity(NamedTuple):
    """A quantity of a cooling curve.

    Attributes:
        field: of `CoolingCurve`.
        column: in a CSV file; its standard error has the column and field with _err and _error.
        unit: SI; "1" for a number without one.
        label: what it is, in words.
        measured: whether experiments measure it, so that a fit may use it.
    """

    field: str
    column: str
    unit: str
    label: str
    measured: bool = False

    @property
    def error(self) -> "Quantity":
        """The standard error of this quantity."""
        label = f"standard error of {self.label}"
        return Quantity(
            f"{self.field}_error", f"{self.column}_err", self.unit, label, measured=True
        )


WITH_ERRORS = (
    Quantity("temperature", "T", "m^2/s^2", "temperature <v^2>/d", measured=True),
    Quantity("displacement", "msd", "m^2", "mean square displacement", measured=True),
    Quantity(
        "rotational_temperature", "T_rot", "m^2/s^2", "T_rot = I <w^2>/(d_rot m)", measured=True
    ),
)
"""Quantities that have standard errors."""

QUANTITIES = {
    quantity.field: quantity
    for quantity in (
        Quantity("times", "t", "s", "time", measured=True),
        *(part for measured in WITH_ERRORS for part in (measured, measured.error)),
        Quantity("sonine", "a2", "1", "second Sonine coefficient"),
        Quantity("third_sonine", "a3", "1", "third Sonine coefficient"),
        Quantity("size_ratio", "size_ratio", "1", "<v^2> of small over <v^2> of large spheres"),
        Quantity("collisions", "collisions", "1", "collisions per particle since t = 0"),
        Quantity("diffusion", "D", "m^2/s", "self-diffusion coefficient"),
        Quantity("velocity_correlation", "velocity_correlation", "m^2/s^2", "<v(0) . v(t)>/d"),
        Quantity("elastic_energy", "elastic_energy", "J", "energy of contacts per particle"),
        Quantity("dissipated_energy", "dissipated_energy", "J", "dissipated energy per particle"),
        Quantity("regularised", "regularised", "1", "impacts per particle made elastic"),
        Quantity("flow_share", "flow_share", "1", "share of kinetic energy in the longest waves"),
        Quantity("derivative_bias", "derivative_bias", "1", "bias of projected d ln T"),
    )
}
"""Quantities by field, in the order of the columns of a file."""
