"""Static sizes of the arrays in which a compiled run of spheres, or a batch of runs, is held."""

import math
from typing import Any, NamedTuple

from jaxgran.particles.capacity import Capacity

SIZED_MEMBERS = 8
"""Number of members of a batch for which the lengths of arrays are computed: more members get a
multiple of them."""


class ArraySizes(NamedTuple):
    """Static sizes of the arrays of a compiled run.

    Attributes:
        steps: time steps in a block of soft spheres, impacts per particle in a window of hard ones.
        capacity: sizes of the arrays of the run.
        equilibration_capacity: sizes of the arrays in the first mean free times of equilibration.
        engine: search for pairs in compiled code, for which `lookahead` of the sizes is made.
        made_for: fields of the model, and their values, for which the sizes are made.
        of_batch: sizes for `SIZED_MEMBERS` such gases in one array; None for known numbers.
    """

    steps: Any
    capacity: Capacity
    equilibration_capacity: Capacity
    engine: str
    made_for: tuple[tuple[str, Any], ...] = ()
    of_batch: "ArraySizes | None" = None

    def check_made_for(self, model: Any) -> None:
        """Raise ValueError if the settings of a model have changed since it was sized."""
        for setting, planned in self.made_for:
            value = getattr(model, setting)
            if planned != value:
                raise ValueError(
                    f"this {type(model).__name__} was sized for {setting} = {planned!r}, and now "
                    f"has {value!r}. Call sized_for(gas) again."
                )

    def for_members(self, members: int) -> "ArraySizes | None":
        """Return the sizes for members of a batch in one array; None if they are not known."""
        if self.of_batch is None:
            return None
        multiple = math.ceil(members / SIZED_MEMBERS)
        return self.of_batch._replace(capacity=self.of_batch.capacity.of_batch(multiple))
