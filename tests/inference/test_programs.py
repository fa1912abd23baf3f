"""Compilation: announced, kept in a folder, and ended by Ctrl-C."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import small_cloud

from ciassd_jax.formats.points import write_bin
from ciassd_jax.inference.programs import compile_program, keep_programs


@pytest.fixture
def no_cache() -> Iterator[None]:
    """As in a process without a compilation cache."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.usefixtures("no_cache")
def test_programs_are_kept_in_the_folder_of_caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    keep_programs()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "caches/ciassd_jax")
    assert (tmp_path / "caches/ciassd_jax").is_dir()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    keep_programs()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")


@pytest.mark.usefixtures("no_cache")
@pytest.mark.parametrize("variable", ["XDG_CACHE_HOME", "HOME"])
def test_without_a_folder_that_can_be_written_nothing_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv(variable, str(tmp_path / "file"))
    keep_programs()
    assert jax.config.jax_compilation_cache_dir is None


@pytest.mark.usefixtures("no_cache")
def test_a_read_only_folder_is_no_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    # Whatever its mode, root may write a folder.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    keep_programs()
    assert jax.config.jax_compilation_cache_dir is None


def test_a_compilation_is_announced(capsys: pytest.CaptureFixture[str]) -> None:
    program = compile_program(jax.jit(jnp.add), np.float32(1), np.float32(2), what="a sum")
    assert capsys.readouterr() == ("", "Compiling a sum, once.\n")
    assert program(np.float32(3), np.float32(4)) == 7
    assert gc.isenabled()


class Slow:
    """Stands in for a jitted function, and for its lowered form, whose compilation ends with `done`."""

    def __init__(self, error: Exception | None = None) -> None:
        self.done, self.began, self.error = threading.Event(), threading.Event(), error

    def lower(self) -> "Slow":
        return self

    def compile(self) -> str:
        self.began.set()
        self.done.wait(timeout=20)
        if self.error is not None:
            raise self.error
        return "program"


def test_a_signal_ends_the_wait_and_the_next_compilation_works() -> None:
    slow, before = Slow(), signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Thread(target=lambda: slow.began.wait(20) and os.kill(os.getpid(), signal.SIGINT)).start()
        start = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            compile_program(slow, what="nothing")
        assert time.monotonic() - start < 5
    finally:
        signal.signal(signal.SIGINT, before)
        slow.done.set()
    assert compile_program(slow, what="nothing") == "program"
    with pytest.raises(KeyboardInterrupt):
        compile_program(Slow(), what="nothing", signals=[signal.SIGTERM])


def test_errors_of_the_compiler_are_raised() -> None:
    for error in (ValueError("no such operation"), TimeoutError("too slow")):
        failing = Slow(error)
        failing.done.set()
        with pytest.raises(type(error), match=str(error)):
            compile_program(failing, what="nothing")


def test_a_thread_compiles_itself() -> None:
    slow, found = Slow(), []
    slow.done.set()
    thread = threading.Thread(target=lambda: found.append(compile_program(slow, what="nothing")))
    thread.start()
    thread.join(timeout=20)
    assert found == ["program"]


def fresh(tmp_path: Path, **variables: str) -> dict[str, str]:
    """The environment of a user who has compiled nothing yet."""
    left_out = ("JAX_COMPILATION_CACHE_DIR", "XLA_FLAGS", "XDG_CACHE_HOME")
    return {name: value for name, value in os.environ.items() if name not in left_out} | {
        "XDG_CACHE_HOME": str(tmp_path / "caches"),
        **variables,
    }


@pytest.mark.parametrize("home", ["/dev/null", None])
def test_an_import_changes_nothing_and_a_missing_home_breaks_nothing(tmp_path: Path, home: str | None) -> None:
    code = (
        "import jax, numpy, ciassd_jax.inference.programs as programs; before = jax.config.jax_compilation_cache_dir;"
        "print(programs.compile_program(jax.jit(lambda x: x + 1), numpy.float32(1), what='a sum')(numpy.float32(1)));"
        "print(before, jax.config.jax_compilation_cache_dir)"
    )
    env = fresh(tmp_path, **({"XDG_CACHE_HOME": "", "HOME": home} if home else {}))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=env)
    assert (done.returncode, done.stderr) == (0, "Compiling a sum, once.\n")
    assert done.stdout == f"2.0\nNone {None if home else tmp_path / 'caches/ciassd_jax'}\n"


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0, 2])
def test_ctrl_c_while_it_compiles_ends_the_program_at_once(tmp_path: Path, seconds: int) -> None:
    write_bin(tmp_path / "a.bin", small_cloud())
    command = ["ciassd_jax", "predict", tmp_path / "a.bin", "--weights", "car_lite", "--out", tmp_path / "out"]
    with started(["-m", *command], tmp_path) as process:
        assert process.stderr.readline() == "Compiling predict for 1 scene of 32768 points, once.\n"
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        start = time.monotonic()
        out, err = process.communicate(timeout=60)
        assert time.monotonic() - start < 1
        assert (process.returncode, out, err) == (130, "", "")
    assert not (tmp_path / "out").exists()


NOTEBOOK = """
import sys
import numpy as np, ciassd_jax
points = np.full((9, 4), 0.5, np.float32)
detector = ciassd_jax.Detector.from_pretrained("car_lite")
try:
    detector(points)
except KeyboardInterrupt:
    print("interrupted", flush=True)
print(detector(points).counts["points"]["given"])
"""


@pytest.mark.slow
def test_a_notebook_survives_ctrl_c_while_it_compiles(tmp_path: Path) -> None:
    with started(["-W", "ignore", "-c", NOTEBOOK], tmp_path) as process:
        assert process.stderr.readline().startswith("Compiling predict ")
        time.sleep(2)
        process.send_signal(signal.SIGINT)
        start = time.monotonic()
        assert process.stdout.readline() == "interrupted\n"
        assert time.monotonic() - start < 1
        out, err = process.communicate(timeout=300)
        assert (process.returncode, out, err.count("Compiling")) == (0, "9\n", 1)


def started(arguments: list[Any], tmp_path: Path) -> subprocess.Popen[str]:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *map(str, arguments)], env=fresh(tmp_path), **pipes)
