"""The optimiser, Adam with decoupled weight decay, and its schedules."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
import optax

from ciassd_jax.config import ScheduleConfig
from ciassd_jax.types import Array


def learning_rate(step: int | Array, schedule: ScheduleConfig) -> Array:
    """Return the learning rate of update `step`, counted from 0.

    "one_cycle" (released code) rises to the peak over `warmup` of the updates and falls over the rest, each by half a
    cosine; "cosine" (paper section 4.1) falls from the peak to 0 by half a cosine.
    """
    updates = _num_updates(schedule)
    if schedule.kind == "cosine":
        return jnp.asarray(optax.cosine_decay_schedule(schedule.learning_rate, updates)(step))
    low = schedule.learning_rate / schedule.div_factor
    return _cycle(step, schedule, low, schedule.learning_rate, low / schedule.final_div_factor)


def momentum(step: int | Array, schedule: ScheduleConfig) -> Array:
    """Return Adam's b1 of update `step`, counted from 0.

    In one cycle it falls from the high end of `b1_range` to the low end while the learning rate rises, and back;
    otherwise it is constant at the high end.
    """
    high, low = schedule.b1_range
    return _cycle(step, schedule, high, low, high) if schedule.kind == "one_cycle" else jnp.asarray(high)


def _num_updates(schedule: ScheduleConfig) -> int:
    return max(schedule.total_steps // schedule.gradient_accumulation_steps, 1)


def _cycle(step: int | Array, schedule: ScheduleConfig, start: float, middle: float, end: float) -> Array:
    """Go from `start` to `middle` by half a cosine over the warm-up, and to `end` by half a cosine over the rest."""
    updates = _num_updates(schedule)
    turn = int(schedule.warmup * updates)
    rise = jnp.clip(jnp.asarray(step) / max(turn, 1), 0, 1)
    fall = jnp.clip((jnp.asarray(step) - turn) / (updates - turn), 0, 1)
    up = middle + (start - middle) / 2 * (1 + jnp.cos(jnp.pi * rise))
    down = end + (middle - end) / 2 * (1 + jnp.cos(jnp.pi * fall))
    return jnp.where(jnp.asarray(step) < turn, up, down)


def make_optimizer(schedule: ScheduleConfig) -> optax.GradientTransformation:
    """Return the optimiser: clipping by global norm, Adam with scheduled b1, decoupled weight decay of all parameters.

    With `gradient_accumulation_steps` = n, every n-th step makes one update with the mean gradient of n steps, and the
    schedules count updates.
    """
    adam = optax.inject_hyperparams(optax.scale_by_adam, static_args=("b2", "eps"))
    chain: Any = optax.chain(
        optax.clip_by_global_norm(schedule.max_gradient_norm),
        adam(b1=partial(momentum, schedule=schedule), b2=schedule.b2, eps=1e-8),
        optax.add_decayed_weights(schedule.weight_decay),
        optax.scale_by_learning_rate(partial(learning_rate, schedule=schedule)),
    )
    if schedule.gradient_accumulation_steps > 1:
        chain = optax.MultiSteps(chain, schedule.gradient_accumulation_steps)
    # On one vector of all parameters, because one program per tensor takes seconds to compile.
    flat = optax.flatten(optax.GradientTransformation(chain.init, chain.update))
    return optax.GradientTransformation(flat.init, flat.update)
