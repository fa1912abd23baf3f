"""The training step as one pure function: state and scenes in, new state and metrics out.

`train_step` runs under `jit`, and with `axis_name` under `pmap` or `shard_map`, where it pools batch statistics,
gradients and metrics over that axis. Under `jit` alone a batch may be sharded over a mesh too; XLA then gathers the
features of all scenes on every device.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax

from ciassd_jax.config import Config, ScheduleConfig
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.model.network import CIASSD, init_variables, voxelize_batch
from ciassd_jax.training.losses import detection_loss
from ciassd_jax.training.optimizer import learning_rate, make_optimizer, momentum
from ciassd_jax.training.targets import assign_targets
from ciassd_jax.types import LossTerms, Scene, Targets, TrainState, Variables


def create_train_state(key: jax.Array, config: Config, *, variables: Variables | None = None) -> TrainState:
    """Return the state at step 0, with `variables` ({"params", "batch_stats"}), by default random ones from `key`."""
    start = init_variables(key, config) if variables is None else variables
    params = jax.tree.map(jnp.asarray, start["params"])
    # `step` and `skipped` are separate zeros, because a donated state must not hold one buffer twice.
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        batch_stats=jax.tree.map(jnp.asarray, start["batch_stats"]),
        optimizer=make_optimizer(config.schedule).init(params),
        ema=jax.tree.map(jnp.copy, params) if config.schedule.ema_decay else None,
        skipped=jnp.zeros((), jnp.int32),
    )


def train_step(
    state: TrainState, batch: Scene, config: Config, *, axis_name: str | None = None
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Update the state from a batch of padded scenes [B, ...]: voxelise, network, targets, losses, optimiser.

    `config` and `axis_name` are static. If the loss or the gradient norm is not finite, the update is skipped:
    parameters, optimiser state and batch statistics stay, and `skipped` counts it.

    Returns the new state and scalar metrics: `loss` and its unweighted terms `classification`, `box`, `direction` and
    `iou` (means over scenes), `positives` (positive anchors per scene), `gradient_norm` before clipping,
    `learning_rate`, `momentum` (Adam's b1), `skipped`, and the overflow counts (sums over scenes) `points_cut`,
    `boxes_cut`, `objects_cut`, `points_dropped`, `voxels_dropped` and `sites_dropped`.
    """
    terms_of = partial(_loss, batch=batch, config=config, axis_name=axis_name)
    (_, (terms, targets, batch_stats, counts)), gradient = jax.value_and_grad(terms_of, has_aux=True)(
        state.params, state.batch_stats
    )
    if axis_name is not None:
        gradient, terms = lax.pmean((gradient, terms), axis_name)
        batch_stats = lax.pmean(batch_stats, axis_name)
    # Of one vector, like the norm that the optimiser clips.
    norm = optax.tree.norm(jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(gradient)]))
    finite = jnp.isfinite(norm) & jnp.isfinite(terms.total)
    new_state = _update(state, gradient, batch_stats, finite, config.schedule)
    positives = (targets.label == 1).sum(1).astype(jnp.float32).mean()
    if axis_name is not None:
        positives, counts = lax.pmean(positives, axis_name), lax.psum(counts, axis_name)
    update = state.step // config.schedule.gradient_accumulation_steps
    metrics = {
        "loss": terms.total,
        **{name: value for name, value in terms._asdict().items() if name != "total"},
        "positives": positives,
        "gradient_norm": norm,
        "learning_rate": learning_rate(update, config.schedule),
        "momentum": momentum(update, config.schedule),
        "skipped": new_state.skipped,
        **counts,
    }
    return new_state, metrics


def _loss(
    params: Any, batch_stats: Any, *, batch: Scene, config: Config, axis_name: str | None
) -> tuple[jax.Array, tuple[LossTerms, Targets, Any, dict[str, jax.Array]]]:
    """Return the total loss of the batch, and (terms, targets, new batch statistics, overflow counts)."""
    with jax.named_scope("voxelize"):
        voxels = voxelize_batch(batch.cloud, config)

    def forward(params: Any) -> Any:
        variables = {"params": params, "batch_stats": batch_stats}
        return CIASSD(config, axis_name).apply(variables, voxels, train=True, mutable=["batch_stats"])

    if config.schedule.remat:
        forward = jax.checkpoint(forward)
    (predictions, _, sites_dropped), updated = forward(params)
    anchors, labels = make_anchors(config)
    with jax.named_scope("targets"):
        assign = partial(assign_targets, anchors=anchors, anchor_labels=labels, classes=config.classes)
        targets = jax.vmap(assign)(batch.truth)
    with jax.named_scope("losses"):
        terms = detection_loss(predictions, targets, anchors, config.loss)
    counts = {
        "points_cut": batch.points_cut,
        "boxes_cut": batch.boxes_cut,
        "objects_cut": batch.objects_cut,
        "points_dropped": voxels.points_dropped,
        "voxels_dropped": voxels.dropped,
        "sites_dropped": sites_dropped,
    }
    sums = {name: jnp.sum(each) for name, each in counts.items()}
    return jnp.asarray(terms.total), (terms, targets, updated["batch_stats"], sums)


def _update(
    state: TrainState, gradient: Any, batch_stats: Any, finite: jax.Array, schedule: ScheduleConfig
) -> TrainState:
    """Return the state after the update, or with the update skipped if it is not finite."""
    changes, optimizer = make_optimizer(schedule).update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, changes)
    ema = state.ema
    if ema is not None:
        ema = optax.incremental_update(params, ema, 1 - schedule.ema_decay)
    changed = TrainState(state.step, params, batch_stats, optimizer, ema, state.skipped)
    chosen = jax.tree.map(lambda new, old: jnp.where(finite, new, old), changed, state)
    return chosen._replace(step=state.step + 1, skipped=state.skipped + (~finite).astype(jnp.int32))
