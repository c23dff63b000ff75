"""Which functions of jaxgran have their annotations checked while the tests run."""

from beartype import beartype

UNCHECKED = {
    "_utils.status": {"explain"},
    "data.curve_file": {
        "read_absent",
        "read_curve",
        "read_drop_test",
        "read_gas",
        "read_priors",
        "write_curve",
    },
    "data.particles": {"read_particles"},
    "fitting.diagnosis": {"diagnose", "log_likelihood"},
    "fitting.fit": {"_check_model", "_check_request", "fit", "free_by_default"},
    "fitting.learnt_law": {"restitution_band"},
    "fitting.residuals": {"check_curve"},
    "models.choose": {"choose_model"},
    "models.cool": {"cool"},
    "models.spheres": {"AbstractSpheres.sized_for"},
    "particles.observables": {"pair_correlation"},
    "sweep": {"sweep"},
}
"""Functions, by module, that check their arguments themselves and raise clearer errors."""


def check(function):
    """Let beartype check the annotations of a function, unless it is one of `UNCHECKED`."""
    module = function.__module__.removeprefix("jaxgran.")
    return function if function.__qualname__ in UNCHECKED.get(module, ()) else beartype(function)
