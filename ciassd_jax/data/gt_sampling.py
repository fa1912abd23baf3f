"""The ground-truth database: the objects of a data set with their points, to be pasted into its scenes (SPEC 2.1, 2.3).

One file: a magic number, the points (x, y, z minus the centre of their box, intensity) as float32, one record per
object, a JSON footer, and the footer's length in 8 bytes. All numbers are little-endian.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from ciassd_jax.config import ClassConfig, Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes
from ciassd_jax.formats.writing import replacing
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes, SampledObjects

_MAGIC = b"ciassd objects 1"
_POINT = np.dtype(("<f4", 4))
# `name` is an index into the footer's names, `frame` and `row` are the object's place in the data set, and `first` and
# `count` those of its points in the file.
_OBJECT = np.dtype(
    [
        ("box", "<f8", 7),
        ("name", "<i4"),
        ("difficulty", "<i4"),
        ("frame", "<i4"),
        ("row", "<i4"),
        ("first", "<i8"),
        ("count", "<i8"),
    ]
)
_LENGTH = np.dtype("<u8")
_REMEDY = "build it again with `ciassd data prepare`"


@dataclass(frozen=True, eq=False)
class ObjectDatabase:
    """Every object of a data set: one record of `objects` each; `points` stay in the file until they are read.

    Workers can pickle it: they map the file themselves.
    """

    path: Path
    fingerprint: str
    names: tuple[str, ...]
    objects: np.ndarray
    points: Float32[np.ndarray, "M 4"]

    def __reduce__(self) -> tuple[Any, ...]:
        return open_database, (self.path, self.fingerprint)


def fingerprint_of(dataset: Dataset) -> str:
    """What a database is made of, as a hash: the frames' names, the text of labels and calibration, sizes of clouds.

    Frames that come from no files are read.
    """
    digest = hashlib.sha256()
    for index, name in enumerate(dataset.names):
        digest.update(f"{name}\n".encode())
        for path in dataset.sources(index):
            digest.update(f"{path.name} {path.stat().st_size}\n".encode())
            digest.update(read_bytes(path) if path.suffix == ".txt" else b"")
        if not dataset.sources(index):
            frame = dataset.read(index)
            digest.update(f"{frame.names} {frame.points.shape}\n".encode() + frame.boxes.to_array().tobytes())
    return digest.hexdigest()


def build_database(dataset: Dataset, path: Pathlike, progress: Callable[[range], Iterable[int]] = iter) -> None:
    """Write the database of every object of the data set, whatever its class, difficulty and number of points.

    An object has the points strictly inside its box. The file is written frame by frame and appears whole or not at
    all; `progress` may be tqdm. Raises InputError for a frame that cannot be read and a file that cannot be written.
    """
    fingerprint, total = fingerprint_of(dataset), 0
    names: dict[str, int] = {}
    records: list[tuple] = []
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(_MAGIC)
        for index in progress(range(len(dataset))):
            frame = dataset.read(index)
            inside = points_in_boxes(frame.points, frame.boxes)
            for row, box in enumerate(frame.boxes.to_array()):
                points = frame.points[inside[row]]
                offset = points[:, :3] - box[:3]
                stream.write(np.concatenate([offset, points[:, 3:]], 1).astype(_POINT.base).tobytes())
                name = names.setdefault(frame.names[row], len(names))
                records.append((box, name, frame.difficulty[row], index, row, total, len(points)))
                total += len(points)
        stream.write(np.array(records, _OBJECT).tobytes())
        footer = {"fingerprint": fingerprint, "names": list(names), "objects": len(records), "points": total}
        text = json.dumps(footer).encode()
        stream.write(text + np.array(len(text), _LENGTH).tobytes())


def open_database(path: Pathlike, fingerprint: str) -> ObjectDatabase:
    """Map a database; `fingerprint` is that of the data set it must come from.

    Raises InputError, one sentence with the remedy, for a file that is missing, no database, cut short or stale.
    """
    content = read_bytes(path, len(_MAGIC))
    if content != _MAGIC:
        raise InputError(f"{path} is no ground-truth database of this version; {_REMEDY}.")
    footer = _read_footer(Path(path))
    if footer is None:
        raise InputError(f"{path} is damaged or cut short; {_REMEDY}.")
    if footer["fingerprint"] != fingerprint:
        raise InputError(f"{path} is stale: frames, labels or clouds differ from those it was made of; {_REMEDY}.")
    objects = np.fromfile(path, _OBJECT, footer["objects"], offset=len(_MAGIC) + footer["points"] * _POINT.itemsize)
    shape = (footer["points"], 4)
    # Nothing cannot be mapped.
    empty = np.zeros(shape, np.float32)
    points = np.memmap(path, "<f4", "r", len(_MAGIC), shape) if footer["points"] else empty
    return ObjectDatabase(Path(path), fingerprint, tuple(footer["names"]), objects, points)


def _read_footer(path: Path) -> dict[str, Any] | None:
    """The footer, or None unless it accounts for every byte of the file."""
    size, tail = path.stat().st_size, _LENGTH.itemsize
    with open(path, "rb") as stream:
        stream.seek(max(size - tail, 0))
        length = int.from_bytes(stream.read(tail), "little")
        if length > size - tail:
            return None
        stream.seek(size - tail - length)
        text = stream.read(length)
    try:
        footer = {key: json.loads(text)[key] for key in ("fingerprint", "names", "objects", "points")}
        content = footer["points"] * _POINT.itemsize + footer["objects"] * _OBJECT.itemsize
    except (ValueError, TypeError, KeyError):
        return None
    return footer if size == len(_MAGIC) + content + length + tail else None


def no_objects(config: Config) -> SampledObjects:
    """Nothing to paste, in the shapes of the config: for a scene that is not augmented, or has no database."""
    label = np.repeat(
        np.arange(len(config.classes), dtype=np.int32), [2 * one.gt_sampling_up_to for one in config.classes]
    )
    slots, capacity = len(label), config.data.max_gt_sampling_points
    return SampledObjects(
        boxes=Boxes(np.zeros((slots, 3), np.float32), np.zeros((slots, 3), np.float32), np.zeros(slots, np.float32)),
        label=label,
        valid=np.zeros(slots, bool),
        points=np.zeros((capacity, 4), np.float32),
        owner=np.full(capacity, slots, np.int32),
        wanted=np.zeros(len(config.classes), np.int32),
        cut=np.array(0, np.int32),
    )


def draw_objects(
    database: ObjectDatabase, names_in_scene: Sequence[str], *, seed: int, epoch: int, frame: int, config: Config
) -> SampledObjects:
    """Draw what may be pasted into a scene with objects of these types, as NumPy arrays (SPEC 2.3).

    Of every class `gt_sampling_up_to` minus the objects of exactly its name are wanted, and up to twice as many are
    drawn for the two rounds, none twice. The draw depends on (seed, epoch, frame) alone, none of them negative, so that
    workers and resumed runs agree. The released code walks a shuffled list of the database instead: it uses objects
    more evenly, but what a scene gets depends on which worker asks when (SPEC 14.5).
    """
    objects, switches = no_objects(config), config.data.augmentation
    if not switches.gt_sampling:
        return objects
    drawn = np.full(len(objects.label), -1)
    for label, one in enumerate(config.classes):
        wanted = max(one.gt_sampling_up_to - names_in_scene.count(one.name), 0)
        eligible = eligible_objects(database, one, difficulty_filter=switches.difficulty_filter)
        chance = np.random.default_rng((seed, epoch, frame, label))
        chosen = chance.choice(eligible, min(2 * wanted, len(eligible)), replace=False)
        slots = np.flatnonzero(objects.label == label).reshape(2, -1)[:, :wanted].ravel()
        drawn[slots[: len(chosen)]] = chosen
        objects.wanted[label] = wanted
    _fill(objects, database, drawn)
    return objects


def eligible_objects(database: ObjectDatabase, one: ClassConfig, *, difficulty_filter: bool) -> Int[np.ndarray, " E"]:
    """The database's objects of exactly the class's name with enough points and, if filtered, of some difficulty."""
    if one.name not in database.names:
        return np.zeros(0, np.int64)
    objects = database.objects
    fit = (objects["name"] == database.names.index(one.name)) & (objects["count"] >= one.gt_sampling_min_points)
    return np.flatnonzero(fit & (objects["difficulty"] >= 0) if difficulty_filter else fit)


def _fill(objects: SampledObjects, database: ObjectDatabase, drawn: Int[np.ndarray, " O"]) -> None:
    """Write boxes and points of the drawn objects (-1 for none) in place; one whose points do not fit is cut."""
    filled = 0
    for slot in np.flatnonzero(drawn >= 0):
        record = database.objects[drawn[slot]]
        center, size, yaw = np.split(record["box"], [3, 6])
        points = database.points[record["first"] :][: record["count"]]
        if filled + len(points) > len(objects.points):
            objects.cut[...] += 1
            continue
        for leaf, value in zip(objects.boxes, (center, size, yaw[0]), strict=True):
            leaf[slot] = value
        rows = slice(filled, filled + len(points))
        objects.points[rows] = points
        objects.points[rows, :3] += center
        objects.owner[rows] = slot
        objects.valid[slot] = True
        filled = rows.stop
