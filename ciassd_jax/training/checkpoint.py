"""Checkpoints of a training: the state, the position of the loader and the config, written by orbax.

A checkpoint appears whole or not at all, and is written while training continues. The most recent ones and the best by
validation score are kept.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from ciassd_jax.config import Config, ScheduleConfig
from ciassd_jax.data.loader import LoaderState
from ciassd_jax.formats.errors import FormatWarning, InputError, Pathlike
from ciassd_jax.formats.writing import check_folder
from ciassd_jax.model.network import variable_shapes
from ciassd_jax.training.distributed import on_process_0
from ciassd_jax.training.optimizer import make_optimizer
from ciassd_jax.types import TrainState, Variables

# Version of a checkpoint's content; 2 since the optimizer works on one vector of all parameters.
FORMAT = 2


class Checkpoint(NamedTuple):
    """The state and the loader position to resume from, and the validation score if there was one."""

    state: TrainState
    loader: LoaderState
    score: float | None


class Checkpoints:
    """The checkpoints of a folder, one subfolder per step; use it in `with`, or call `close`, to finish writing.

    Keeps the last `keep` checkpoints and the one with the best score. Raises InputError for a folder that cannot be
    written.
    """

    def __init__(self, folder: Pathlike, config: Config, *, keep: int = 3) -> None:
        if keep < 1:
            raise ValueError(f"keep is {keep}; it must be at least 1.")
        check_folder(folder)
        self.folder, self._config = Path(folder).absolute(), config
        import orbax.checkpoint as ocp
        from orbax.checkpoint.checkpoint_managers import AnyPreservationPolicy, BestN, LatestN

        best = BestN(get_metric_fn=lambda metrics: metrics["score"], n=1, keep_checkpoints_without_metrics=False)
        options = ocp.CheckpointManagerOptions(
            preservation_policy=AnyPreservationPolicy([LatestN(keep), best]),
            # Removes what a killed run left half-written.
            cleanup_tmp_directories=True,
        )
        handlers = {"state": ocp.StandardCheckpointHandler(), "progress": ocp.JsonCheckpointHandler()}
        self._manager = ocp.CheckpointManager(
            self.folder, options=options, item_names=("state", "progress"), item_handlers=handlers
        )

    @property
    def steps(self) -> list[int]:
        """Steps of the available checkpoints, in ascending order."""
        return sorted(self._manager.all_steps())

    def save(self, state: TrainState, loader: LoaderState, *, score: float | None = None) -> None:
        """Start writing a checkpoint; `wait` returns when it is complete.

        Raises InputError if this checkpoint or the previous one cannot be written.
        """
        import orbax.checkpoint as ocp

        self.wait()
        on_process_0(partial(self._check_space, state))
        progress = {
            "format": FORMAT,
            "config": json.loads(self._config.to_json()),
            "loader": loader._asdict(),
            "optimizer": _structure(state.optimizer),
            "score": score,
        }
        items = ocp.args.Composite(state=ocp.args.StandardSave(state), progress=ocp.args.JsonSave(progress))
        metrics = None if score is None else {"score": score}
        try:
            self._manager.save(int(state.step), args=items, metrics=metrics, force=True)
        except Exception as error:
            raise self._not_written(error) from error

    def wait(self) -> None:
        """Block until every checkpoint is on the disk; raises InputError if one cannot be written."""
        try:
            self._manager.wait_until_finished()
            self._manager.check_for_errors()
        except Exception as error:
            raise self._not_written(error) from error

    def restore(self, like: TrainState) -> Checkpoint | None:
        """Return the newest readable checkpoint, with the shapes and sharding of `like`; None if there is none.

        Newer checkpoints that cannot be read are removed with a FormatWarning, so that their steps can be saved again.
        Raises InputError for a checkpoint of another config, another optimizer or an earlier format, and if none can be
        read; then nothing is removed.
        """
        import orbax.checkpoint as ocp

        damaged: list[int] = []
        for step in reversed(self.steps):
            try:
                progress = self._read(step, progress=ocp.args.JsonRestore())["progress"]
                _check_format(progress, self.folder / str(step))
                _check_config(progress["config"], self._config, self.folder / str(step))
                _check_optimizer(progress.get("optimizer"), like, self._config.schedule, self.folder / str(step))
                _check_arrays(self.folder / str(step) / "state")
                state = self._read(step, state=ocp.args.StandardRestore(_abstract(like)))["state"]
            except InputError:
                raise
            # Orbax and its storage raise errors of many types for damaged files.
            except Exception:
                damaged.append(step)
                continue
            self._remove(damaged)
            return Checkpoint(state, LoaderState(**progress["loader"]), progress["score"])
        if damaged:
            raise InputError(
                f"None of the checkpoints in {self.folder} can be read; start a new run in another folder, for example "
                "from the weights in last.safetensors."
            )
        return None

    def close(self) -> None:
        """Finish writing; raises InputError if a checkpoint cannot be written."""
        try:
            self.wait()
        finally:
            self._manager.close()

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        try:
            self.close()
        except InputError:
            # An error that is already being raised comes first.
            if kind is None:
                raise

    def _read(self, step: int, **items: Any) -> Any:
        import orbax.checkpoint as ocp

        return self._manager.restore(step, args=ocp.args.Composite(**items))

    def _remove(self, steps: list[int]) -> None:
        for step in steps:
            text = f"{self.folder / str(step)} is damaged and was removed; resuming from the checkpoint before it."
            warnings.warn(text, FormatWarning, stacklevel=3)
            shutil.rmtree(self.folder / str(step))
        if steps:
            self._manager.reload()

    def _check_space(self, state: TrainState) -> None:
        """Raise InputError on a disk that is too full; a write that fails midway makes orbax print pages of traces."""
        if shutil.disk_usage(self.folder).free < sum(leaf.nbytes for leaf in jax.tree.leaves(state)):
            raise self._not_written(OSError(errno.ENOSPC, ""))

    def _not_written(self, error: Exception) -> InputError:
        return InputError(
            f"A checkpoint cannot be written to {self.folder} ({_reason(error)}); free some space or check its "
            "permissions, then run again: the earlier checkpoints are intact."
        )


def checkpoint_steps(folder: Pathlike) -> list[int]:
    """Return the steps of the complete checkpoints in a folder, in ascending order; raise InputError if none is."""
    steps = sorted(int(path.name) for path in Path(folder).glob("*") if path.name.isdecimal() and path.is_dir())
    if not steps:
        raise InputError(f"{folder} has no checkpoint; give the folder of a training that has saved one.")
    return steps


def checkpoint_variables(folder: Pathlike, step: int) -> Variables:
    """Read the weights that evaluation uses, {"params", "batch_stats"}, from the checkpoint of a step.

    Changes nothing, so the training may be running. Raises InputError for a checkpoint that cannot be read.
    """
    import orbax.checkpoint as ocp

    place = Path(folder).absolute() / str(step)
    try:
        progress = json.loads((place / "progress" / "metadata").read_text(encoding="utf-8"))
        config = Config.from_json(json.dumps(progress["config"]))
        params, shapes = "ema" if config.schedule.ema_decay else "params", variable_shapes(config)
        wanted = {params: shapes["params"], "batch_stats": shapes["batch_stats"]}
        as_arrays = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), wanted)
        _check_arrays(place / "state")
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as reader:
            arguments = ocp.args.PyTreeRestore(wanted, restore_args=as_arrays, partial_restore=True)
            found = reader.restore(place / "state", args=arguments)
    # Orbax and its storage raise errors of many types for damaged files.
    except Exception as error:
        raise InputError(
            f"{place} cannot be read ({_reason(error)}); remove this folder to evaluate the others."
        ) from error
    return {"params": found[params], "batch_stats": found["batch_stats"]}


def _reason(error: Exception) -> str:
    """Return the operating system's message if the error has its code, otherwise the error's first line."""
    code = error.errno if isinstance(error, OSError) else None
    if found := re.search(r"os_error_code='(\d+)'", str(error)):
        code = int(found[1])
    if code is not None:
        return os.strerror(code)
    return next((line[:200] for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _check_arrays(folder: Path) -> None:
    """Read every stored value, one at a time.

    Orbax reads them concurrently; if one fails, it prints a traceback for each that is still pending.
    """
    import tensorstore

    store = tensorstore.KvStore.open({"driver": "ocdbt", "base": f"{folder.as_uri()}/"}).result()
    for key in store.list().result():
        store.read(key).result()


def _abstract(state: TrainState) -> TrainState:
    """Return shapes, types and sharding; orbax restores onto these devices, whichever the state was saved from."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding), state)


def _check_format(progress: Any, path: Path) -> None:
    if progress.get("format") != FORMAT:
        raise InputError(
            f"{path} was written by another version of the package, whose optimizer state differs; finish that run "
            "with that version, or start a new run in another folder from its last.safetensors."
        )


def _check_config(saved: Any, config: Config, path: Path) -> None:
    """Raise InputError unless the saved config, with defaults for the fields that it lacks, equals `config`."""
    try:
        parsed = Config.from_json(json.dumps(saved))
    except ValueError as error:
        raise InputError(f"{path} has a config that this version cannot read: {error}") from error
    if parsed != config:
        difference = first_difference(json.loads(parsed.to_json()), json.loads(config.to_json()))
        raise InputError(
            f"{path} has another config: {difference}; use the config that the run was started with, or another folder."
        )


def _structure(state: Any) -> str:
    """Return a digest of the names, shapes and types of an optimizer's state."""
    leaves = jax.tree_util.tree_flatten_with_path(state)[0]
    text = " ".join(f"{jax.tree_util.keystr(keys)}:{leaf.dtype}{leaf.shape}" for keys, leaf in leaves)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _check_optimizer(saved: str | None, like: TrainState, schedule: ScheduleConfig, path: Path) -> None:
    """Raise InputError for the state of another optimizer; a checkpoint of an earlier version has the default one's."""
    if saved is None:
        saved = _structure(jax.eval_shape(make_optimizer(schedule).init, like.params))
    if saved != _structure(like.optimizer):
        raise InputError(
            f"{path} has the state of another optimizer; use the optimizer that the run was started with, or another "
            "folder."
        )


def first_difference(saved: Any, wanted: Any, where: str = "config") -> str:
    """Return the first field in which two parsed JSON values differ, with both values."""
    if isinstance(saved, dict) and isinstance(wanted, dict):
        for name in [*saved, *(name for name in wanted if name not in saved)]:
            if name not in saved or name not in wanted:
                return f"{where}.{name} is {'new' if name in wanted else 'unknown here'}"
            if saved[name] != wanted[name]:
                return first_difference(saved[name], wanted[name], f"{where}.{name}")
    if isinstance(saved, list) and isinstance(wanted, list) and len(saved) == len(wanted):
        index = next(i for i, pair in enumerate(zip(saved, wanted, strict=True)) if pair[0] != pair[1])
        return first_difference(saved[index], wanted[index], f"{where}[{index}]")
    return f"{where} is {saved!r} there and {wanted!r} here"
