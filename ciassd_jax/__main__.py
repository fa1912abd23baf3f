"""`python -m ciassd_jax` is the program `ciassd`, which finds what it compiled in its next run again."""

import os
import sys
from pathlib import Path

import jax

from ciassd_jax.cli import main


def keep_programs() -> None:
    """Keep what is compiled in ~/.cache/ciassd_jax, so that the next process need not compile it.

    JAX_COMPILATION_CACHE_DIR moves it, JAX_ENABLE_COMPILATION_CACHE=false keeps none.
    """
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "ciassd_jax"))


def program() -> int:
    """Run the program."""
    keep_programs()
    return main()


if __name__ == "__main__":
    sys.exit(program())
