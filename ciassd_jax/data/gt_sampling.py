"""Ground-truth sampling: a database of a data set's objects with their points, and the objects drawn for a scene.

The database is one file: a magic number, the points (x, y, z minus the centre of their box, intensity) as float32,
one record per object, a JSON footer, and the footer's length in 8 bytes. All numbers are little-endian.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from ciassd_jax.config import ClassConfig, Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.splits import split_title
from ciassd_jax.formats.errors import InputError, Pathlike, grouped_warnings, read_bytes
from ciassd_jax.formats.writing import replacing
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes, SampledObjects

_MAGIC = b"ciassd objects 1"
_POINT = np.dtype(("<f4", 4))
# `name` is an index into the footer's names; `frame` and `row` locate the object in the data set, `first` and `count`
# its points in the file.
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
    """The objects of a data set, one record of `objects` each; `points` are mapped from the file.

    Worker processes can pickle it: they map the file themselves, and do not read the data set.
    """

    path: Path
    fingerprint: str
    names: tuple[str, ...]
    objects: np.ndarray
    points: Float32[np.ndarray, "M 4"]

    def __reduce__(self) -> tuple[Any, ...]:
        return _map_database, (self.path, self.fingerprint)


def database_path(folder: Path, split: str) -> Path:
    """Return the usual file of a split's database in a folder."""
    return folder / f"objects_{split_title(split)}.bin"


def find_database(
    dataset: Dataset,
    places: Sequence[Path],
    track: Callable[[range], Iterable[int]] = iter,
    log: Callable[[str], object] = print,
) -> ObjectDatabase:
    """Open the first of these files that is the database of the data set; without any, build the last one.

    `track` wraps the iteration over the frames, for a progress bar; `log` is told when the database is built. Raises
    InputError for a frame that cannot be read and a file that cannot be written.
    """
    fingerprint = fingerprint_of(dataset)
    for place in places:
        try:
            return _map_database(place, fingerprint)
        except InputError:
            continue
    log(f"Collecting the objects for ground-truth sampling from {len(dataset)} frames into {places[-1]}.")
    _write_database(dataset, places[-1], fingerprint, track)
    return _map_database(places[-1], fingerprint)


def open_database(path: Pathlike, dataset: Dataset) -> ObjectDatabase:
    """Open the database of a data set.

    Raises InputError, one sentence with the remedy, for a file that is missing, not a database, cut short or stale.
    """
    return _map_database(Path(path), fingerprint_of(dataset))


def build_database(dataset: Dataset, path: Pathlike, track: Callable[[range], Iterable[int]] = iter) -> None:
    """Write the database of all objects of the data set, of any class, difficulty and number of points.

    An object has the points strictly inside its box. The file is written frame by frame and appears whole or not at
    all. `track` wraps the iteration over the frames, for a progress bar. Gives one FormatWarning for each kind of
    problem with the frames. Raises InputError for a frame that cannot be read and a file that cannot be written.
    """
    _write_database(dataset, Path(path), fingerprint_of(dataset), track)


def fingerprint_of(dataset: Dataset) -> str:
    """Return a hash of what a database is made of: names of frames, text of labels and calibration, sizes of clouds.

    The options of reading count too. Frames that do not come from files are read.
    """
    digest = hashlib.sha256(dataset.options.encode())
    for index, name in enumerate(dataset.names):
        digest.update(f"{name}\n".encode())
        for path in dataset.sources(index):
            digest.update(f"{path.name} {path.stat().st_size}\n".encode())
            digest.update(read_bytes(path) if path.suffix == ".txt" else b"")
        if not dataset.sources(index):
            frame = dataset.read(index)
            digest.update(f"{frame.names} {frame.points.shape}\n".encode() + frame.boxes.to_array().tobytes())
    return digest.hexdigest()


def _write_database(dataset: Dataset, path: Path, fingerprint: str, track: Callable[[range], Iterable[int]]) -> None:
    total = 0
    names: dict[str, int] = {}
    records: list[tuple] = []
    with grouped_warnings(), replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(_MAGIC)
        for index in track(range(len(dataset))):
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


def _map_database(path: Path, fingerprint: str) -> ObjectDatabase:
    """Map a database that has this fingerprint."""
    content = read_bytes(path, len(_MAGIC))
    if content != _MAGIC:
        raise InputError(f"{path} is not a ground-truth database of this version; {_REMEDY}.")
    footer = _read_footer(path)
    if footer is None:
        raise InputError(f"{path} is damaged or cut short; {_REMEDY}.")
    if footer["fingerprint"] != fingerprint:
        raise InputError(
            f"{path} is stale or of another split: its frames, labels or clouds differ from the data set's; {_REMEDY}."
        )
    objects = np.fromfile(path, _OBJECT, footer["objects"], offset=len(_MAGIC) + footer["points"] * _POINT.itemsize)
    shape = (footer["points"], 4)
    # An empty array cannot be mapped.
    empty = np.zeros(shape, np.float32)
    points = np.memmap(path, "<f4", "r", len(_MAGIC), shape) if footer["points"] else empty
    return ObjectDatabase(path, fingerprint, tuple(footer["names"]), objects, points)


def _read_footer(path: Path) -> dict[str, Any] | None:
    """Return the footer, or None unless it accounts for every byte of the file."""
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
    """Return no objects, in the shapes of the config, for a scene that is not augmented or has no database."""
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


def sample_objects(
    database: ObjectDatabase, names_in_scene: Sequence[str], *, seed: int, epoch: int, frame: int, config: Config
) -> SampledObjects:
    """Draw objects for a scene with objects of these types, as NumPy arrays (section 4.1).

    A class lacks `gt_sampling_up_to` minus the objects of its name in any case, without similar types, and up to twice
    that number is drawn, for two rounds without repetition. The draw depends on (seed, epoch, frame) alone, all
    non-negative, so that workers and resumed runs agree. The released code walks through a shuffled list of the
    database instead, which uses objects more evenly, but what a scene gets then depends on the order of the workers'
    requests.
    """
    objects, switches = no_objects(config), config.data.augmentation
    if not switches.gt_sampling:
        return objects
    drawn, present = np.full(len(objects.label), -1), Counter(map(str.lower, names_in_scene))
    for label, one in enumerate(config.classes):
        wanted = max(one.gt_sampling_up_to - present[one.name.lower()], 0)
        eligible = eligible_objects(database, one, difficulty_filter=switches.difficulty_filter)
        chance = np.random.default_rng((seed, epoch, frame, label))
        chosen = chance.choice(eligible, min(2 * wanted, len(eligible)), replace=False)
        slots = np.flatnonzero(objects.label == label).reshape(2, -1)[:, :wanted].ravel()
        drawn[slots[: len(chosen)]] = chosen
        objects.wanted[label] = wanted
    _fill(objects, database, drawn, config.input.intensity_scale)
    return objects


def eligible_objects(database: ObjectDatabase, one: ClassConfig, *, difficulty_filter: bool) -> Int[np.ndarray, " E"]:
    """Return the objects of the class's name with enough points and, if filtered, with a difficulty."""
    objects = database.objects
    named = [index for index, name in enumerate(database.names) if name.lower() == one.name.lower()]
    fit = np.isin(objects["name"], named) & (objects["count"] >= one.gt_sampling_min_points)
    return np.flatnonzero(fit & (objects["difficulty"] >= 0) if difficulty_filter else fit)


def _fill(objects: SampledObjects, database: ObjectDatabase, drawn: Int[np.ndarray, " O"], scale: float) -> None:
    """Write boxes and points of the drawn objects (-1: none) in place; an object whose points do not fit is cut."""
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
        # The loader refuses or counts such intensities in the frames that the points come from.
        objects.points[rows, 3] = np.clip(points[:, 3], 0, scale)
        objects.owner[rows] = slot
        objects.valid[slot] = True
        filled = rows.stop
