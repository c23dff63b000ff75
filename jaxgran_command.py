"""The command `jaxgran`, outside of the package, whose import takes seconds."""

import gc
import signal


def main() -> int:
    """Run `jaxgran.cli.main.main`; Ctrl-C before it begins ends the process without a traceback.

    Tracing makes many objects that stay. They are seldom searched for garbage, and not at the end,
    which takes a second less.
    """
    gc.set_threshold(1_000_000)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from jaxgran.cli.main import main as run

    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return run()
    finally:
        gc.freeze()
