"""`python -m ciassd_jax` is the program `ciassd`; it keeps compiled programs for its next run."""

import os
import signal
import sys
import threading
from typing import Any

from ciassd_jax.cli import main
from ciassd_jax.inference.programs import keep_programs


def program() -> int:
    """Run `ciassd` with the compilation cache and return its exit code."""
    keep_programs()
    sys.unraisablehook = _interrupt_again
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


def _interrupt_again(ignored: Any) -> None:
    """Repeat a Ctrl-C that Python ignores because it fell into a callback, such as JAX's of garbage collection."""
    if ignored.exc_type is KeyboardInterrupt:
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(ignored)


if __name__ == "__main__":
    sys.exit(program())
