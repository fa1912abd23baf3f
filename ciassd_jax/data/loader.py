"""Batches of labelled scenes for training: workers read and pad, the device augments.

A batch depends on the seed and its position in the stream alone. The stream is one epoch after the other, each in its
own order, and a batch may span two of them. The loader's state is therefore the number of batches taken, for any
number of workers.
"""

from __future__ import annotations

import os
import signal
import threading
import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.util import Finalize
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int, UInt8

from ciassd_jax.config import Config
from ciassd_jax.data.augment import augment, keep_targets, scene_key
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.gt_sampling import ObjectDatabase, no_objects, sample_objects
from ciassd_jax.data.notes import encode_warnings, give_new
from ciassd_jax.data.scenes import pad_frame
from ciassd_jax.data.workers import Watched
from ciassd_jax.formats.errors import collected_warnings, warn_of_file
from ciassd_jax.formats.points import check_intensity
from ciassd_jax.types import Array, SampledObjects, Scene

# Batches prepared ahead on the device, and in each worker or in the reading thread.
_AHEAD, _READY = 2, 2
# Seeds, positions and checksums fit an int32, so that any checkpoint can hold a state.
_LIMIT = 2**31


class LoaderState(NamedTuple):
    """The position of a loader as plain integers: `batch` batches of `batch_size` scenes were taken.

    `frames` and `checksum` identify the data set, by the number and names of its frames, and its database.
    """

    batch: int
    seed: int
    batch_size: int
    frames: int
    checksum: int


class HostScene(NamedTuple):
    """A scene before the device augments it; without `objects` it is not augmented. `notes` are its warnings."""

    scene: Scene
    objects: SampledObjects | None
    epoch: Int[Array, "*b"]
    notes: UInt8[Array, "*b bytes"]


@dataclass(frozen=True)
class Stream:
    """The host's part: the scene at every position, as NumPy arrays. Worker processes can pickle it."""

    dataset: Dataset
    config: Config
    seed: int
    augmented: bool = True
    database: ObjectDatabase | None = None

    def read(self, position: int) -> HostScene:
        """Read, sample and pad the scene at a position; raises InputError for a file that cannot be used."""
        epoch, place = divmod(position, len(self.dataset))
        index = int(epoch_order(self.seed, epoch, len(self.dataset))[place])
        with collected_warnings() as found:
            frame = self.dataset.read(index)
            scene = pad_frame(self._check_intensity(frame), index, self.config)
        objects = self._sample(frame.names, epoch, index)
        return HostScene(scene, objects, np.array(epoch, np.int32), encode_warnings(found))

    def _check_intensity(self, frame: Frame) -> Frame:
        source, scale = f"Frame {frame.name}", self.config.input.intensity_scale
        points, clipped = check_intensity(frame.points, scale, source)
        if clipped:
            warn_of_file(f"{source}: {clipped} intensities outside [0, {scale:g}] were clipped.", source)
        return frame._replace(points=points)

    def _sample(self, names: tuple[str, ...], epoch: int, index: int) -> SampledObjects | None:
        if not self.augmented:
            return None
        if self.database is None:
            return no_objects(self.config)
        return sample_objects(self.database, names, seed=self.seed, epoch=epoch, frame=index, config=self.config)

    def checksum(self) -> int:
        """Return a number that identifies the names of the frames and the database."""
        origin = self.database.fingerprint if self.database else ""
        return zlib.crc32("\n".join([*self.dataset.names, origin]).encode()) % _LIMIT


@lru_cache(maxsize=4)
def epoch_order(seed: int, epoch: int, frames: int) -> Int[np.ndarray, " frames"]:
    """Return the order of the frames in an epoch."""
    # The spawn key separates these draws from those of `sample_objects`, seeded by (seed, epoch, frame, class).
    return np.random.default_rng(np.random.SeedSequence((seed, epoch), spawn_key=(0,))).permutation(frames)


@dataclass(frozen=True)
class Rows:
    """The scenes of a stream that this process loads, by number: its share of every batch of `batch_size`."""

    stream: Stream
    batch_size: int
    shard: tuple[int, int] = (0, 1)

    @property
    def share(self) -> int:
        """The number of scenes of each batch that this process loads."""
        return self.batch_size // self.shard[1]

    def __len__(self) -> int:
        # Effectively unbounded.
        return _LIMIT * self.share

    def __getitem__(self, number: int) -> HostScene:
        batch, row = divmod(number, self.share)
        return self.stream.read(batch * self.batch_size + self.shard[0] * self.share + row)


def host_batches(rows: Rows, *, workers: int = 0, start: int = 0) -> Any:
    """Return Grain's iterator over the host's part of the batches from `start` on; close it to end its workers.

    Without workers a thread of this process reads ahead.
    """
    import grain
    from absl import flags

    # Grain's workers read a flag, which only programs of absl parse.
    if not flags.FLAGS.is_parsed():
        flags.FLAGS.mark_as_parsed()
    ahead = grain.ReadOptions(num_threads=0 if workers else 1, prefetch_buffer_size=0 if workers else _READY)
    batches = grain.MapDataset.source(rows).batch(rows.share)[start:].to_iter_dataset(ahead)
    # Small leaves go through the pipe, which is cheaper than a block of shared memory each.
    batches = grain.experimental.WithOptionsIterDataset(batches, grain.experimental.DatasetOptions(min_shm_size=2**16))
    options = grain.MultiprocessingOptions(num_workers=workers, per_worker_buffer_size=_READY)
    each = iter(batches.mp_prefetch(options, _begin_worker))
    return Watched(each) if workers else each


def _begin_worker(index: int, count: int) -> None:
    """Leave the device and Ctrl-C to the parent process, and exit with it."""
    import multiprocessing

    def leave(parent: Any) -> None:
        parent.join()
        os._exit(1)

    jax.config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=leave, args=(multiprocessing.parent_process(),), daemon=True).start()


@jax.jit
def finish_scenes(host: HostScene, seed: Int[Array, ""], config: Config) -> Scene:
    """Run the device's part: augment a batch, or without objects only drop boxes that are not targets."""
    minimum, maximum = config.range

    def finish(scene: Scene, objects: SampledObjects | None, epoch: Array) -> Scene:
        if objects is None:
            return keep_targets(scene, minimum=minimum, maximum=maximum)
        return augment(scene_key(seed, epoch, scene.frame), scene, objects, config)

    return jax.vmap(finish)(host.scene, host.objects, host.epoch)


class Batches(Iterator[Scene]):
    """An endless iterator over batched scenes on the device; a `with` block, or `close`, ends its workers.

    Gives one FormatWarning for each kind of problem with the frames. Raises InputError, which names the file, for a
    frame that cannot be used, and WorkerError for a worker that died. The state is then still that of the batches
    taken, and the next batch restarts the workers.
    """

    def __init__(self, rows: Rows, *, workers: int = 0, start: int = 0) -> None:
        self._rows, self._workers, self._taken = rows, workers, start
        self._host: list[Any] = []
        self._told: set[str] = set()
        self._ready: deque[Scene] = deque()
        # Runs before multiprocessing ends the workers itself, which would leave shared memory behind.
        Finalize(self, _close_host, (self._host,), exitpriority=100)

    def __next__(self) -> Scene:
        try:
            self._prepare()
        except BaseException:
            self.close()
            raise
        self._taken += 1
        return self._ready.popleft()

    def _prepare(self) -> None:
        """Hand batches to the device until enough are prepared."""
        if not self._host:
            self._host.append(host_batches(self._rows, workers=self._workers, start=self._taken))
        stream = self._rows.stream
        while len(self._ready) < 1 + _AHEAD:
            # Copied, because the device may still read an array after the workers reuse its shared memory.
            host = jax.tree.map(np.array, next(self._host[0]))
            give_new(host.notes, self._told, stacklevel=4)
            self._ready.append(finish_scenes(host, np.array(stream.seed, np.int32), stream.config))

    @property
    def state(self) -> LoaderState:
        """The position of the loader; `set_state` resumes from it with any number of workers and processes."""
        stream = self._rows.stream
        return LoaderState(self._taken, stream.seed, self._rows.batch_size, len(stream.dataset), stream.checksum())

    def set_state(self, state: LoaderState) -> None:
        """Resume from a state; raises ValueError for one of another data set, database, seed or batch size."""
        given, mine = (dict(zip(one._fields, map(int, one), strict=True)) for one in (state, self.state))
        batch = given.pop("batch")
        other = [f"{name} {value} instead of {mine[name]}" for name, value in given.items() if value != mine[name]]
        if other or not 0 <= batch < _LIMIT:
            raise ValueError(
                f"The loader's state is of another stream ({', '.join(other) or f'batch {batch}'}); resume with the "
                "data set, database, seed and batch size that it was saved with."
            )
        self.close()
        self._taken = batch

    def close(self) -> None:
        """End the workers and drop the batches prepared ahead."""
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
    batch_size: int | None = None,
    database: ObjectDatabase | None = None,
    augmented: bool = True,
    workers: int = 0,
    start: int = 0,
    shard: tuple[int, int] = (0, 1),
) -> Batches:
    """Return an endless iterator over batches [B, ...] for training; every epoch has its own order.

    Scenes are augmented as configured by `config.data.augmentation`, with ground-truth sampling only if there is a
    database. `batch_size` defaults to `config.schedule.batch_size`. `workers` processes read and pad (0: a thread
    does), which changes no batch. `start` is the number of batches to skip. Each of several processes passes its
    (index, count) as `shard` and loads its rows of the same batches.

    Raises ValueError for numbers out of range.
    """
    batch_size = config.schedule.batch_size if batch_size is None else batch_size
    index, count = shard
    if not 0 <= seed < _LIMIT:
        raise ValueError(f"The loader's seed is {seed}; choose one from 0 to {_LIMIT - 1}.")
    if not 0 <= index < count or batch_size % count:
        raise ValueError(
            f"Process {index} of {count} has no share of {batch_size} scenes; number the processes from 0 and choose "
            "a batch size that is a multiple of their number."
        )
    if not len(dataset):
        raise ValueError("The data set has no frames; check its split.")
    if batch_size < 1 or workers < 0 or start < 0:
        raise ValueError(
            f"The loader cannot give batches of {batch_size} from batch {start} with {workers} workers; the batch "
            "size must be at least 1, the others at least 0."
        )
    return Batches(
        Rows(Stream(dataset, config, seed, augmented, database), batch_size, shard), workers=workers, start=start
    )
