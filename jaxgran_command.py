"""The command `jaxgran`, outside of the package, whose import takes seconds."""

import signal


def main() -> int:
    """Run `jaxgran.cli.main.main`; Ctrl-C before it begins ends the process without a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from jaxgran.cli.main import main as run

    signal.signal(signal.SIGINT, signal.default_int_handler)
    return run()
