"""Keys of the header of a file: which are known, and what some of them stand for."""

from jaxgran.scene.parameters import BY_SYMBOL

TRACK_KEYS = ("box_side", "frame_rate", "timestep", "localisation_error")
"""Header keys of tracks and trajectories."""

OPTIONAL_KEYS = (
    "N",
    "dimension",
    "replicas",
    "absent",
    "tracked",
    "T0_of",
    "T_scale_err",
    "errors",
    "onto",
    "eps_scatters",
    "spin_before",
    "T_from",
    "T_of",
    *TRACK_KEYS,
)
"""Further known header keys, neither of the gas nor of its elements."""

PROVENANCE_KEYS = ("units", "points", "end_tau", "melt_tau", "steps_per_contact", "source")
"""Keys that document the origin of a curve, and that no result depends on."""

PRIOR_KEYS = {f"{symbol}_err": p.name for symbol, p in BY_SYMBOL.items() if symbol != "A"}
"""Header keys of standard errors, and the names of their priors in `jaxgran.fit`."""

GUESS = "guess"

GUESSES = {
    "beta_t": 0.0,
    "friction": 0.3,
    "gamma": 0.0,
    "wall_restitution": 1.0,
    "wall_beta_t": 0.0,
}
"""Header keys whose value may be "guess", and the values from which a fit then starts."""

ABSENT = {
    "walls": ("container_side", "wall_restitution"),
    "roughness": ("beta_t",),
    "drag": ("gamma",),
    "friction": ("friction",),
}
"""Effects that the header key ``absent`` may name, and the keys that describe them."""

VISCOELASTIC_KEYS = ("Y", "nu", "A")
"""Header keys of the law of viscoelastic spheres, which eps replaces."""

ANY_GAS = {"eta": "0.1", "T0": "0.01"}
"""Header keys that single impacts do not depend on."""

_MIXTURE = (
    "grains of a mixture have a temperature for each kind, and one T is too few; diameters with a "
    "standard deviation of at most a fifth of their mean have the key diameter_sd"
)

_STICKING = "grains that stick lose all of their speed below some speed, and grow"

UNSUPPORTED_KEYS = {
    "gravity": (0.0, "under gravity density and T change with height, but gases are homogeneous"),
    "polydispersity": (
        0.0,
        "grains of unequal masses have unequal temperatures, and sizes have the key diameter_sd, "
        "the standard deviation of the diameters in m",
    ),
    "diameter_2": (None, _MIXTURE),
    "density_2": (None, _MIXTURE),
    "aspect_ratio": (1.0, "rods and ellipsoids collide at another rate and rotate"),
    "cohesion": (0.0, _STICKING),
    "surface_energy": (0.0, _STICKING),
    "charge": (0.0, "charged grains are deflected without touching, but grains fly freely"),
}
"""Keys of effects that no model has: the value that means "no effect" (or None), and the reason."""
