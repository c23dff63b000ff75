"""Which functions of jaxgran have their annotations checked while the tests run."""

from beartype import beartype

UNCHECKED = {
    "_utils.status": {"explain"},
    "_utils.validation": {"Domain.check", "checked_times", "float_array"},
    "data.curve_file": {"read_curve", "write_curve"},
    "data.drop_test": {"DropTest.__init__"},
    "data.measurement": {"Measurement.__init__"},
    "data.measurement_file": {"read_measurement"},
    "data.particle_file": {"read_particles"},
    "fitting.fit": {"fit"},
    "fitting.learnt_law": {"restitution_band"},
    "fitting.likelihood": {"log_likelihood"},
    "fitting.plan": {"plan"},
    "models.choose": {"choose_model"},
    "models.cool": {"cool"},
    "models.spheres": {"AbstractSpheres.sized_for"},
    "particles.observables": {"pair_correlation"},
    "particles.start": {"check_start"},
    "scene.gas": {"Gas.replace", "Gas.restitution", "_checked_law"},
    "scene.geometry": {"sphere_mass"},
    "scene.walls": {"_wall_law"},
    "sweeps": {"sweep"},
}
"""Functions, by module, that check their arguments themselves and raise clearer errors."""


def check(function):
    """Let beartype check the annotations of a function, unless it checks its arguments itself.

    That is what those of `UNCHECKED` do, and the constructors of scenes and models.
    """
    module, name = function.__module__.removeprefix("jaxgran."), function.__qualname__
    is_public = name.endswith(".__init__") and module.startswith(("scene.", "models."))
    return function if is_public or name in UNCHECKED.get(module, ()) else beartype(function)
