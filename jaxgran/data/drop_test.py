"""Measured coefficients of restitution of single impacts."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.checks.validation import POSITIVE, Domain, UserNumber, UserTruth, number, truth_value
from jaxgran.data.files import number_row, read_text
from jaxgran.scene.gas import Gas

COLUMNS = ("v", "eps", "eps_err")
RESTITUTION = Domain(0.0, 1.0, high_allowed=True)


class DropTest(eqx.Module):
    """Coefficients of restitution of single impacts at some normal speeds.

    They depend on ``A Y^(2/5)``, as the cooling of a gas of hard spheres does, and on nothing that
    a cooling curve needs besides.

    Args:
        speed: normal relative speed before each impact, m/s, shape (n,), > 0.
        restitution: eps, shape (n,), in (0, 1].
        error: standard error of each eps, shape (n,), > 0.
        onto_plate: whether a sphere falls onto a thick plate of its own material, by which
            ``alpha`` is smaller by sqrt(2), or two equal spheres meet.

    Raises:
        ValueError: for a value out of its range, or lists of different lengths.

    >>> drops = jaxgran.DropTest(speed=[0.1, 0.3], restitution=[0.92, 0.90], error=[0.01, 0.01])
    >>> drops.speed.shape
    (2,)
    """

    speed: UserNumber = eqx.field(converter=number)
    restitution: UserNumber = eqx.field(converter=number)
    error: UserNumber = eqx.field(converter=number)
    onto_plate: UserTruth = eqx.field(static=True, default=False)

    def __check_init__(self):
        truth_value("onto_plate", self.onto_plate)
        POSITIVE.check("speed", self.speed, "Give normal speeds in m/s.")
        RESTITUTION.check("restitution", self.restitution, "eps is what is left of the speed.")
        POSITIVE.check("error", self.error, "Give the standard error of each eps.")
        shapes = [np.shape(x) for x in (self.speed, self.restitution, self.error)]
        if len(shapes[0]) != 1 or len(set(shapes)) > 1 or shapes[0] == (0,):
            raise ValueError(
                "speed, restitution and error must be lists of one length, of one impact at least; "
                f"got shapes {', '.join(map(str, shapes))}"
            )

    def residuals(self, gas: Gas) -> Float[Array, "n"]:
        """(measured - computed eps) over the error, for spheres of a gas."""
        reduced = gas.law.on_wall if self.onto_plate else gas.law.reduced
        law = reduced(diameter=gas.diameter, mass=gas.mass, speed=jnp.ones(()))
        computed = law.restitution(jnp.asarray(self.speed))
        return (jnp.asarray(self.restitution) - computed) / jnp.asarray(self.error)


def read_drop_test(path: str | Path, *, onto_plate: bool = False) -> DropTest:
    """Read a drop test from a CSV file with a line of names, v,eps,eps_err, and rows of numbers.

    Args:
        path: the file; v in m/s. Lines that begin with # are left out.
        onto_plate: see `DropTest`.

    Raises:
        ValueError: saying what is wrong, in which line.

    >>> from pathlib import Path
    >>> rows = "v,eps,eps_err", "0.1,0.92,0.01", "0.3,0.90,0.01", "1.0,0.87,0.01"
    >>> size = Path("drops.csv").write_text(chr(10).join(rows))
    >>> jaxgran.read_drop_test("drops.csv").restitution.shape
    (3,)
    """
    path, wanted = Path(path), ",".join(COLUMNS)
    rows: list[list[float]] = []
    names: list[str] = []
    for i, line in enumerate(read_text(path, wanted).splitlines(), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        if names:
            rows.append(number_row(path, i, line, names))
            continue
        names = [name.strip() for name in line.split(",")]
        if sorted(names) != sorted(COLUMNS):
            raise ValueError(
                f"{path}, line {i}: the columns are {', '.join(names)}; name them {wanted}"
            )
    if not rows:
        raise ValueError(f"{path}: no rows of numbers under {wanted}")
    columns = dict(zip(names, np.array(rows).T, strict=True))
    try:
        return DropTest(columns["v"], columns["eps"], columns["eps_err"], onto_plate)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
