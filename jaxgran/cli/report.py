"""What the commands print."""

from typing import Any

import numpy as np

import jaxgran


def print_scene(options: Any, gas, curve, header, result) -> None:
    """The curve and the gas that was fitted to it."""
    T = np.asarray(curve.temperature)
    print(f"curve    {options.curve.name}: {T.size} points, t = 0 .. {curve.times[-1]:.3g} s,")
    print(f"         T falls to {T[-1] / T[0]:.3g} of its first value")
    if "T_from" in header:
        print(f"         {header['T_from']}")
    print(
        f"gas      phi = {float(gas.packing_fraction):.3g}, tau_c = "
        f"{float(gas.mean_free_time):.3g} s, t_c/tau_c = {float(gas.contact_fraction):.2g}, "
        f"beta_T0 = {float(result.gas.thermal_beta):.3g} (fitted)"
    )


def print_doubts(warned, unused: str | None) -> None:
    """Warnings of the input, and what of it was not used."""
    for doubt in [*(warning.message for warning in warned), *([unused] if unused else [])]:
        print(f"check    {doubt}")


def print_impacts(gas, last_T: float, num_particles: int | None) -> None:
    """What the fitted A means: eps at the rms impact speeds of the first and of the last T."""
    first, last = (float(gas.restitution(np.sqrt(2 * T))) for T in (gas.temperature, last_T))
    print(f"impacts  eps = {first:.3g} at the thermal speed of t = 0, {last:.3g} at the last one;")
    print(f"         mean free path {1e3 * float(gas.mean_free_path):.3g} mm", end="")
    if num_particles is not None:
        box = 1e3 * float(gas.box_side(num_particles))
        shape = "cube" if gas.dimension == 3 else "square"
        print(f", in a box of {box:.3g} mm if it is a {shape}", end="")
    print()
    if isinstance(gas.law, jaxgran.Viscoelastic):
        print("         A and Y enter as A Y^(2/5) where contacts are short: 10 % in Y is 4 % in A")


def print_model(name: str, result, reasons) -> None:
    """The model, its steps and why it was chosen."""
    steps = "simulations" if result.model.stochastic else "steps of least squares"
    print(f"model    {name}, {int(result.iterations)} {steps}")
    if reasons:
        print("chosen", "\n".join(f"         - {reason}" for reason in reasons).lstrip())


def print_rows(rows: list[dict]) -> None:
    """The table of estimates."""
    print(f"\n{'':10}{'estimate':>13} {'+-':>10} {'95 %, with rivals':>24}  header's")
    for row in rows:
        print(f"{row['parameter']:4}{row['unit']:6}", end="")
        if np.isnan(row["estimate"]):
            print(f"{'not determined':>13}")
            continue
        between = f"{row['low']:.3g} .. {row['high']:.3g}"
        between = "not looked for" if np.isnan(row["low"]) else between
        print(f"{row['estimate']:13.5g} {row['std_err']:10.2g} {between:>24}", end="")
        if row["header"]:
            print(f"  {row['header']:.5g} ({100 * (row['estimate'] / row['header'] - 1):+.2f} %)")
        else:
            print()


PARTS = {
    "measurement": "errors of the points, with the correlation of neighbours",
    "model": "the model's clock in this scene",
    "few particles": "chance of the collisions of N particles",
    "slope": "derivatives through particles: too large where the gas has a flow, or noisy",
    "simulation": "noise of the simulations that the fit made",
}
"""What a part of the error budget is; the others are named after what is uncertain."""


def print_budget(rows: list[dict], explain: bool) -> None:
    """The parts of each error, in per cent of the estimate, the largest first; of t0 in ms."""
    for row in rows:
        if np.isnan(row["estimate"]):
            continue
        parts = sorted(row["error_budget"].items(), key=lambda part: -part[1])
        is_time = row["parameter"] == "t0"  # which may be 0
        over, unit = (1e-3, "ms") if is_time else (abs(row["estimate"]) / 100, "%")
        shares = [(name, x / over) for name, x in parts if x > 0]
        if not explain:
            line = ", ".join(f"{name} {share:.2g} {unit}" for name, share in shares)
            print(f"error of {row['parameter']}: {line}")
            continue
        words = "ms" if is_time else "per cent"
        print(f"\nerror of {row['parameter']}, in {words}; the squares of the parts add up")
        for name, share in shares:
            print(f"  {share:8.2g}  {name}: {PARTS.get(name, 'its error as given, or as known')}")


def print_rivals(name: str, diagnosis) -> None:
    """The laws that were compared, how much better they fit, and what the first parameter is."""
    if not diagnosis.rivals:
        return
    width = max(len(rival.name) for rival in diagnosis.rivals)
    print(f"\n{'with, besides':{width}}  chi^2 less {name:>9} {'95 %':>20}  told apart")
    for rival in diagnosis.rivals:
        between = f"{rival.low[0]:.3g} .. {rival.high[0]:.3g}"
        told = "yes" if rival.told_apart else f"no: errors {rival.sharper:.2g} x smaller would"
        if not rival.told_apart and np.isfinite(rival.decades):
            told += f", or T followed to 1/{10**rival.decades:.2g} of its last"
        told = "the curve asks for it" if rival.asked else told
        print(f"{rival.name:{width}}  {rival.improvement:10.2g}", end="")
        print(f" {rival.estimate[0]:9.3g} {between:>20}  {told}")


def print_verdict(diagnosis) -> None:
    """What the fit is worth, and why."""
    print(f"\n{diagnosis.verdict}")
    for reason in diagnosis.reasons:
        print(f"  - {reason}")
