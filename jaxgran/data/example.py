"""Two cooling curves, simulated in LAMMPS, that come with the package for a first fit."""

from pathlib import Path

from jaxgran.data.measurement import Measurement
from jaxgran.data.measurement_file import read_measurement

FOLDER = Path(__file__).parent

EXAMPLE_FILES = {
    "dilute": FOLDER / "lammps_cooling_dilute.csv",
    "dense": FOLDER / "lammps_cooling_dense.csv",
}
"""Curve files of the examples, by name."""


def example_measurement(name: str = "dilute") -> Measurement:
    """Return a cooling curve of viscoelastic spheres, to try jaxgran with.

    Both curves were simulated in LAMMPS (GRANULAR package, Hertz contact with viscoelastic damping,
    smooth spheres in a periodic box) and are means over three runs of N = 4000 spheres, with the
    standard error of T:

    - "dilute": packing fraction 0.05, diameter 2 mm, A = 3e-6 s, 61 times to 150 mean free times.
    - "dense": packing fraction 0.2, diameter 4 mm, A = 8e-5 s, 51 times to 60 mean free times. Its
      contacts last, and it clusters, so that kinetic theory does not hold.

    The header gives the A of the simulation, which a fit of A does not use.

    Args:
        name: "dilute" or "dense".

    Returns:
        The measurement: T in m^2/s^2 and <dr^2> in m^2 at times in s, with the gas.

    Raises:
        ValueError: if there is no example of this name.

    >>> measurement = jaxgran.example_measurement()
    >>> measurement.num_particles, measurement.curve.temperature.shape
    (4000, (61,))
    """
    if name not in EXAMPLE_FILES:
        names = " or ".join(f'"{known}"' for known in EXAMPLE_FILES)
        raise ValueError(f"name must be {names}, got {name!r}")
    return read_measurement(EXAMPLE_FILES[name])
