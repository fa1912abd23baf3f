"""`python -m ciassd_jax` is the program `ciassd`; it keeps compiled programs for its next run."""

import os
import sys
from pathlib import Path

import jax

from ciassd_jax.cli import main


def keep_programs() -> None:
    """Use a persistent compilation cache, ~/.cache/ciassd_jax, so that later runs skip the compilation.

    JAX_COMPILATION_CACHE_DIR sets another folder; JAX_ENABLE_COMPILATION_CACHE=false disables the cache.
    """
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "ciassd_jax"))


def program() -> int:
    """Run `ciassd` with the compilation cache and return its exit code."""
    keep_programs()
    return main()


if __name__ == "__main__":
    sys.exit(program())
