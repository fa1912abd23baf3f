"""The error for input that cannot be used, the warnings for input used in part, and reading of files."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Pathlike = str | os.PathLike[str]


class InputError(ValueError):
    """An input cannot be used; the message is one sentence that names it and the remedy."""


class _InputWarning(UserWarning):
    """A warning of an input, which may be named as its `source`.

    Warnings of the same `kind` have the same message but for numbers and `source`, which the message names.
    """

    def __init__(self, message: str, source: Pathlike = "") -> None:
        super().__init__(message)
        self.source = str(source)
        self.kind = re.sub(r"\d[\d.e+]*", "", message.replace(self.source, ""))


class FormatWarning(_InputWarning):
    """A file lacks something; the message names it and the substitute."""


class DroppedWarning(_InputWarning):
    """Part of the input was dropped; the message tells how much and why."""


# A variable of the context, because frames are also read in threads, where `warnings.catch_warnings` is not safe.
_COLLECTED: ContextVar[list[FormatWarning] | None] = ContextVar("collected", default=None)


def warn_of_file(message: str, source: Pathlike = "", *, stacklevel: int = 3) -> None:
    """Give a FormatWarning of the file `source`, or hand it to `collected_warnings`."""
    found, warning = _COLLECTED.get(), FormatWarning(message, source)
    if found is None:
        warnings.warn(warning, stacklevel=stacklevel)
    else:
        found.append(warning)


@contextmanager
def collected_warnings() -> Iterator[list[FormatWarning]]:
    """Collect the warnings of `warn_of_file` in a list instead of giving them."""
    found: list[FormatWarning] = []
    token = _COLLECTED.set(found)
    try:
        yield found
    finally:
        _COLLECTED.reset(token)


@contextmanager
def grouped_warnings() -> Iterator[None]:
    """Give the warnings of `warn_of_file` at the end, one of each kind, with the number of the others."""
    found: list[FormatWarning] = []
    try:
        with collected_warnings() as found:
            yield
    finally:
        give_grouped(found, stacklevel=4)


def give_grouped(found: Iterable[FormatWarning], *, stacklevel: int = 3) -> None:
    """Give the first warning of each kind, with the number of the others."""
    kinds: dict[str, list[FormatWarning]] = {}
    for one in found:
        kinds.setdefault(one.kind, []).append(one)
    for first, *others in kinds.values():
        more = f" Other frames with this problem: {len(others)}." if others else ""
        warn_of_file(f"{first}{more}", stacklevel=stacklevel + 1)


def read_bytes(path: Pathlike, limit: int = -1) -> bytes:
    """Read a file, or its first `limit` bytes.

    Raises InputError for a path that does not exist, is a directory or cannot be read.
    """
    try:
        with open(path, "rb") as stream:
            return stream.read(limit)
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; check the path.") from None
    except IsADirectoryError:
        raise InputError(f"{path} is a directory; name a file inside it.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check its permissions.") from error
