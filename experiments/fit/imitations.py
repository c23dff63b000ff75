"""Does an imitation state the coverage that experiments have?

    python experiments/fit/imitations.py [--runs 100] [--rows "smooth|walls"] [--record] [--out DIR]

The scenes of `plan.py`: single runs by hard spheres, with noise of the measurement, each fitted
with the range over all alternatives. The fit of the first run is imitated (`jaxgran.imitate`). In
a further row the grains are rough, T_rot is not measured, and no fit knows of the roughness. Finds
for each

- held: hard-sphere runs whose range contains the true A;
- imitated: imitations of the first run whose range contains their true A;
- strongest: the same with the strongest alternative as the truth, and its name; `alone`:
  imitations of it whose error "assuming no other effect" contains it.

With --rows scenes whose name matches a regular expression are computed again.
"""

import dataclasses
import re
import time

import numpy as np

import jaxgran
from experiments.fit.plan import SCENES, Scene, planned, runs_of
from experiments.fit.wrong_physics import NUM_PARTICLES, beads
from experiments.support.analysis import fit_quietly
from experiments.support.record import Options, collected, each_alone, figures, run_parts

FREE = ("dissipative_constant",)
UNTOLD = Scene("rough, untold", beads(surface=jaxgran.Rough(-0.3)), {}, NUM_PARTICLES)


def compared(number: int, runs: int) -> dict:
    """Return the coverage of hard-sphere runs of a scene, and that which an imitation states."""
    scene = (*SCENES, UNTOLD)[number]
    measured = runs_of(planned(scene), runs, seed=0)
    true_A = float(scene.gas.value("dissipative_constant"))
    if scene is UNTOLD:
        smooth = dataclasses.replace(scene.gas, surface=None)
        measured = [dataclasses.replace(m, gas=smooth) for m in measured]
    fits = [fit_quietly(m, free=FREE) for m in measured]
    ends = [f.ranges.get(*FREE, (np.nan, np.nan)) for f in fits]
    low, high = np.array([[float(np.squeeze(x)) for x in pair] for pair in ends]).T
    begin = time.perf_counter()
    imitation = jaxgran.imitate(fits[0], runs=runs, progress=False)
    seconds = time.perf_counter() - begin
    found = {
        "name": scene.name,
        "runs": runs,
        "held": int(np.sum((low <= true_A) & (true_A <= high))),
        "imitated": imitation.held,
        "alone": imitation.held_alone,
        "seconds": seconds,
    }
    strongest = imitation.strongest
    if strongest is not None:
        found["strongest"] = {
            "name": strongest.truth,
            "held": strongest.held,
            "alone": strongest.held_alone,
        }
    return found


def imitations(options: Options) -> dict:
    """Compare the scenes, each in a process of its own."""
    known = figures("imitations", {"scenes": []})["scenes"] if options.rows else []
    scenes = {found["name"]: found for found in known}
    names = [scene.name for scene in (*SCENES, UNTOLD)]
    asked = [(k, options.runs) for k, name in enumerate(names) if re.search(options.rows, name)]
    for found in collected(each_alone(compared, asked)):
        scenes[found["name"]] = found
    found = [scenes[name] for name in names if name in scenes]
    differences = [abs(x["held"] - x["imitated"]) / x["runs"] for x in found]
    return {"scenes": found, "largest_difference": max(differences)}


if __name__ == "__main__":
    run_parts(__doc__, imitations, smoke=False, runs=100, rows="")
