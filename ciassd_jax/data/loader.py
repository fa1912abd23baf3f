"""Batches of labelled scenes for training and validation: workers read and pad, the device augments.

Everything is a function of (seed, position in the stream). The stream is one epoch after the other, each in its own
order, and a batch may straddle two of them. So the loader's state is the number of batches taken, whatever the workers.
"""

from __future__ import annotations

import os
import signal
import threading
import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from multiprocessing.util import Finalize
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from ciassd_jax.config import Config
from ciassd_jax.data.augment import augment, keep_targets, scene_key
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.gt_sampling import ObjectDatabase, draw_objects, no_objects
from ciassd_jax.data.scenes import pad_frame
from ciassd_jax.data.workers import Watched
from ciassd_jax.types import Array, Boxes, SampledObjects, Scene

# Batches under way on the device while the caller uses one, and those ready in each worker, or in the reading thread.
_AHEAD, _READY = 2, 2
# Seeds, positions and checksums fit an int32, so that a state passes through any checkpoint.
_LIMIT = 2**31


class LoaderState(NamedTuple):
    """Where a loader is, as plain integers: `batch` batches of `batch_size` scenes were taken of the stream of `seed`.

    `frames` and `checksum` tell the data set by the number and names of its frames, and its database.
    """

    batch: int
    seed: int
    batch_size: int
    frames: int
    checksum: int


class HostScene(NamedTuple):
    """What the host knows of a scene before the device augments it; without `objects` it is not augmented."""

    scene: Scene
    objects: SampledObjects | None
    epoch: Int[Array, "*b"]


@dataclass(frozen=True)
class Stream:
    """The host's part: the scene at every position, as NumPy arrays. Workers can pickle it.

    With a seed the stream has no end; without one it is the frames once, in order.
    """

    dataset: Dataset
    config: Config
    seed: int | None = None
    augmented: bool = False
    database: ObjectDatabase | None = None

    def place(self, position: int) -> tuple[int, int]:
        """Epoch and frame of a position; after the end of an ordered pass frame -1."""
        epoch, index = divmod(position, len(self.dataset))
        if self.seed is None:
            return 0, -1 if epoch else index
        return epoch, int(epoch_order(self.seed, epoch, len(self.dataset))[index])

    def read(self, position: int) -> HostScene:
        """Read, draw and pad the scene of a position; raises InputError for a file that cannot be used."""
        epoch, index = self.place(position)
        frame = self.dataset.read(index) if index >= 0 else _empty_frame()
        scene = pad_frame(frame, index, self.config)
        return HostScene(scene, self._draw(frame, epoch, index), np.array(epoch, np.int32))

    def _draw(self, frame: Frame, epoch: int, index: int) -> SampledObjects | None:
        if self.seed is None or not self.augmented:
            return None
        if self.database is None:
            return no_objects(self.config)
        return draw_objects(self.database, frame.names, seed=self.seed, epoch=epoch, frame=index, config=self.config)

    def checksum(self) -> int:
        """A number that tells data sets apart by their frames' names and the database."""
        origin = self.database.fingerprint if self.database else ""
        return zlib.crc32("\n".join([*self.dataset.names, origin]).encode()) % _LIMIT


@lru_cache(maxsize=4)
def epoch_order(seed: int, epoch: int, frames: int) -> Int[np.ndarray, " frames"]:
    """The order of the frames in an epoch."""
    # A spawn key keeps these draws apart from those of pasting, which are seeded by (seed, epoch, frame, class).
    return np.random.default_rng(np.random.SeedSequence((seed, epoch), spawn_key=(0,))).permutation(frames)


def _empty_frame() -> Frame:
    boxes = Boxes.from_array(np.zeros((0, 7)))
    return Frame("", np.zeros((0, 4), np.float32), boxes, (), np.zeros(0, np.int64), None)


@dataclass(frozen=True)
class Rows:
    """The scenes of a stream that this process loads, by number: its share of every batch of `batch_size`."""

    stream: Stream
    batch_size: int
    shard: tuple[int, int] = (0, 1)

    @property
    def share(self) -> int:
        """How many scenes of every batch are this process's."""
        return self.batch_size // self.shard[1]

    @property
    def batches(self) -> int:
        """How many batches there are; so good as endless with a seed."""
        if self.stream.seed is not None:
            return _LIMIT
        return -(-len(self.stream.dataset) // self.batch_size)

    def __len__(self) -> int:
        return self.batches * self.share

    def __getitem__(self, number: int) -> HostScene:
        batch, row = divmod(number, self.share)
        return self.stream.read(batch * self.batch_size + self.shard[0] * self.share + row)


def host_batches(rows: Rows, *, workers: int = 0, start: int = 0) -> Any:
    """Grain's iterator over the host's part of batch `start` and those after it; close it, so that workers end.

    Without workers a thread of this process reads ahead.
    """
    import grain
    from absl import flags

    # Grain's workers ask for a flag, which only programs of absl parse.
    if not flags.FLAGS.is_parsed():
        flags.FLAGS.mark_as_parsed()
    ahead = grain.ReadOptions(num_threads=0 if workers else 1, prefetch_buffer_size=0 if workers else _READY)
    batches = grain.MapDataset.source(rows).batch(rows.share)[start:].to_iter_dataset(ahead)
    # Small leaves go through the pipe: a block of shared memory each would cost more.
    batches = grain.experimental.WithOptionsIterDataset(batches, grain.experimental.DatasetOptions(min_shm_size=2**16))
    options = grain.MultiprocessingOptions(num_workers=workers, per_worker_buffer_size=_READY)
    each = iter(batches.mp_prefetch(options, _begin_worker))
    return Watched(each) if workers else each


def _begin_worker(index: int, count: int) -> None:
    """Leave the device and Ctrl-C to the parent process, and end with it however it ends."""
    import multiprocessing

    def leave(parent: Any) -> None:
        parent.join()
        os._exit(1)

    jax.config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=leave, args=(multiprocessing.parent_process(),), daemon=True).start()


@partial(jax.jit, static_argnames="config")
def finish_scenes(host: HostScene, seed: Int[Array, ""], config: Config) -> Scene:
    """The device's part: augment a batch, or without objects only drop what is no target."""
    minimum, maximum = config.grid.minimum, config.grid.maximum

    def finish(scene: Scene, objects: SampledObjects | None, epoch: Array) -> Scene:
        if objects is None:
            return keep_targets(scene, minimum=minimum, maximum=maximum)
        return augment(scene_key(seed, epoch, scene.frame), scene, objects, config)

    return jax.vmap(finish)(*host)


class Batches(Iterator[Scene]):
    """Iterates over batched scenes on the device, some prepared ahead; use it in `with`, or close it, to end workers.

    Raises InputError for a frame that cannot be used, in words that name the file, and WorkerError for a dead
    worker. The state stays that of the batches taken, and the next batch starts the workers anew.
    """

    def __init__(self, rows: Rows, *, workers: int = 0, start: int = 0) -> None:
        self._rows, self._workers, self._taken = rows, workers, start
        self._host: list[Any] = []
        self._ready: deque[Scene] = deque()
        # Before multiprocessing ends the workers itself, which leaves shared memory behind.
        Finalize(self, _close_host, (self._host,), exitpriority=100)

    def __next__(self) -> Scene:
        if self._taken >= self._rows.batches:
            raise StopIteration
        try:
            self._prepare()
        except BaseException:
            self.close()
            raise
        self._taken += 1
        return self._ready.popleft()

    def _prepare(self) -> None:
        """Hand batches to the device until enough are under way."""
        if not self._host:
            self._host.append(host_batches(self._rows, workers=self._workers, start=self._taken))
        seed = np.array(self._rows.stream.seed or 0, np.int32)
        wanted = min(1 + _AHEAD, self._rows.batches - self._taken)
        while len(self._ready) < wanted:
            # A copy: the device may read an array until it is done, and these are in memory that workers share.
            host = jax.tree.map(np.array, next(self._host[0]))
            self._ready.append(finish_scenes(host, seed, self._rows.stream.config))

    @property
    def state(self) -> LoaderState:
        """Where the loader is; `set_state` of one with any number of workers and processes goes on from there."""
        stream, seed = self._rows.stream, self._rows.stream.seed
        frames, checksum = len(stream.dataset), stream.checksum()
        return LoaderState(self._taken, -1 if seed is None else seed, self._rows.batch_size, frames, checksum)

    def set_state(self, state: LoaderState) -> None:
        """Go on from a state; raises ValueError for one of another data set, database, seed or batch size."""
        given, mine = (dict(zip(one._fields, map(int, one), strict=True)) for one in (state, self.state))
        batch = given.pop("batch")
        other = [f"{name} {value} instead of {mine[name]}" for name, value in given.items() if value != mine[name]]
        if other or not 0 <= batch <= self._rows.batches:
            raise ValueError(
                f"The loader's state is of another stream ({', '.join(other) or f'batch {batch}'}); go on with the "
                "data set, database, seed and batch size that it was saved with."
            )
        self.close()
        self._taken = batch

    def close(self) -> None:
        """End the workers and drop what was prepared ahead."""
        self._ready.clear()
        _close_host(self._host)

    def __enter__(self) -> Batches:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _close_host(host: list[Any]) -> None:
    while host:
        host.pop().close()


def make_batches(
    dataset: Dataset,
    config: Config,
    *,
    seed: int,
    batch_size: int,
    database: ObjectDatabase | None = None,
    augmented: bool = True,
    workers: int = 0,
    start: int = 0,
    shard: tuple[int, int] = (0, 1),
) -> Batches:
    """An endless stream of batches [B, ...] for training, every epoch in an order of its own.

    Augmentation is as `config.data.augmentation` says; without a database nothing is pasted. `workers` processes read
    and pad (0: a thread does), and change nothing else. `start` is the number of batches to pass over. Of several
    processes each gives its (index, count) as `shard` and loads its rows of the same batches.

    Raises ValueError for numbers that fit no stream.
    """
    index, count = shard
    if not 0 <= seed < _LIMIT:
        raise ValueError(f"The loader's seed is {seed}; choose one from 0 to {_LIMIT - 1}.")
    if not 0 <= index < count or batch_size % count:
        raise ValueError(
            f"Process {index} of {count} has no share of {batch_size} scenes; number the processes from 0 and choose "
            "a batch size that is a multiple of their number."
        )
    stream = Stream(dataset, config, seed, augmented, database)
    return _make_batches(Rows(stream, batch_size, shard), workers, start)


def one_pass(dataset: Dataset, config: Config, *, batch_size: int, workers: int = 0) -> Batches:
    """Every frame once, in order and not augmented, for validation; the last batch is filled with empty scenes.

    Raises ValueError for numbers that fit no stream.
    """
    return _make_batches(Rows(Stream(dataset, config), batch_size), workers, 0)


def _make_batches(rows: Rows, workers: int, start: int) -> Batches:
    if not len(rows.stream.dataset):
        raise ValueError("The data set has no frames; check its split.")
    if rows.batch_size < 1 or workers < 0 or start < 0:
        raise ValueError(
            f"The loader cannot give batches of {rows.batch_size} from batch {start} with {workers} workers; the batch "
            "size must be at least 1, the others at least 0."
        )
    return Batches(rows, workers=workers, start=start)
