"""What the program says on stderr: one sentence for an error, one line for a warning."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from ciassd_jax.formats.errors import FormatWarning

Item = TypeVar("Item")


class UsageError(ValueError):
    """An option cannot be used; the message is one sentence that says what would be valid."""


@contextmanager
def warnings_as_lines(source: Path | str) -> Iterator[None]:
    """Show our own warnings as one line that names the input; leave all others as they are."""
    from tqdm.auto import tqdm

    from ciassd_jax.formats.errors import DroppedWarning

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
    """The items, with a progress bar where a terminal shows it."""
    from tqdm.auto import tqdm

    return tqdm(items, unit="frame", leave=False, disable=None)
