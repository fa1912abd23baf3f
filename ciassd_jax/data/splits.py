"""The frames of a split, and whether their files exist."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ciassd_jax.formats.errors import InputError, read_bytes

# Kind of file to the paths where a frame may have it, {} for the frame; the first that exists is used.
Places = Mapping[str, Sequence[str]]
# The split of all frames that have files.
ALL = "all"

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
    missing = missing_files(folder, places, names)
    if missing:
        raise InputError(f"{source}: {missing[0]}; copy them, or list the others in {split_file(root, split)}.")
    return names


def listed_names(root: Path, split: str, folder: Path, places: Places) -> tuple[tuple[str, ...], str]:
    """Return the names of a split as listed, and their source: `ImageSets/SPLIT.txt`, else KITTI's official list.

    The split "all" has every frame with a file in `folder`. Raises InputError for a split without a list.
    """
    path, official = split_file(root, split), official_split(split)
    if split == ALL:
        return present_names(folder, places), str(folder)
    if path.is_file():
        return tuple(read_bytes(path).decode("utf-8-sig", errors="replace").split()), str(path)
    if official is None or "calibration" not in places:
        raise InputError(f"{path} does not exist; write it, one frame per line, or choose the split '{ALL}'.")
    return official, f"The official list of {split}"


def split_file(root: Path, split: str) -> Path:
    """Return the file that lists a split."""
    return root / "ImageSets" / f"{split}.txt"


def repeated_names(names: Sequence[str]) -> list[str]:
    """Return a clause for each name that occurs more than once."""
    return [f"frame {name} is listed {count} times" for name, count in Counter(names).items() if count > 1]


def present_names(folder: Path, places: Places) -> tuple[str, ...]:
    """Return the names of the frames that have any of their files, sorted."""
    paths = (path for patterns in places.values() for pattern in patterns for path in folder.glob(pattern.format("*")))
    return tuple(sorted({path.stem for path in paths}))


def find_file(folder: Path, places: Sequence[str], name: str) -> Path | None:
    """Return the first of the places where the frame's file exists, or None."""
    return next((path for place in places if (path := folder / place.format(name)).is_file()), None)


def present_files(name: str, *, folder: Path, places: Places) -> tuple[Path, ...]:
    """Return the files of a frame that exist, at most one of each kind."""
    found = (find_file(folder, paths, name) for paths in places.values())
    return tuple(path for path in found if path is not None)


def missing_files(folder: Path, places: Places, names: Sequence[str]) -> list[str]:
    """Return a clause for each kind of file that frames lack."""
    sentences = []
    for kind, paths in places.items():
        lacking = [name for name in names if find_file(folder, paths, name) is None]
        if lacking:
            shown = ", ".join(lacking[:3]) + (", ..." if len(lacking) > 3 else "")
            wanted = " or ".join(str(folder / path.format("NAME")) for path in paths)
            sentences.append(f"{len(lacking)} of {len(names)} frames have no {kind} {wanted} ({shown})")
    return sentences
