import subprocess
import sys


def test_import_is_light():
    # jax_md alone takes seconds; x64 is the caller's choice.
    code = (
        "import sys, jaxgran, jax; "
        "assert 'jax_md' not in sys.modules and 'matplotlib' not in sys.modules; "
        "assert not jax.config.jax_enable_x64"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
