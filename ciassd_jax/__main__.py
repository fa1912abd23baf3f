"""`python -m ciassd_jax` is the program `ciassd`; it keeps compiled programs for its next run."""

import os
import sys

from ciassd_jax.cli import main
from ciassd_jax.inference.programs import keep_programs


def program() -> int:
    """Run `ciassd` with the compilation cache and return its exit code."""
    keep_programs()
    try:
        code = main()
    except KeyboardInterrupt:
        code = 130
    if code >= 128:
        # A signal ended the command. The compiler may still run in its thread; a normal exit would wait for it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(program())
