"""Scripts and examples run in this process, which shares compiled programs between them."""

import contextlib
import io
import runpy
import sys
import warnings
from unittest import mock

import jax
from matplotlib import pyplot


def run(path, *arguments, folder, warning="default"):
    """Run a script in a folder and return what it prints; AssertionError if it fails."""
    printed = io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(printed),
        mock.patch.object(sys, "argv", [str(path), *map(str, arguments)]),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter(warning)
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            assert not end.code
        finally:
            jax.config.update("jax_enable_x64", True)
            pyplot.close("all")
    return printed.getvalue()
