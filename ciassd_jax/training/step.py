"""The training step as pure functions: `compute_loss`, `apply_gradients`, and `train_step`, which consists of both.

They run under `jit`, and with `axis_name` under `pmap` or `shard_map(..., check_vma=False)`, where batch statistics,
and in `train_step` gradients and metrics, are pooled over that axis. Under `jit` alone a batch may be sharded over a
mesh of automatic axes (`jax.sharding.AxisType.Auto`) too; XLA then gathers the features of all scenes on every device.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax

from ciassd_jax.config import Config
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.model.frozen import check_frozen, keep_frozen, running_statistics, stop_gradients
from ciassd_jax.model.network import CIASSD, NetworkOutput, fitting_variables, init_variables, voxelize_batch
from ciassd_jax.training.losses import detection_loss
from ciassd_jax.training.optimizer import learning_rate, make_optimizer, momentum
from ciassd_jax.training.targets import assign_targets
from ciassd_jax.types import LossOutput, Scene, SparseVoxels, TrainState, Variables


def create_train_state(
    key: jax.Array,
    config: Config,
    *,
    variables: Variables | None = None,
    optimizer: optax.GradientTransformation | None = None,
) -> TrainState:
    """Return the state at step 0, with `variables` ({"params", "batch_stats"}), by default random ones from `key`.

    `optimizer` is any optax transformation, by default that of `config.schedule`; give `train_step` the same one. The
    state may be donated: it shares no memory with `variables` or the optimizer. Raises ValueError for variables that do
    not fit the config, and for frozen parts that do not exist.
    """
    if config.schedule.frozen:
        check_frozen(config)
    start = init_variables(key, config) if variables is None else fitting_variables(variables, config)
    params = jax.tree.map(jnp.asarray, start["params"])
    state = TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        batch_stats=start["batch_stats"],
        optimizer=(optimizer or make_optimizer(config.schedule)).init(params),
        ema=params if config.schedule.ema_decay else None,
        skipped=jnp.zeros((), jnp.int32),
    )
    # A donated state must not hold one buffer twice, and the states of many optimizers hold the parameters.
    return jax.tree.map(jnp.copy, state)


def train_step(
    state: TrainState,
    batch: Scene,
    config: Config,
    *,
    optimizer: optax.GradientTransformation | None = None,
    axis_name: str | None = None,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Update the state from a batch of padded scenes [B, ...]: voxelise, network, targets, losses, optimiser.

    `config`, `optimizer` and `axis_name` are static: `jax.jit(partial(train_step, config=config, optimizer=...))`.
    `optimizer` is that of `create_train_state`; of `config.schedule` it replaces the learning rate, weight decay,
    clipping and accumulation.

    Returns the new state, which is that of `apply_gradients`, and scalar metrics: `loss` and its unweighted terms
    `classification`, `box`, `direction` and `iou` (means over scenes), `positives` (positive anchors per scene),
    `gradient_norm` before clipping, `skipped`, the counts of `LossOutput`, and for the default optimiser
    `learning_rate` and `momentum` (Adam's b1).
    """
    loss_of = partial(compute_loss, batch=batch, config=config, axis_name=axis_name)
    (_, output), gradient = jax.value_and_grad(loss_of, has_aux=True)(state.params, state.batch_stats)
    positives = (output.targets.label == 1).sum(1).astype(jnp.float32).mean()
    if axis_name is not None:
        terms, batch_stats, positives, gradient = lax.pmean(
            (output.terms, output.batch_stats, positives, gradient), axis_name
        )
        output = output._replace(terms=terms, batch_stats=batch_stats, counts=lax.psum(output.counts, axis_name))
    new_state = apply_gradients(state, gradient, output, config, optimizer=optimizer)
    metrics = {
        "loss": output.terms.total,
        **{name: value for name, value in output.terms._asdict().items() if name != "total"},
        "positives": positives,
        "gradient_norm": _norm(gradient),
        "skipped": new_state.skipped,
        **output.counts,
    }
    if optimizer is None:
        update = state.step // config.schedule.gradient_accumulation_steps
        metrics["learning_rate"] = learning_rate(update, config.schedule)
        metrics["momentum"] = momentum(update, config.schedule)
    return new_state, metrics


def compute_loss(
    params: Any, batch_stats: Any, batch: Scene, config: Config, *, axis_name: str | None = None
) -> tuple[jax.Array, LossOutput]:
    """Return the loss of a batch of padded scenes [B, ...], and what it consists of.

    For `jax.value_and_grad(compute_loss, has_aux=True)`. Frozen parts (`config.schedule.frozen`) have no gradient, and
    their BatchNorm layers use their running statistics. With `axis_name` BatchNorm pools over that axis; the loss and
    the rest are those of the scenes of one device. Raises ValueError, while it is traced, for arguments that do not
    fit.
    """
    fitting_variables({"params": params, "batch_stats": batch_stats}, config)
    frozen = config.schedule.frozen
    if frozen:
        check_frozen(config)
    with jax.named_scope("voxelize"):
        voxels = voxelize_batch(batch.cloud, config)

    def forward(params: Any) -> Any:
        variables = {"params": stop_gradients(params, frozen), "batch_stats": batch_stats}
        with running_statistics(frozen):
            return CIASSD(config, axis_name).apply(variables, voxels, train=True, mutable=["batch_stats"])

    if config.schedule.remat:
        forward = jax.checkpoint(forward)
    network, updated = forward(params)
    anchors, labels = make_anchors(config)
    with jax.named_scope("targets"):
        assign = partial(assign_targets, anchors=anchors, anchor_labels=labels, classes=config.classes)
        targets = jax.vmap(assign)(batch.truth)
    with jax.named_scope("losses"):
        terms = detection_loss(network.predictions, targets, anchors, config.loss)
    # Of the type that was given, as the state's tree must not change: Flax returns a dictionary for a FrozenDict.
    new_stats = jax.tree.unflatten(jax.tree.structure(batch_stats), jax.tree.leaves(updated["batch_stats"]))
    counts = _count(batch, voxels, network)
    output = LossOutput(terms, targets, network.predictions, network.features, new_stats, counts)
    return jnp.asarray(terms.total), output


def _count(batch: Scene, voxels: SparseVoxels, network: NetworkOutput) -> dict[str, jax.Array]:
    """Return what was given, kept and dropped, as sums over the scenes."""
    counts = {
        "points_given": voxels.points_given,
        "points_cut": batch.points_cut,
        "points_dropped": voxels.points_dropped,
        "boxes_given": batch.truth.count,
        "boxes_cut": batch.boxes_cut,
        "objects_cut": batch.objects_cut,
        "voxels_kept": voxels.count,
        "voxels_dropped": voxels.dropped,
        "sites_kept": network.sites_kept,
        "sites_dropped": network.sites_dropped,
    }
    return {name: jnp.sum(each) for name, each in counts.items()}


def apply_gradients(
    state: TrainState,
    gradient: Any,
    output: LossOutput,
    config: Config,
    *,
    optimizer: optax.GradientTransformation | None = None,
) -> TrainState:
    """Return the state after one update by `gradient`, with the batch statistics of `output`.

    `optimizer` is that of `create_train_state`; one that evaluates the loss itself, such as `optax.lbfgs`, needs a step
    of its own. Frozen parts keep their parameters, whatever the optimiser does. If the loss or the gradient norm is not
    finite, only `step` and `skipped` change. Raises ValueError, while it is traced, for a state of another optimiser,
    and for one without the running mean that the config asks for.
    """
    frozen, decay = config.schedule.frozen, config.schedule.ema_decay
    optimizer = optimizer or make_optimizer(config.schedule)
    _check_state(state, optimizer, decay)
    finite = jnp.isfinite(_norm(gradient)) & jnp.isfinite(output.terms.total)
    update = optax.with_extra_args_support(optimizer).update
    # The loss serves transformations that adapt to it, such as `optax.contrib.reduce_on_plateau`.
    changes, optimizer_state = update(gradient, state.optimizer, state.params, value=output.terms.total)
    params = keep_frozen(optax.apply_updates(state.params, changes), state.params, frozen)
    ema = state.ema
    if ema is not None:
        ema = keep_frozen(optax.incremental_update(params, ema, 1 - decay), ema, frozen)
    changed = TrainState(state.step, params, output.batch_stats, optimizer_state, ema, state.skipped)
    chosen = jax.tree.map(lambda new, old: jnp.where(finite, new, old), changed, state)
    return chosen._replace(step=state.step + 1, skipped=state.skipped + (~finite).astype(jnp.int32))


def _check_state(state: TrainState, optimizer: optax.GradientTransformation, decay: float) -> None:
    expected: Any = jax.tree.structure(jax.eval_shape(optimizer.init, state.params))
    if expected != jax.tree.structure(state.optimizer):
        raise ValueError("The state is that of another optimizer; give `create_train_state` the same `optimizer`.")
    if decay and state.ema is None:
        raise ValueError(f"The state has no `ema`, but schedule.ema_decay is {decay}; create it with this config.")


def _norm(gradient: Any) -> jax.Array:
    """The global norm, of one vector like that which the optimiser clips."""
    return optax.tree.norm(jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(gradient)]))
