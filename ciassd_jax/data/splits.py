"""The frames of a split, and whether their files exist."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_camera import IMAGE_SUFFIXES
from ciassd_jax.formats.lines import read_text
from ciassd_jax.formats.points import POINT_SUFFIXES

# Kind of file to the paths where a frame may have it, {} for the frame; the first that exists is used.
Places = Mapping[str, Sequence[str]]
# The split of all frames that have files.
ALL = "all"
# Bytes of the longest name of a frame; file systems allow 255 with the suffix.
_LONGEST = 200

NUM_TRAINING, NUM_TESTING = 7481, 7518
# The frames of Chen et al.'s train list as bits in base64, most significant first; val are the others.
_TRAIN_BITS = (
    "kX7iJqpeU8if8b+Z3Ufx1XSm7ja+GPjEQqbjXljC3Af0kTyni7miTiYycoxCGZMIlgCGOOXh821ArvMgOaBOUWq2W3iWzDQn+vDvN8DHFcbSXofp"
    "2sflRVfxmi0zlFe4Ic39bQCHbt75JhXs+4Czua9qY01HxHM1pIlqFv7cQMmP6s3I3oDh5TwpRoVqoEIhDc7zBOIM7PkZFUKBoKKAD7SkfgfZ/4Et"
    "DSbr9DFC6f7Ga25oiU/a2vk6Prnmk5B6HYtrUrksgFNJ2iuqj2rdVQ3vR7mpCBics/GYbdNlUM/LFnmUNu91YEjjaTBTlzv+YCEwn158t4Qa4hdB"
    "qaPBwRUd9oSYqfDmLSZOBf48KRusp7ccvkczHulMld9yRMDGRc56lRMHstiXVA448+zEMx5d3JD/kO1WpBr2OQXC13HDFLId3AXy65SlMes624s5"
    "0G3IKxAetQMpIvL+y5MxhNfEtjB7Ws/gK4BwttLzXL0mqAXtDTaKIM/tKA3MUFmOl15daMlV9Kg5Fbaa1KDtWsbNKRI2XsSvm2cvdlEVJMPPmswp"
    "8Frvn4KAB6mRT+4bewjdBgY8Xuo2Du5tGM9p9Hf/Mi1QaA/qssni8McH/KZk7X4PxKfHronnnVIl9cXLvvVnWRwpxYmrx2XlnpX1k5axX3UGD3vH"
    "FRsu6jdaiqZTILARBxTxAQdg/6Dn2JjwV3qNDGb86RMIwopcpJ4UsT9GGb42MYT8wBmIZtVVuU8IiXn2sjwF8eKz3BlZovTvBtVZFXYGl4M+SCCH"
    "kIER1IQXNsUbPOR6dMg5uG7tB8Bmj7piXCvZNCTYQ5RN/WqRhJdYq1dRO5AcJQgd2PqxPxJ6QiuhhFRhMNi9+YnJkxWudeaGVrcPYiSLGBip/mkm"
    "i5j/8/r8yNuiE8OOEpS837zP62VVHmB5wzFB5w/bDryMT5NFczNqvsZDG/IuYg7bS/+8DZco58HL3i/0L3u0irHiiBCI6s9jbYuW2RfSixF+QJSA"
    "VZDEyeh6FM3BiNtvVleqOz2Nxdda7eM9dJ/eiQVcf7GfQ5fhxDKDdQejlofojjYPghHh/TEJhWseh0IzgLXypSsdGNUjx+HeExGujkdJ0NnwWvgO"
    "aaGbLgQSQ5CaUWRiTfMzppBU1RaSroLFm9tfHDWGV2uR6VppRGzAGc4yaqJUAi7W+Wpbwk8b2YE1FO/cElSrqS1U8lGOCGYF5HjsyI8sKD53rDA6"
    "4YqCYF2CWhtcQakA"
)


def official_split(split: str) -> tuple[str, ...] | None:
    """Return the frames of KITTI's train, val, trainval or test list; None for another name."""
    train = np.unpackbits(np.frombuffer(base64.b64decode(_TRAIN_BITS), np.uint8), count=NUM_TRAINING).astype(bool)
    frames = {
        "train": np.flatnonzero(train),
        "val": np.flatnonzero(~train),
        "trainval": np.arange(NUM_TRAINING),
        "test": np.arange(NUM_TESTING),
    }
    return tuple(f"{frame:06d}" for frame in frames[split].tolist()) if split in frames else None


def with_suffixes(place: str, suffixes: Iterable[str]) -> tuple[str, ...]:
    """Return the paths of a place with each of the suffixes, in small and in capital letters."""
    return tuple(f"{place}{form}" for suffix in suffixes for form in (suffix, suffix.upper()))


def split_names(root: Path, split: str, folder: Path, places: Places) -> tuple[str, ...]:
    """Return the names of a split's frames (`listed_names`), each once and with its files in `folder`.

    Raises InputError for a split that is unknown, empty or names a frame twice, and for frames without their files.
    """
    names, source = listed_names(root, split, folder, places)
    if not names:
        raise InputError(f"{source} names no frame; check the path, or list them, one per line.")
    twice = repeated_names(names)
    if twice:
        raise InputError(f"{source}: {twice[0]}; list it once.")
    for kind, clause in _missing(folder, places, names).items():
        complete = sum(all(find_file(folder, paths, name) for paths in places.values()) for name in names)
        empty = " (empty files for frames without objects)" if kind == "label" else ""
        place = "a file and give its path as the split" if split == ALL else split_file(root, split)
        others = f", or list only the complete frames ({complete} of {len(names)}) in {place}" if complete else ""
        raise InputError(f"{source}: {clause}; copy them{empty}{others}.")
    return names


def listed_names(root: Path, split: str, folder: Path, places: Places) -> tuple[tuple[str, ...], str]:
    """Return the names of a split as listed, and their source: `split_file`, else KITTI's official list.

    The split "all" has every frame with a file in `folder`. Raises InputError for a split without a list, and for a
    list of other things than names.
    """
    path, official = split_file(root, split), official_split(split)
    if split == ALL:
        return present_names(folder, places), str(folder)
    if path.is_file():
        return _read_names(path), str(path)
    if official is None or "calibration" not in places:
        raise InputError(f"{path} does not exist; write it, one frame per line, or choose the split '{ALL}'.")
    return official, f"The official list of {split}"


def split_file(root: Path, split: str) -> Path:
    """Return the file that lists a split: `split` itself if it is a path, else ROOT/ImageSets/SPLIT.txt."""
    return Path(split) if _is_path(split) else root / "ImageSets" / f"{split}.txt"


def split_title(split: str) -> str:
    """Return the name of a split, for files that belong to it."""
    return Path(split).stem if _is_path(split) else split


def repeated_names(names: Sequence[str]) -> list[str]:
    """Return a clause for each name that occurs more than once."""
    return [f"frame {name} is listed {count} times" for name, count in Counter(names).items() if count > 1]


def present_names(folder: Path, places: Places) -> tuple[str, ...]:
    """Return the names of the frames that have any of their files, sorted."""
    return tuple(sorted({path.stem for paths in places.values() for path in present_paths(folder, paths)}))


def present_paths(folder: Path, places: Sequence[str]) -> list[Path]:
    """Return the files of all frames in these places, sorted; names that start with a dot are no data."""
    paths = {path for place in places for path in folder.glob(place.format("*"))}
    return sorted(path for path in paths if not path.name.startswith("."))


def same_stem(paths: Sequence[Path]) -> tuple[Path, Path] | None:
    """Return the first two paths that differ only in their suffix, or None."""
    by_stem: dict[Path, Path] = {}
    for path in paths:
        other = by_stem.setdefault(path.with_suffix(""), path)
        if other is not path:
            return other, path
    return None


def find_file(folder: Path, places: Sequence[str], name: str) -> Path | None:
    """Return the first of the places where the frame's file exists, or None."""
    return next((path for place in places if (path := folder / place.format(name)).is_file()), None)


def present_files(name: str, *, folder: Path, places: Places) -> tuple[Path, ...]:
    """Return the files of a frame that exist, at most one of each kind."""
    found = (find_file(folder, paths, name) for paths in places.values())
    return tuple(path for path in found if path is not None)


def missing_files(folder: Path, places: Places, names: Sequence[str]) -> list[str]:
    """Return a clause for each kind of file that frames lack."""
    return list(_missing(folder, places, names).values())


def _missing(folder: Path, places: Places, names: Sequence[str]) -> dict[str, str]:
    """Return a clause by kind of file that frames lack."""
    clauses = {}
    for kind, paths in places.items():
        lacking = [name for name in names if find_file(folder, paths, name) is None]
        if lacking:
            shown = ", ".join(lacking[:3]) + (", ..." if len(lacking) > 3 else "")
            wanted = f"{len(lacking)} of {len(names)} frames have no {kind} {describe_places(folder, paths)}"
            clauses[kind] = f"{wanted} ({shown})"
    return clauses


def describe_places(folder: Path, places: Sequence[str]) -> str:
    """Return the paths of a frame NAME in these places, for messages."""
    suffixes: dict[str, dict[str, None]] = {}
    for place in places:
        stem, _, suffix = place.partition("{}")
        suffixes.setdefault(stem, {})[suffix.lower()] = None
    return " or ".join(f"{folder / stem / 'NAME'}{' or '.join(each)}" for stem, each in suffixes.items())


def _is_path(split: str) -> bool:
    return len(Path(split).parts) > 1 or split.lower().endswith(".txt")


def _read_names(path: Path) -> tuple[str, ...]:
    """Read a list of names, one per line, with or without the suffixes of their files."""
    names = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    for name in names:
        if name.startswith(".") or len(name.encode()) > _LONGEST or set(name) & set("/\\\0"):
            what = "write the names of the frames' files without folders, one per line; none starts with a dot"
            raise InputError(f"{path}: {name[:40]!r} does not name a frame; {what}.")
    suffixes = (*POINT_SUFFIXES, ".txt", *IMAGE_SUFFIXES)
    return tuple(Path(name).stem if Path(name).suffix.lower() in suffixes else name for name in names)
