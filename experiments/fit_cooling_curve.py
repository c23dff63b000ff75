"""Which dissipative constant A made this gas cool as it did?

    python experiments/fit_cooling_curve.py [CURVE.csv] [--free A T0] [--set Y=6e7] [--out DIR]
        [--model soft-spheres [--particles N] [--replicas R]] [--model auto [--tolerance 0.02]]

CURVE.csv holds header lines `# key: value` (N, eta, diameter, density, Y, nu, T0; SI units), a line
of column names and rows: t,T and, where measured, T_err, msd, msd_err, T_rot, T_rot_err. Spheres
are smooth, far from walls and in vacuum unless header lines say otherwise: beta_t, reduced_inertia,
T_rot_0 of rough spheres; container_side, wall_restitution, wall_beta_t; gamma of drag. Lines
eta_err, diameter_err, density_err, Y_err, nu_err, T0_err are standard errors of these values, which
then enter the error of the estimate. A header line A is not used in the fit; the estimate is
compared with it. --model auto selects the fastest model whose estimated error, for the gas that
kinetic theory fits, is within the tolerance, and gives the reason. Prints a table and one line of
JSON, and writes a picture and a JSON file.
"""

import sys
from pathlib import Path

from jaxgran.cli.main import main as command
from jaxgran.data.example import EXAMPLE_FILES


def main() -> int:
    """Run `jaxgran fit` with the arguments of this script and a default curve."""
    words = sys.argv[1:]
    default = [] if any(Path(word).is_file() for word in words) else [str(EXAMPLE_FILES["dilute"])]
    return command(["fit", *default, *words])


if __name__ == "__main__":
    sys.exit(main())
