"""The examples of the public docstrings run."""

import doctest
from operator import attrgetter

import pytest

import jaxgran

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def run(text, names, title):
    """Run the examples of a docstring; AssertionError with doctest's report if one differs."""
    test = doctest.DocTestParser().get_doctest(text, names, title, title, 0)
    report = []
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    runner.run(test, out=report.append, clear_globs=False)
    assert runner.tries > 0, f"{title} has no example"
    assert runner.failures == 0, "".join(report)
    return test.globs


@pytest.fixture(scope="module")
def names():
    """Return the names that the first lines of the package docstring define."""
    return run(jaxgran.__doc__, {}, "jaxgran")


# Each compiles a fit of several curves, all alternatives, or a run of spheres.
LONG = (
    *("Choice", "DSMC", "Expected", "SteadyState", "explain_status", "impact"),
    *("imitate", "observables", "read_particles", "sweep"),
)
MINUTES = ("Imitation", "Plan", "log_likelihood", "plan")
MARKS = dict.fromkeys(LONG, pytest.mark.slow) | dict.fromkeys(MINUTES, pytest.mark.minutes)
NAMES = [pytest.param(x, marks=MARKS.get(x, ())) for x in jaxgran.__all__]
NAMES += [f"extend.{name}" for name in jaxgran.extend.__all__]


@pytest.mark.parametrize("name", NAMES)
def test_public_docstring_has_an_example_that_runs(name, names, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(attrgetter(name)(jaxgran).__doc__, dict(names), name)
