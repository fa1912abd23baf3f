"""The choice between a CPU's and an accelerator's form of the same computation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from jax import lax

# "auto" chooses by the platform that a program is compiled for. "accelerator" also runs on a CPU, slowly.
Program = Literal["auto", "cpu", "accelerator"]


def by_platform(
    program: Program,
    *operands: Any,
    cpu: Callable[..., Any],
    accelerator: Callable[..., Any],
    gpu: Callable[..., Any] | None = None,
) -> Any:
    """Apply the form that `program` names to the operands; all give the same result up to rounding.

    A CPU gains from exact sizes: loops over the occupied blocks of an array. On an accelerator each turn of such a loop
    waits for the host or starts a small kernel, and static, slightly wasteful sizes are faster. `gpu` is for what suits
    a TPU only: with "auto", a GPU runs it in place of `accelerator`.
    """
    if program == "cpu":
        return cpu(*operands)
    if program == "accelerator":
        return accelerator(*operands)
    on_gpu = {} if gpu is None else {"cuda": gpu, "rocm": gpu}
    return lax.platform_dependent(*operands, cpu=cpu, default=accelerator, **on_gpu)
