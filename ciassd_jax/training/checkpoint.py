"""Checkpoints of a training: the state, where its loader is, and the config, as orbax writes them.

A checkpoint appears whole or not at all, written while training goes on. The last few stay, and the best by validation.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax

from ciassd_jax.config import Config
from ciassd_jax.data.loader import LoaderState
from ciassd_jax.formats.errors import FormatWarning, InputError, Pathlike
from ciassd_jax.formats.writing import check_folder
from ciassd_jax.types import TrainState

# Of what a checkpoint holds; 2 since the optimizer works on one vector of all parameters.
FORMAT = 2


class Checkpoint(NamedTuple):
    """What a training goes on from, and its validation score where there was one."""

    state: TrainState
    loader: LoaderState
    score: float | None


class Checkpoints:
    """The checkpoints in a folder, each named by its step; use it in `with`, or close it, to finish what is written.

    Of all that were saved the last `keep` stay, and the one with the best score. Raises InputError, one sentence with
    the remedy, for a folder that cannot be written.
    """

    def __init__(self, folder: Pathlike, config: Config, *, keep: int = 3) -> None:
        if keep < 1:
            raise ValueError(f"{keep} checkpoints to keep are too few; keep at least 1.")
        check_folder(folder)
        self.folder, self._config = Path(folder).absolute(), config
        import orbax.checkpoint as ocp
        from orbax.checkpoint.checkpoint_managers import AnyPreservationPolicy, BestN, LatestN

        best = BestN(get_metric_fn=lambda metrics: metrics["score"], n=1, keep_checkpoints_without_metrics=False)
        options = ocp.CheckpointManagerOptions(
            preservation_policy=AnyPreservationPolicy([LatestN(keep), best]),
            # What a killed run left half-written.
            cleanup_tmp_directories=True,
        )
        handlers = {"state": ocp.StandardCheckpointHandler(), "progress": ocp.JsonCheckpointHandler()}
        self._manager = ocp.CheckpointManager(
            self.folder, options=options, item_names=("state", "progress"), item_handlers=handlers
        )

    @property
    def steps(self) -> list[int]:
        """Steps of the checkpoints that are there, in ascending order."""
        return sorted(self._manager.all_steps())

    def save(self, state: TrainState, loader: LoaderState, *, score: float | None = None) -> None:
        """Begin to write a checkpoint; it is complete after `wait`, at the latest.

        Raises InputError where this one, or the one before, cannot be written.
        """
        import orbax.checkpoint as ocp

        progress = {
            "format": FORMAT,
            "config": json.loads(self._config.to_json()),
            "loader": loader._asdict(),
            "score": score,
        }
        items = ocp.args.Composite(state=ocp.args.StandardSave(state), progress=ocp.args.JsonSave(progress))
        metrics = None if score is None else {"score": score}
        try:
            self._manager.save(int(state.step), args=items, metrics=metrics, force=True)
        except Exception as error:
            raise self._refused(error) from error

    def wait(self) -> None:
        """Return when everything is on the disk; raises InputError where it cannot be written."""
        try:
            self._manager.wait_until_finished()
            self._manager.check_for_errors()
        except Exception as error:
            raise self._refused(error) from error

    def restore(self, like: TrainState) -> Checkpoint | None:
        """The newest checkpoint that can be read, with the shapes and the sharding of `like`; None without any.

        Newer ones that cannot be read are warned of and removed, so that their steps can be saved again. Raises
        InputError for a checkpoint of another config, and where there are some but none can be read.
        """
        import orbax.checkpoint as ocp

        damaged: list[int] = []
        for step in reversed(self.steps):
            try:
                progress = self._read(step, progress=ocp.args.JsonRestore())["progress"]
                _check_format(progress, self.folder / str(step))
                _check_config(progress["config"], self._config, self.folder / str(step))
                state = self._read(step, state=ocp.args.StandardRestore(_abstract(like)))["state"]
            except InputError:
                raise
            # Whatever is wrong with the files: orbax and its storage have many words for it.
            except Exception:
                damaged.append(step)
                continue
            self._remove(damaged)
            return Checkpoint(state, LoaderState(**progress["loader"]), progress["score"])
        if damaged:
            raise InputError(
                f"None of the checkpoints in {self.folder} can be read; start anew in another folder, from "
                "last.safetensors beside it if you like."
            )
        return None

    def close(self) -> None:
        """Finish what is being written; raises InputError where it cannot be."""
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
            # The first error says more.
            if kind is None:
                raise

    def _read(self, step: int, **items: Any) -> Any:
        import orbax.checkpoint as ocp

        return self._manager.restore(step, args=ocp.args.Composite(**items))

    def _remove(self, steps: list[int]) -> None:
        for step in steps:
            text = f"{self.folder / str(step)} is damaged; it was removed, and training goes on from the one before."
            warnings.warn(text, FormatWarning, stacklevel=3)
            shutil.rmtree(self.folder / str(step))
        if steps:
            self._manager.reload()

    def _refused(self, error: Exception) -> InputError:
        return InputError(
            f"A checkpoint cannot be written to {self.folder} ({_reason(error)}); free some space or mend its "
            "permissions, then run again: the earlier ones are intact."
        )


def _reason(error: Exception) -> str:
    """The operating system's words where it is known that they are its; else the beginning of the error's."""
    code = error.errno if isinstance(error, OSError) else None
    if found := re.search(r"os_error_code='(\d+)'", str(error)):
        code = int(found[1])
    if code is not None:
        return os.strerror(code)
    return next((line[:200] for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _abstract(state: TrainState) -> TrainState:
    """Shapes, types and sharding: the checkpoint is read onto these devices, whatever it was saved from."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding), state)


def _check_format(progress: Any, path: Path) -> None:
    if progress.get("format") != FORMAT:
        raise InputError(
            f"{path} was written by another version of the package, whose optimizer state differs; finish that run "
            "with that version, or start a new run in another folder from its last.safetensors."
        )


def _check_config(saved: Any, config: Config, path: Path) -> None:
    mine = json.loads(config.to_json())
    if saved != mine:
        raise InputError(
            f"{path} is of another config: {first_difference(saved, mine)}; use the config of the first run, or "
            "another folder."
        )


def first_difference(saved: Any, wanted: Any, where: str = "config") -> str:
    """The first field in which two parsed JSON values differ, and both its values."""
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
