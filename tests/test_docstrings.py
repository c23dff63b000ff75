"""The examples of the public docstrings run, and the API pages are made from them."""

import doctest
import subprocess
import sys

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
    """What the first lines, in the docstring of the package, define."""
    return run(jaxgran.__doc__, {}, "jaxgran")


# Each compiles a fit of several curves, all rivals, or a run of spheres, for its example alone.
LONG = ("Diagnosis", "JointFit", "diagnose", "fit_jointly", "impact", "read_particles")
NAMES = [
    pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in jaxgran.__all__
]


@pytest.mark.parametrize("name", NAMES)
def test_public_docstring_has_an_example_that_runs(name, names, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(getattr(jaxgran, name).__doc__, dict(names), name)


def test_a_wrong_example_is_found():
    with pytest.raises(AssertionError, match="Got:"):
        run(">>> 1 + 1\n3\n", {}, "wrong")
    with pytest.raises(AssertionError, match="no example"):
        run("Nothing.", {}, "empty")


@pytest.mark.slow
def test_api_pages_are_made_without_a_warning(tmp_path):
    pytest.importorskip("pdoc")
    command = [sys.executable, "-W", "error", "-m", "pdoc", "-d", "google"]
    done = subprocess.run(
        [*command, "jaxgran", "-o", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Warn" not in done.stderr and "Warn" not in done.stdout, done.stderr
    page = (tmp_path / "jaxgran.html").read_text(encoding="utf-8")
    for name in jaxgran.__all__:
        assert f'id="{name}"' in page, f"{name} is not on the page"
