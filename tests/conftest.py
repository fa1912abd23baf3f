"""A strict climate: several CPU devices, no silent broadcasting, shapes checked by beartype."""

import atexit
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from xla_flags import xla_flags

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# A program compiled by one test serves the others, also in other workers and in processes that tests start.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="ciassd_jax_tests_")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"])

import jaxtyping

with jaxtyping.install_import_hook("ciassd_jax", "beartype.beartype"):
    import ciassd_jax  # noqa: F401

import jax
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")

SHARED = Path(__file__).parents[2] / "shared"


def pytest_configure(config: pytest.Config) -> None:
    """Set the compiler's flags; XLA reads them when the first program is compiled.

    The quick suite and the smoke test spend their time in the compiler, so they skip the costly passes. Any other
    selection of tests (`-m slow`, `-m reference`) runs the programs that users run.
    """
    level = 0 if config.option.markexpr in ("not slow", "smoke") else None
    os.environ.setdefault("XLA_FLAGS", xla_flags(devices=2, level=level))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the reference data; the test is skipped where it is missing."""
    if not SHARED.is_dir():
        pytest.skip(f"the reference data is not at {SHARED}")
    return SHARED


@pytest.fixture
def no_type_checks() -> Iterator[None]:
    """Switch off the type checker of the tests, which would refuse a value before the config does."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)
