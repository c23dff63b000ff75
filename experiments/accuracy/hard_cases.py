"""How does jaxgran behave in limits in which simulations of granular gases often fail?

    python experiments/accuracy/hard_cases.py [--only WORDS ...] [--heavy] [--smoke] [--out DIR]

Runs the cases of `support/hard_cases/`: `impacts.py`, `gases.py` and `runs.py`. Prints one table
with the case, failures of other codes, the behaviour of jaxgran, and for every model and precision
the error of a value and of a derivative with the largest error allowed, and the status. Each case
gives the reason for its tolerances. Writes the table in Markdown and as JSON after every case, and
keeps cases of older files that are not run again. The exit status is 1 if a row fails.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import jax

from experiments.support.hard_cases.gases import GASES
from experiments.support.hard_cases.impacts import IMPACTS
from experiments.support.hard_cases.rows import Row
from experiments.support.hard_cases.runs import RUNS
from experiments.support.record import add_recording, save, write_results
from jaxgran.data.files import write_atomically

CASES = [*IMPACTS, *GASES, *RUNS]
SMOKE = "order flips"
NUMBERS = ("error", "allowed", "slope_error", "slope_allowed")

COLUMNS = (
    "case",
    "failures of other codes",
    "behaviour of jaxgran",
    "model",
    "precision",
    "error of value",
    "error of derivative",
    "status",
)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="*", default=[""], help="cases whose name contains any")
    parser.add_argument("--heavy", action="store_true", help="also the cases that take minutes")
    parser.add_argument("--smoke", action="store_true", help="one case, which takes seconds")
    parser.add_argument("--out", type=Path, default=Path("results/hard_cases"))
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    only = [SMOKE] if options.smoke else options.only
    asked = [c for c in CASES if any(words in c.name for words in only)]
    cases = [c for c in asked if options.heavy or not c.heavy]
    if not cases:
        parser.error(
            f"no case's name contains {only!r}; the cases: {', '.join(c.name for c in CASES)}"
        )
    record = options.out / "hard_cases.json"
    kept = json.loads(record.read_text(encoding="utf-8"))["cases"] if record.exists() else []
    records = {case["case"]: case for case in kept}
    failed = 0
    for case in cases:
        print(f"{case.name}\n    elsewhere: {case.elsewhere}\n    jaxgran: {case.here}", flush=True)
        begin = time.perf_counter()
        try:
            rows = case.run()
        except Exception as error:  # fails this case; the others still run
            words = " ".join(str(error).split())[:200]
            rows = [Row(type(error).__name__, "", float("inf"), 0.0, status=words)]
        seconds = round(time.perf_counter() - begin, 1)
        # Otherwise the compiled code of all cases exceeds the number of memory maps allowed.
        jax.clear_caches()
        for row in rows:
            words = f"{row.model}, {row.precision}"
            print(f"    {words:50} {_error(row):22} {_slope(row):22} {_status(row)}", flush=True)
        failed += sum(not row.passed for row in rows)
        described = {"case": case.name, "elsewhere": case.elsewhere, "here": case.here}
        each = [_plain(row) for row in rows]
        records[case.name] = described | {"seconds": seconds, "rows": each}
        in_order = [records[c.name] for c in CASES if c.name in records]
        save(record, cases=in_order)
        text = table(in_order)
        write_atomically(options.out / "hard_cases.md", lambda f, text=text: f.write(text.encode()))
    write_results("hard_cases", options, None, cases=[records[c.name] for c in cases])
    print(f"\n{failed} rows failed; {options.out}")
    return int(failed > 0)


def _plain(row: Row) -> dict:
    numbers = {k: None if v is None else float(v) for k, v in row._asdict().items() if k in NUMBERS}
    return row._asdict() | numbers


def table(records: list[dict]) -> str:
    """Return the table of hard_cases.md, from the recorded cases."""
    lines = [_cells(COLUMNS), _cells(["---"] * len(COLUMNS))]
    for record in records:
        described = [record[name] for name in ("case", "elsewhere", "here")]
        for row in (Row(**row) for row in record["rows"]):
            cells = [*described, row.model, row.precision, _error(row), _slope(row), _status(row)]
            lines.append(_cells(c.replace("|", "/").replace("<=", "≤") for c in cells))
            described = ["", "", ""]
    return "".join(lines)


def _error(row: Row) -> str:
    return f"{float(row.error):.1e} <= {row.allowed:.2g}"


def _slope(row: Row) -> str:
    if row.slope_error is None:
        return ""
    if not row.slope_allowed:
        return "finite" if row.slope_error == 0 else "not finite"
    return f"{float(row.slope_error):.1e} <= {row.slope_allowed:.2g}"


def _status(row: Row) -> str:
    words = row.status if len(row.status) < 90 else row.status[:87] + "..."
    return words if row.passed else f"FAILED: {words}"


def _cells(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |\n"


if __name__ == "__main__":
    sys.exit(main())
