"""Writing of files, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ciassd_jax.formats.errors import InputError, Pathlike


def check_folder(folder: Pathlike) -> None:
    """Raise InputError unless files can be written in `folder`, which may not exist yet; creates nothing."""
    path = Path(folder).absolute()
    existing = next(p for p in (path, *path.parents) if os.path.lexists(p))
    if not existing.is_dir():
        raise InputError(f"{folder} cannot be a folder, as {existing} is a file; choose another place.")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{folder} cannot be written, as {existing} is read-only; choose another place.")


def check_file(path: Pathlike) -> None:
    """Raise InputError unless a file can be written at `path`, whose folder may not exist yet; creates nothing."""
    if Path(path).is_dir():
        raise InputError(f"{path} is a folder; name a file in it.")
    check_folder(Path(path).parent)


@contextmanager
def replacing(path: Pathlike) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` when the block succeeds, and is removed otherwise.

    Creates the folder if it is missing. Raises InputError for errors of the operating system.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}); choose another place.") from error
    finally:
        # If a parent is a file, `unlink(missing_ok=True)` would raise.
        if temporary.exists():
            temporary.unlink()


def write_text(path: Pathlike, text: str) -> None:
    """Write text and a line end to a file, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(f"{text}\n", encoding="utf-8")
