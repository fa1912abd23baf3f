"""The libraries of the extra `viz`, which a plain installation lacks."""

from __future__ import annotations

from importlib.util import find_spec


def require(purpose: str, *modules: str) -> None:
    """Raise ModuleNotFoundError, one sentence that names the extra, if one of the modules is not installed.

    `purpose` is a plural noun for what needs them.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(f"{purpose} need {' and '.join(missing)}; run `pip install 'ciassd_jax[viz]'`.")
