"""Curve files as people write them: read as meant, or refused with the line and a way out."""

import codecs
import gzip
import io
import os
import threading
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pytest import approx

import jaxgran
from jaxgran import read_curve, read_measurement, write_curve
from jaxgran.data import files
from jaxgran.data.measurement_header import absent_of_header, priors_of_header
from tests.data.curve_files import (
    CURVE,
    GAS,
    HEAD,
    IN_MM,
    KEYS,
    PLAIN,
    SEMICOLONS,
    SPEED_XY,
    TIMES,
    T,
    assert_plain,
    gas_of,
    header_of,
    said,
    text_of,
)


def with_decimal_comma(text):
    return "\n".join(line if ":" in line else line.replace(".", ",") for line in text.split("\n"))


ENERGY = "t,energy\n0,4\n1,2\n2,1\n"

READ = {
    "decimal commas in the header": SEMICOLONS.replace(".", ","),
    "D exponents": PLAIN.replace("e-05", "D-05").replace("2e7", "2D7"),
    "an index": text_of(",t,T,T_err", (np.arange(40), TIMES, T, 0.01 * T)),
    "equals signs": PLAIN.replace(": ", " = "),
    "UTF-16, big end first": codecs.BOM_UTF16_BE + PLAIN.encode("utf-16-be"),
    "two comments alike": f"# measured at: noon\n# measured at: night\n{PLAIN}",
    "units behind bars": PLAIN.replace("t,T,T_err", "t / s,T / (m^2/s^2),T_err"),
    "words": PLAIN.replace("t,T,T_err", "Time,Temperature,temperature_error"),
    "ms and mm": IN_MM.replace("t,T,", "t (ms),T (mm^2/s^2),"),
    "a unit of a value": text_of(diameter="3 mm", density="1.2 g/cm^3", Y="20 MPa"),
    "per cent": text_of(eta="4 %"),
    "a late clock, told": text_of("t,T", (TIMES + 1000, T), t0=1000, t0_err=1),
    "projected speeds": text_of("t,mean_speed_xy", (TIMES, SPEED_XY)),
    "v^2": text_of("t,v2", (TIMES, 3 * T)),
    "the energy of all": text_of("t,total_energy", (TIMES, 3000 * float(GAS.mass) * T)),
    "errors in per cent": text_of("t,T,T_err (%)", (TIMES, T, np.ones(40)), eta_err="5 %"),
    "values with errors": text_of(eta="0.040 ± 0.002", diameter="3.00(5) mm", Y="20 +/- 1 MPa"),
    "values with errors in brackets": text_of(Y="(20 +- 1) MPa", T0="200(5) cm^2/s^2"),
    "units without blanks, phi": text_of(eta=None, phi=".04", diameter="3mm"),
    "comments of %": PLAIN.replace("# ", "% "),
    "a row of units": PLAIN.replace("t,T,T_err\n", "t,T,T_err\n(s),(m^2/s^2),(m^2/s^2)\n"),
    "speeds in mm/s, T0 too": "# time_unit: ms\n# speed_unit: mm/s\n"
    + text_of("t,T", (1e3 * TIMES, 1e6 * T), T0=2e4),
}
"""Files that are read as the plain one, without a question."""

REFUSED = {
    "the file is empty": "",
    "binary.*; give a CSV": b"\x89PNG\r\n\x1a\n\x00\x00\xff\xfe",
    "not a text file but a binary one": PLAIN.encode("utf-16-le"),
    "between commas, got .*semicolon": with_decimal_comma(PLAIN),
    "line 12: '1,000' has a comma.*thousands": text_of(row='"1,000",0.01,0.001'),
    "'0,02' has a comma, and '0.019": SEMICOLONS.replace("0.02;", "0,02;"),
    "line 8: numbers without names": PLAIN.replace("t,T,T_err\n", ""),
    "line 8: .*without columns; .*t,T": HEAD,
    "line 12: expected 3 finite numbers": text_of(row="0.1,,0.0002"),
    "line 12: expected 3 .* between commas": text_of(row="0.1,0.01,0.0002,5"),
    "line 10: expected 2 finite numbers .* got '1,x'": f"{HEAD}t,T\n0,1\n1,x\n2,.1\n3,.05\n",
    "line 10: expected 2 finite .* got '1'": f"{HEAD}t,T\n0,1\n1\n2,.1\n3,.05\n",
    "line 3: eta is given again": f"# eta: 0.05\n{PLAIN}",
    # Names and units.
    "missing: T; name them t,T": "t,T_err\n1,2\n",
    "missing: t; not known: when": "when,T\n1,2\n",
    "missing: T; not known: speed; .* there may be vx2, v2_xy, v2, energy": "t,speed\n1,2\n",
    "missing: T; not known: vx2_err": "t,vx2_err\n1,2\n",
    "no rows follow the names": "t,T\n",
    "T_err is a part of T, .*name it after its column": "t,v2,T_err (%)\n0,1,1\n1,.5,1\n2,.3,1\n",
    "v2_err and T_err each|T_err and v2_err each": "t,v2,T_err,v2_err\n0,1,1,1\n",
    "each once": "t,T,T\n1,2,3\n",
    "T and vx2 .*; keep one": "t,T,vx2\n1,2,3\n",
    "column energy .*add diameter and density": ENERGY,
    "column T: 'K' .*m.2/s.2": PLAIN.replace("T,", "T (K),"),
    "column t: 'px' .*unit of s.* metres of one pixel": PLAIN.replace("t,T", "t (px),T"),
    "length_unit: 's' .*unit of m; write a unit": f"# length_unit: s\n{PLAIN}",
    "header line N: 'many'": text_of(N="many"),
    "header line replicas: .*whole number": text_of(N=10, replicas=1.5),
    # Values.
    "line 4: t is 1 after 1; .*sort the rows": "t,T\n0,1\n1,.5\n1,.3\n",
    "line 2: t is -1, .*positive": "t,T\n-1,1\n2,.5\n3,.3\n",
    "line 1 begins with '!'.* begin with # or %": PLAIN.replace("# ", "! "),
    "errors into a column": text_of(row="0.04,0.019 ± 0.001,1e-4"),
    "eta: '0.04.* gives eta_err again": text_of(eta="0.04 ± 0.01", eta_err="0.02"),
    "header line eta: '_0e-2' is not known": text_of(eta="1_0e-2"),
    "'m..9..9..9' .*unit of m": text_of(diameter="2 m**9**9**9"),
    "field larger than field limit": text_of(row="x" * 200_000),
    "line 3: T is 0, .*positive": "t,T\n0,1\n1,0\n2,.3\n",
    "line 3: T_err is 0": "t,T,T_err\n0,1,0\n1,.5,0\n2,.3,.1\n",
    "line 3: msd is -1": "t,T,msd\n0,1,0\n1,.5,-1\n2,.3,.1\n",
    "line 3: mean_speed is -1, .*positive": "t,mean_speed\n0,1\n1,-1\n2,1\n",
    "at least 3 points, got 2": "t,T\n0,1\n1,.5\n",
}
"""What is said of a file that is refused, and the file."""


@pytest.mark.parametrize("name", READ)
def test_files_are_read(name, write):
    curve, gas, words = said(write(READ[name]))
    assert words == ""
    assert_plain(curve, gas)
    first = 1000.02 if name == "a late clock, told" else 0.02
    np.testing.assert_allclose(curve.times[0], first, rtol=1e-9)


@pytest.mark.parametrize("words", REFUSED)
def test_files_are_refused(words, read):
    with pytest.raises(ValueError, match=f"(?s)curve.csv.*{words}"):
        read(REFUSED[words])


ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "latin-1", "utf-32")
LENGTHS, DURATIONS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}, {"s": 1.0, "ms": 1e-3, "min": 60.0}


@given(
    separator=st.sampled_from([",", ";", "\t", " ", "|"]),
    told_to_the_command=st.booleans(),
    error=st.sampled_from(["0.002", "5 %", "±", "in brackets"]),
    percent=st.booleans(),
    encoding=st.sampled_from(ENCODINGS),
    order=st.permutations(["t", "T", "T_err", "msd"]),
    length=st.sampled_from(list(LENGTHS)),
    duration=st.sampled_from(list(DURATIONS)),
    told=st.sampled_from(["header", "names", "slashes"]),
    comma=st.booleans(),
    quotes=st.booleans(),
    ends=st.sampled_from(["\n", "\r\n", "\r"]),
)
@settings(max_examples=100, deadline=None)
def test_a_file_gives_the_plain_curve_or_an_error(
    write,
    separator,
    told_to_the_command,
    error,
    percent,
    encoding,
    order,
    length,
    duration,
    told,
    comma,
    quotes,
    ends,
):
    L, s = LENGTHS[length], DURATIONS[duration]
    values = {"t": TIMES / s, "T": T / (L / s) ** 2, "T_err": 0.01 * T / (L / s) ** 2}
    values["msd"] = 1e-4 * TIMES / L**2
    units = {"t": duration, "T": f"{length}^2/{duration}^2", "msd": f"{length}^2"}
    units["T_err"] = units["T"]
    form = {"header": "{0}", "names": "{0} [{1}]", "slashes": "{0} / ({1})"}[told]
    if told == "slashes" and separator == " ":
        form = "{0}({1})"
    if percent:
        values["T_err"] = np.ones_like(T)
        units["T_err"] = "%"
    if percent and told == "header":
        order = ["T_err (%)" if name == "T_err" else name for name in order]
        values["T_err (%)"], units["T_err (%)"] = values["T_err"], ""
    lines = ["# die größe: ä"]
    keys = dict(KEYS)
    both = {"±": "0.040 ± 0.002", "in brackets": "0.040(2)"}
    keys |= {"eta": both[error]} if error in both else {"eta_err": error}
    if told == "header":
        lines += [f"# length_unit: {length}", f"# time_unit: {duration}"]
        keys |= {"diameter": 0.003 / L, "T0": 0.02 / (L / s) ** 2}
    head = {key: str(value) for key, value in keys.items()}
    if not told_to_the_command:
        lines += [f"# {key}: {value}" for key, value in head.items()]
        head = {}
    mark = '"' if quotes and separator != " " else ""
    lines.append(separator.join(mark + form.format(n, units[n]) + mark for n in order))
    rows = zip(*(values[name] for name in order), strict=True)
    cells = [[f"{mark}{x:.17g}{mark}" for x in row] for row in rows]
    if comma:
        cells = [[cell.replace(".", ",") for cell in row] for row in cells]
    lines += [separator.join(row) for row in cells]
    content = (ends.join(lines) + ends).encode(encoding)
    if comma and separator == ",":
        with pytest.raises(ValueError, match="(?s)curve.csv.*line .*comma"):
            read_curve(write(content))
        return
    curve, gas, words = said(write(content), head)
    assert words == ""
    assert_plain(curve, gas, rtol=1e-12)
    assert read_measurement(write(content), head).priors["packing_fraction"][1] == approx(0.002)
    np.testing.assert_allclose(curve.times, TIMES, rtol=1e-12)
    np.testing.assert_allclose(curve.temperature_error, 0.01 * T, rtol=1e-12)
    np.testing.assert_allclose(curve.displacement, 1e-4 * TIMES, rtol=1e-12)


def test_drop_tests_are_read_like_curves(tmp_path):
    def drops_of(text):
        (tmp_path / "drops.csv").write_text(text)
        drops = read_measurement(tmp_path / "drops.csv", gas=GAS).data
        assert isinstance(drops, jaxgran.DropTest)
        return drops

    plain = drops_of("v,eps,eps_err\n0.1,0.92,0.01\n0.3,0.9,0.01\n")
    for text in (
        "# speed_unit: cm/s\n# length_unit: cm\nv,eps,eps_err\n10,0.92,0.01\n30,0.9,0.01\n",
        "# length_unit: cm\nv;eps;eps_err\n10;0,92;0,01\n30;0,90;0,01\n",
        "eps\teps_err\tv (mm/s)\n0.92\t0.01\t100\n0.9\t0.01\t300\n",
        "eps (%),eps_err (%),v\n92,1,0.1\n90,1,0.3\n",
    ):
        drops = drops_of(text)
        for name in ("speed", "restitution", "error"):
            np.testing.assert_allclose(getattr(drops, name), getattr(plain, name), rtol=1e-12)
    above = drops_of("v,eps,eps_err\n0.02,1.01,0.02\n0.1,0.92,0.01\n")
    assert np.max(above.restitution) == 1.01  # within its error
    for text, message in (
        ("v,eps,eps_err\n0.02,1.2,0.02\n", "at most 1 .*got 1.2 .- 0.02"),
        ("v,eps\n1,2\n", "line 1: .*v, eps; .*v,eps,eps_err"),
        ("v,eps,eps_err\n0.1,0.9\n", "line 2: expected 3 finite numbers .*, got '0.1,0.9'"),
        ("v,eps,eps_err\n", "line 1: no rows follow"),
        ("v,eps,eps_err\n0.1,0.9,0\n", "error must lie in"),
    ):
        with pytest.raises(ValueError, match=message):
            drops_of(text)


NO_COUNTS = ("0", "-5", "3.5", "many", "inf", "nan")
CALLS = [
    (lambda: read_curve(None), "path must .*got None"),
    (lambda: read_curve("none.csv"), "no such file"),
    (lambda: read_curve("."), "not a text file"),
    (lambda: read_measurement(None), "path must .*got None"),
    (lambda: read_measurement("a.csv", 3), "header must be a dictionary"),
    (lambda: read_measurement("a.csv", {"eta": None}), "header must be a dictionary"),
    (lambda: gas_of(Y=None, T0=None), "the header lacks Y, T0"),
    (lambda: gas_of(Y="soft"), "header line Y: 'soft'"),
    (lambda: gas_of(Y="guess"), "header line Y: 'guess'"),
    (lambda: gas_of(Y=-1), "youngs_modulus must lie in"),
    (lambda: gas_of(eta=0.9), "packing_fraction must lie in"),
    (lambda: gas_of(dimension=4), "dimension must be 2 or 3"),
    (lambda: gas_of(dimension=2.9), "dimension: .*got '2.9'"),
    (lambda: gas_of(reduced_inertia=0.4), "reduced_inertia without beta_t.*# beta_t: guess"),
    # elements, and what no gas here has
    (lambda: gas_of(T_rot_0=1), "T_rot_0 without beta_t"),
    (lambda: gas_of(container_side=0.05), "container_side without wall_restitution"),
    (lambda: gas_of(friction=0.5), "friction without tangential_damping"),
    (
        lambda: gas_of(friction=0.3, tangential_damping=0.5, beta_t=0),
        "both beta_t .* and tangential_damping.*SoftSpheres",
    ),
    (lambda: gas_of(friction=-1, tangential_damping=0.5), r"friction must lie in \[0, inf\)"),
    (lambda: gas_of(gravity=9.81), "gravity: .*density and T change with height"),
    (lambda: gas_of(diameter_2=0.004), "diameter_2: .*a temperature for each kind"),
    (lambda: gas_of(polydispersity=0.1), "polydispersity: .*unequal temperatures"),
    (lambda: gas_of(aspect_ratio=3), "aspect_ratio: .*rods and ellipsoids"),
    (lambda: gas_of(cohesion=1e-6), "cohesion: .*stick"),
    (lambda: gas_of(charge=1e-12), "charge: .*deflected without touching"),
    (
        lambda: gas_of(wall_restitution=0.9, container_side=0.07),
        "N, eta and container_side.*eta = 0.0824",
    ),
    # other headers and files
    (lambda: priors_of_header({"eta_err": "0.01"}), "eta_err without eta"),
    (lambda: priors_of_header({"eta": "1", "eta_err": "-1"}), "eta_err: .*positive"),
    (lambda: priors_of_header({"eta": "0.05", "eta_err": "some"}), "not a finite number"),
    (
        lambda: priors_of_header({"diameter": "1", "diameter_err": "1"}),
        "diameter_err without density",
    ),
    (lambda: write_curve("a.csv", CURVE, None), "header must be a dictionary"),
    (lambda: write_curve("a.csv", None, {}), "curve must be a jaxgran.CoolingCurve"),
    (lambda: write_curve("a.csv", CURVE, {"n": "a\n#A: 9"}), "'n': .*one line"),
    (lambda: write_curve("a.csv", CURVE, {"a: eta": "9"}), "without : and ="),
    (lambda: write_curve("a.csv", CURVE, {"note": "ends in ;"}), "must not end in"),
    (lambda: write_curve("a.csv", CURVE, {"diameter": "2 s"}), "not known as a unit of m"),
    (lambda: write_curve("a.csv", CURVE, {}, overwrite=1), "overwrite must be True"),
    (lambda: jaxgran.CoolingCurve(TIMES, np.ma.masked_less(T, 0.01)), "masked"),
    (lambda: read_measurement("none.csv"), "no such file"),
    (lambda: jaxgran.DropTest([0.1, 0.2], [0.9], [0.01]), "lists of equal length"),
    (lambda: absent_of_header({"absent": "gravity"}), "'gravity' .*; give"),
    (
        lambda: absent_of_header({"absent": "walls", "container_side": "1"}),
        "walls absent .*container_side",
    ),
    *((lambda n=n: gas_of(dimension=n), "header line dimension") for n in NO_COUNTS),
]


@pytest.mark.parametrize("call, words", CALLS)
def test_calls_that_are_wrong_say_what_is_wanted(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_sizes_are_bounded_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MAX_BYTES", 10**6)
    (tmp_path / "large.csv.gz").write_bytes(gzip.compress(bytes(10**7)))
    with pytest.raises(ValueError, match="more than 1e.06 bytes"):
        read_curve(tmp_path / "large.csv.gz")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    )
    with zipfile.ZipFile(tmp_path / "large.npz", "w") as archive:
        archive.writestr("times.npy", header.getvalue())
    with pytest.raises(ValueError, match="times.npy is shorter"):
        read_curve(tmp_path / "large.npz")


def test_a_pipe_is_read_once(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_text, args=(PLAIN,))
    writer.start()
    curve, gas, words = said(pipe)
    writer.join()
    assert words == ""
    assert_plain(curve, gas)


def test_tables_of_energies_are_curves(write):
    names = "time gravitEnergy traKineticEnergy elasticEnergy"
    energy = 3000 * float(GAS.mass) * T
    rows = "".join(f"{t:12.8g} 0 {E:12.9g} 0\n" for t, E in zip(TIMES, energy, strict=True))
    measurement = read_measurement(write(f"{names}\n{rows}"), header_of())
    np.testing.assert_allclose(measurement.curve.temperature, T, rtol=1e-7)


def test_a_curve_is_written_as_what_its_name_says():
    with pytest.raises(ValueError, match="c.foo: .*.npz .*.csv"):
        write_curve("c.foo", CURVE, {})


def test_values_below_zero_need_errors(write):
    below = np.where(TIMES > 30, -T, T)
    with pytest.raises(ValueError, match="line .*give T_err"):
        read_measurement(write(text_of("t,T", (TIMES, below))))
    for name, factor in (("T", 1.0), ("v2", 3.0)):
        columns = (TIMES, factor * below, factor * (0.01 * T + 1e-4))
        measurement = read_measurement(write(text_of(f"t,{name},{name}_err", columns)))
        np.testing.assert_allclose(measurement.curve.temperature, below, rtol=1e-7)
