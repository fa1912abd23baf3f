"""The error for input that cannot be used, the warnings for input used in part, and reading of files."""

from __future__ import annotations

import os

Pathlike = str | os.PathLike[str]


class InputError(ValueError):
    """An input cannot be used; the message is one sentence that names it and the remedy."""


class FormatWarning(UserWarning):
    """A file lacks something; the message names it and the substitute."""


class DroppedWarning(UserWarning):
    """Part of the input was dropped; the message tells how much and why."""


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
