"""Keys of the header of a file: which are known, and what some of them stand for."""

from typing import NamedTuple

from jaxgran.scene.parameters import BY_SYMBOL

TRACK_KEYS = ("box_side", "frame_rate", "timestep", "localisation_error")
"""Header keys of tracks and trajectories."""

CURVE_KEYS = (
    "N",
    "replicas",
    "absent",
    "tracked",
    "T0_of",
    "T_scale",
    "T_scale_err",
    "errors",
    "T_from",
    "T_of",
    *TRACK_KEYS,
)
"""Header keys that say how a cooling curve was measured. T is used as it is written: of T_scale,
the factor by which it was multiplied, only the error counts."""

DROP_TEST_KEYS = ("onto", "eps_scatters", "spin_before")
"""Header keys of drop tests."""

OPTIONAL_KEYS = ("dimension", *CURVE_KEYS, *DROP_TEST_KEYS)
"""Known header keys that are not parameters of a gas."""

PROVENANCE_KEYS = ("units", "points", "end_tau", "melt_tau", "steps_per_contact", "source")
"""Keys that document the origin of a curve, and that no result depends on."""

PRIOR_KEYS = {f"{symbol}_err": p.name for symbol, p in BY_SYMBOL.items() if symbol != "A"}
"""Header keys of standard errors, and the names of their priors in `jaxgran.fit`."""

GUESS = "guess"
"""Value of a header key for a parameter that is not known: a fit starts from `GUESSES`."""

GUESSES = {
    "beta_t": 0.0,
    "friction": 0.3,
    "gamma": 0.0,
    "wall_restitution": 1.0,
    "wall_beta_t": 0.0,
}
"""Header keys whose value may be `GUESS`, and the values from which a fit then starts."""

ABSENT = {
    "walls": ("container_side", "wall_restitution"),
    "roughness": ("beta_t", "tangential_damping"),
    "drag": ("gamma",),
    "friction": ("friction",),
}
"""Effects that the header key ``absent`` may name, and the keys that describe them."""

VISCOELASTIC_KEYS = ("Y", "nu", "A")
"""Header keys of the law of viscoelastic spheres, which eps replaces."""


class UnsupportedKey(NamedTuple):
    """A header key of an effect that no model has.

    Attributes:
        neutral: the value that means "no effect"; None if every value means one.
        reason: why no model has the effect.
    """

    neutral: float | None
    reason: str


_MIXTURE = (
    "grains of a mixture have a temperature for each kind, and one T is too few; diameters with a "
    "standard deviation of at most a fifth of their mean have the key diameter_sd"
)

_STICKING = "grains that stick lose all of their speed below some speed, and grow"

UNSUPPORTED_KEYS = {
    "gravity": UnsupportedKey(
        0.0, "under gravity density and T change with height, but gases are homogeneous"
    ),
    "polydispersity": UnsupportedKey(
        0.0,
        "grains of unequal masses have unequal temperatures, and sizes have the key diameter_sd, "
        "the standard deviation of the diameters in m",
    ),
    "diameter_2": UnsupportedKey(None, _MIXTURE),
    "density_2": UnsupportedKey(None, _MIXTURE),
    "aspect_ratio": UnsupportedKey(1.0, "rods and ellipsoids collide at another rate and rotate"),
    "cohesion": UnsupportedKey(0.0, _STICKING),
    "surface_energy": UnsupportedKey(0.0, _STICKING),
    "charge": UnsupportedKey(
        0.0, "charged grains are deflected without touching, but grains fly freely"
    ),
}
"""Keys of effects that no model has."""
