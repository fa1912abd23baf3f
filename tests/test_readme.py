"""The README as a new user runs it: its blocks in their order in one folder, and the form of those that need more."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from ciassd_jax import cli
from ciassd_jax.cli.names import subcommands

README = Path(__file__).parents[1] / "README.md"


class Block(NamedTuple):
    section: str
    language: str
    code: str

    @property
    def is_run(self) -> bool:
        """Whether the block needs nothing but the repository; its first line says otherwise."""
        return not self.code.startswith(("# Needs ", "# Takes "))


def blocks() -> list[Block]:
    found, section = [], ""
    for heading, language, code in re.findall(r"^## ([^\n]*)$|^```(\w+)\n(.*?)^```$", README.read_text(), re.M | re.S):
        section = heading or section
        if language:
            found.append(Block(section, language, code))
    return found


BLOCKS = blocks()
NAMES = [f"{index} {block.section} {block.language}" for index, block in enumerate(BLOCKS)]


def test_it_is_short_and_has_what_a_newcomer_needs() -> None:
    assert len(README.read_text().splitlines()) <= 200
    assert {block.language for block in BLOCKS} == {"bash", "python"}
    assert sum(block.is_run for block in BLOCKS) >= 8


@pytest.mark.parametrize("block", [one for one in BLOCKS if one.language == "python"], ids=lambda one: one.section)
def test_snippets_use_public_names_only(block: Block) -> None:
    compile(block.code, "README.md", "exec")
    assert not re.search(r"ciassd_jax\.\w+ import|\._", block.code)


def commands() -> list[str]:
    """Every command `ciassd ...` of the README, in blocks and in text."""
    lines = [line for block in BLOCKS if block.language == "bash" for line in block.code.splitlines()]
    parts = [part for line in lines for part in line.partition(" #")[0].split(" && ")]
    inline = re.findall(r"`(ciassd [^`]*)`", README.read_text())
    return [text.partition(" > ")[0].strip() for text in [*parts, *inline] if text.strip().startswith("ciassd ")]


@pytest.mark.parametrize("command", sorted(set(commands())))
def test_commands_have_these_options(command: str) -> None:
    """Also those that are not run."""
    arguments = shlex.split(command)[1:]
    if len(arguments) == 1:
        assert arguments[0] in subcommands(cli.Command)
        return
    cli._parse(arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("readme")


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS, ids=NAMES)
def test_it_runs_as_it_stands(block: Block, folder: Path) -> None:
    if not block.is_run:
        pytest.skip(block.code.splitlines()[0][2:])
    if block.language == "python":
        script = folder / "snippet.py"
        script.write_text(block.code)
        command = [sys.executable, str(script)]
    else:
        command = ["bash", "-euo", "pipefail", "-c", block.code]
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, env={**os.environ, "PATH": path}
    )
    assert done.returncode == 0, done.stderr
