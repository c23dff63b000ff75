"""Options of the commands: their types, and what their values stand for."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter, Token

from jaxgran._utils.validation import POSITIVE
from jaxgran.data.header_keys import ABSENT, OPTIONAL_KEYS, PRIOR_KEYS
from jaxgran.data.units import UNIT_KEYS
from jaxgran.models.base import AbstractModel
from jaxgran.scene.parameters import BY_SYMBOL

ModelName = Literal["kinetic-theory", "dsmc", "hard-spheres", "soft-spheres"]
"""Models of `jaxgran cool`. The names are literals because making the models would start XLA before
a command has set its options (`jaxgran.cli.cache.use_compilation_cache`)."""

KINETIC_THEORY = "kinetic-theory"
"""The model that needs no number of particles, and fits several measurements."""

ModelOrAuto = Literal[ModelName, "auto"]
"""Models of `jaxgran fit`, which can also choose one."""

Several = Parameter(consume_multiple=True)
"""An option that takes one or more arguments."""

MAX_NUMBER = 2**63
"""Upper bound of whole numbers, as of the seeds of `jax.random.key`."""


def _whole_number(_: object, tokens: Sequence[Token]) -> int:
    """Return the whole number of an option, which may be written as 1e4."""
    text = tokens[0].value
    number = int(text) if text.lstrip("+-").isdigit() else float(text)
    if not (abs(number) < MAX_NUMBER and number == int(number)):
        raise ValueError(f"must be a whole number between -2^63 and 2^63, got {text}")
    return int(number)


WholeNumber = Annotated[int, Parameter(converter=_whole_number)]

if TYPE_CHECKING:
    FreeParameter = str
    Effect = str
else:
    FreeParameter = Literal[tuple(symbol for symbol in BY_SYMBOL if symbol != "density")]
    """Arguments of --free."""

    Effect = Literal[tuple(ABSENT)]
    """Arguments of --absent."""


@Parameter(name="*")
@dataclass(frozen=True)
class FitOptions:
    """Options of `jaxgran fit`.

    Attributes:
        drop_test: One or more CSV files with columns v,eps,eps_err, or of oblique impacts
            v_n,v_t,eps,eps_err,eps_t,eps_t_err: single impacts of the spheres of the first curve,
            fitted jointly with it; without a curve their own header gives diameter, density, Y and
            nu.
        impacts: Fit single impacts of the tracks of each curve, too.
        onto_plate: The impacts of the drop tests are on a thick plate of the same material.
        model: Model to use; auto takes the fastest one whose estimated error is within the
            tolerance.
        tolerance: Allowed relative error of T for the model auto.
        particles: Number of particles per replica (particle models only; default: N from the
            file).
        replicas: Number of replicas (particle models only).
        key: Seed of the random initial state (particle models only).
        free: Parameters to fit; by default A, and T0 if T has no errors.
        set: Header values KEY=VALUE that replace values of the file.
        out: Output folder; by default a new one in results.
        overwrite: Replace existing files in the output folder.
        absent: Effects that are known to be absent (walls, roughness, drag, friction), in addition
            to the header line `# absent: walls`.
        quick: Leave out the search of alternative explanations, which takes most of the time.
        imitate: Number of simulated runs of the fitted scene that are fitted, too, to count how
            often the range holds the true value; 0 for none.
        report: Write a web page with the result, its picture and tables, too; needs the extra
            `report`.
        explain: Print the error budget as a table that explains each part.
        no_cache: Disable the compilation cache (same as JAXGRAN_NO_CACHE=1).
    """

    drop_test: Annotated[tuple[Path, ...], Several] = ()
    impacts: bool = False
    onto_plate: bool = False
    model: ModelOrAuto = "kinetic-theory"
    tolerance: float = 0.02
    particles: WholeNumber | None = None
    replicas: WholeNumber = 3
    key: WholeNumber = 0
    free: Annotated[tuple[FreeParameter, ...], Several] = ()
    set: Annotated[tuple[str, ...], Several] = ()
    out: Path | None = None
    overwrite: bool = False
    absent: Annotated[tuple[Effect, ...], Several] = ()
    quick: bool = False
    imitate: WholeNumber = 0
    report: bool = False
    explain: bool = False
    no_cache: bool = False


def models_by_name(models: Sequence[AbstractModel]) -> dict[str, AbstractModel]:
    """Return models by their names on the command line, such as "soft-spheres"."""
    return {model.name.lower().replace(" ", "-"): model for model in models}


def check_tolerance(tolerance: float) -> None:
    """Raise ValueError unless a tolerance of --tolerance is positive."""
    POSITIVE.check("--tolerance", tolerance, "0.02 allows an error of T of 2 %.")


def parse_settings(pairs: Sequence[str]) -> dict[str, str]:
    """Return header entries from the arguments KEY=VALUE of --set."""
    known = (*BY_SYMBOL, *PRIOR_KEYS, *OPTIONAL_KEYS, *UNIT_KEYS)
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key not in known:
            raise ValueError(f"--set {pair}: give KEY=VALUE with KEY one of {', '.join(known)}")
        if key in values:
            raise ValueError(f"--set gives {key} twice, {values[key]} and {value}: remove one")
        values[key] = value
    return values
