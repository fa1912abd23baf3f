"""What the program prints on stderr: one sentence for an error, one line for a warning, a progress bar."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from ciassd_jax.formats.errors import DroppedWarning, FormatWarning

Item = TypeVar("Item")
# How the library's messages name what the program has an option or a command for.
_OPTIONS = {
    "as `image_size` (width, height)": "with --image-size WIDTH HEIGHT",
    "`overwrite`": "--overwrite",
    "`write_synthetic`": "`ciassd data synth`",
}


class UsageError(ValueError):
    """An option cannot be used; the message is one sentence with the remedy."""


@contextmanager
def values_from_options() -> Iterator[None]:
    """Turn a ValueError into a UsageError: the refused values are those of the options."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def describe(error: Exception) -> str:
    """Return an error's sentence with the options of the program in place of the arguments of the library."""
    text = str(error)
    for argument, option in _OPTIONS.items():
        text = text.replace(argument, option)
    return text


@contextmanager
def silenced(*loggers: str) -> Iterator[None]:
    """Keep libraries from logging pages of traces where the package reports the failure in one sentence."""
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in loggers}
    for logger in levels:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


@contextmanager
def warnings_as_lines(source: Path | str) -> Iterator[None]:
    """Print the package's own warnings as one line that names the input; leave all others as they are."""
    from tqdm.auto import tqdm

    def show(message, category, *rest, **more):  # type: ignore[no-untyped-def]
        if issubclass(category, DroppedWarning | FormatWarning):
            named = message if issubclass(category, FormatWarning) else f"{source}: {message}"
            tqdm.write(f"warning: {named}", file=sys.stderr)
        else:
            before(message, category, *rest, **more)

    before = warnings.showwarning
    with warnings.catch_warnings():
        warnings.simplefilter("always", DroppedWarning)
        warnings.simplefilter("always", FormatWarning)
        warnings.showwarning = show
        yield


def frames_with_bar(items: Sequence[Item]) -> Iterable[Item]:
    """Return the items with a progress bar, which only a terminal shows."""
    from tqdm.auto import tqdm

    return tqdm(items, unit="frame", leave=False, disable=None)
