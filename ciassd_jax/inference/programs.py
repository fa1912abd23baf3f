"""Compilation of the programs that users wait for: announced, kept for later processes, and ended by Ctrl-C."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from ciassd_jax.config import Config

# The compiler runs in a thread; the default stack of one is too small for it on some systems.
_STACK = 2**26


def keep_programs() -> None:
    """Keep compiled programs in ~/.cache/ciassd_jax, so that later processes skip the compilation.

    JAX_COMPILATION_CACHE_DIR, or `jax.config`, sets another folder; JAX_ENABLE_COMPILATION_CACHE=false disables the
    cache. Without a folder that can be written, every process compiles anew.
    """
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "ciassd_jax")
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(cache, os.W_OK | os.X_OK):
        jax.config.update("jax_compilation_cache_dir", str(cache))


def compile_program(function: Any, *arguments: Any, what: str, signals: Sequence[int] = (), **named: Any) -> Any:
    """Compile a jitted function for arguments (arrays or their shapes), after a line on stderr that names `what`.

    Ctrl-C ends the wait at once, though the compiler does not stop: it raises KeyboardInterrupt. So does an entry that
    a signal handler appends to `signals`.
    """
    keep_programs()
    announce(what)
    with _no_collection():
        lowered = function.lower(*arguments, **named)
    return _in_thread(lowered.compile, signals)


def announce(what: str) -> None:
    """Say on stderr that `what` is being compiled."""
    from tqdm.auto import tqdm

    # A reader that has gone, such as `tee` after Ctrl-C, is no reason to end.
    with suppress(BrokenPipeError):
        tqdm.write(f"Compiling {what}, once.", file=sys.stderr)
        sys.stderr.flush()


def for_this_backend(config: Config) -> Config:
    """Return the config with the form of the program that this machine runs.

    On a CPU half the time of tracing would go to the form that only accelerators use.
    """
    on_cpu = config.program == "auto" and jax.default_backend() == "cpu"
    return replace(config, program="cpu") if on_cpu else config


@contextmanager
def _no_collection() -> Iterator[None]:
    """Switch the garbage collector off: it would take a quarter of the time of tracing, which leaves no garbage.

    It would also lose a Ctrl-C, as Python ignores an exception in JAX's callback of the collector.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _in_thread(work: Callable[[], Any], signals: Sequence[int]) -> Any:
    """Run `work` in a thread: unlike the compiler, a main thread that waits receives signals."""
    if threading.current_thread() is not threading.main_thread():
        return work()
    done: Future[Any] = Future()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    before = threading.stack_size(_STACK)
    try:
        # A daemon, so that a program that was interrupted need not wait for it.
        threading.Thread(target=run, name="compiler", daemon=True).start()
    finally:
        threading.stack_size(before)
    while not signals:
        try:
            return done.result(timeout=0.1)
        except TimeoutError:
            if done.done():
                raise
    raise KeyboardInterrupt
