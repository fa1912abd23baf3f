"""What a command returned, and files for the tests of the commands."""

import os
import pickle
import re
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

TOUCHED = Path("/tmp/ciassd_test_was_here")


class Run(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def complaints(self) -> str:
        """All of stderr but the lines that announce a compilation."""
        return re.sub(r"Compiling .*, once\.\n", "", self.err)


class Evil:
    def __reduce__(self) -> Any:
        return os.system, (f"touch {TOUCHED}",)


def evil_pth(path: Path) -> Path:
    """A checkpoint that runs a command when it is unpickled."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps({"state_dict": Evil()}, 2))
    return path


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())
