"""A config for a data set: classes, anchors, range and capacities, from the labels and clouds of its frames."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ciassd_jax.config import ClassConfig, Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.evaluation.active_sites import count_sites
from ciassd_jax.evaluation.fitted_grid import boxes_held, fit_grid
from ciassd_jax.evaluation.frame_check import in_view
from ciassd_jax.formats.errors import InputError, collected_warnings
from ciassd_jax.formats.points import fitting_scale
from ciassd_jax.ops.footprints import points_in_boxes

# Types that are never a class.
_NO_CLASS = ("dontcare", "misc")
# A class has at least this share of the objects and this number of them.
_LEAST_SHARE, _LEAST_OBJECTS = 0.05, 5
# Fewer objects do not tell the sizes of a class, and edges of this length in metres are of another unit.
_FEW_OBJECTS, _METRES = 20, 60.0
# Share of the frames that a capacity covers, and the quantile of the standard normal distribution for this share.
_COVERED, _DEVIATIONS = 0.995, 2.6
# Factor of the numbers of sites, for the rotations and scales of augmentation.
_ROOM = 1.1


class Suggestion(NamedTuple):
    """A config, and sentences on what was decided and what is left out."""

    config: Config
    notes: tuple[str, ...]


class _Labels(NamedTuple):
    """The objects of a frame, and an intensity that all but 1 % of its points have at most."""

    names: tuple[str, ...]
    boxes: Float[np.ndarray, "G 7"]
    intensity: float


def suggest_config(
    dataset: Dataset,
    base: Config,
    *,
    classes: Sequence[str] | None = None,
    track: Callable[[range], Iterable[int]] = iter,
) -> Suggestion:
    """Return `base` with the classes, range and capacities of a data set.

    The classes are the types with at least 5 % of the objects, or those given; case does not matter. Their anchors have
    the median size and the mean height of the labels. The range holds 99 % of their boxes, and a capacity covers 99.5 %
    of the frames. `track` wraps each of two passes over the frames, for a progress bar. Raises InputError for labels
    without such objects, and for a range with too many voxels.
    """
    labels = [_read_labels(dataset, index) for index in track(range(len(dataset)))]
    types = _count_types(labels)
    names = np.array([name.lower() for frame in labels for name in frame.names], np.str_)
    boxes = np.concatenate([frame.boxes for frame in labels])
    own = {name: boxes[names == name.lower()] for name in _choose_types(types, classes)}
    if (longest := float(np.median(np.concatenate([*own.values()])[:, 3:6].max(1)))) > _METRES:
        raise InputError(f"The objects are typically {longest:g} m long; write labels and clouds in metres.")
    intensity = float(_covering([frame.intensity for frame in labels]))
    config = replace(
        base,
        input=replace(base.input, intensity_scale=_suggest_scale(intensity, base)),
        classes=tuple(_suggest_class(name, mine, base) for name, mine in own.items()),
        grid=fit_grid(np.concatenate([*own.values()]), base),
    )
    (lowest, highest), low, high = base.detection.z_limits, config.grid.minimum[2], config.grid.maximum[2]
    config = replace(config, detection=replace(base.detection, z_limits=(min(low, lowest), max(high, highest))))
    config = _with_capacities(config, labels, dataset, track)
    notes = _class_notes(config, types), _size_notes(config, base, own, len(dataset)), _scale_notes(config, intensity)
    return Suggestion(config, sum(notes, ()))


def _read_labels(dataset: Dataset, index: int) -> _Labels:
    """Read a frame; objects without a volume and those that its camera cannot see are left out."""
    frame = dataset.read(index)
    boxes = np.asarray(frame.boxes.to_array())
    usable = np.asarray((boxes[:, 3:6] > 0).all(-1)) & in_view(frame)
    names = tuple(name for name, use in zip(frame.names, usable, strict=True) if use)
    intensity = np.quantile(frame.points[:, 3], 0.99, method="higher") if len(frame.points) else 0
    return _Labels(names, boxes[usable], float(intensity))


def _count_types(labels: Sequence[_Labels]) -> dict[str, int]:
    """Return the number of objects of each type, written as it mostly is, the most frequent type first."""
    written = Counter(name for frame in labels for name in frame.names if name.lower() not in _NO_CLASS)
    usual: dict[str, str] = {}
    types: Counter[str] = Counter()
    for name, count in written.most_common():
        types[usual.setdefault(name.lower(), name)] += count
    return dict(types.most_common())


def _choose_types(types: dict[str, int], classes: Sequence[str] | None) -> list[str]:
    """Return the given types as the labels write them, by default all with enough objects and at least one."""
    if not types:
        raise InputError("No frame has a labelled object; check the labels, or choose a split that has some.")
    if classes is None:
        least = max(_LEAST_SHARE * sum(types.values()), _LEAST_OBJECTS)
        return [name for name, count in types.items() if count >= least] or [*types][:1]
    usual = {name.lower(): name for name in types}
    if unknown := [name for name in classes if name.lower() not in usual]:
        raise InputError(f"No object is of the type {unknown[0]}; choose from {_listed(types)}.")
    return list(dict.fromkeys(usual[name.lower()] for name in classes))


def _suggest_class(name: str, boxes: Float[np.ndarray, "G 7"], base: Config) -> ClassConfig:
    """Return a class with its anchor, and thresholds that an anchor of this size reaches between the cells' centres."""
    length, width, height = np.median(boxes[:, 3:6], axis=0).round(2).clip(0.01).tolist()
    first = base.classes[0]
    # A box is on average a quarter of a cell from the nearest anchor.
    x, y = (size * base.backbone.stride / 4 for size in base.grid.voxel_size[:2])
    shared = max(length - x, 0) * max(width - y, 0)
    overlap = shared / (2 * length * width - shared)
    matched = round(20 * float(np.clip(overlap - 0.1, 0.3, first.matched))) / 20
    area = length * width / (first.length * first.width)
    return ClassConfig(
        name=name,
        length=length,
        width=width,
        height=height,
        center_z=round(float(boxes[:, 2].mean()) + base.input.z_shift, 2),
        matched=matched,
        unmatched=round(matched - 0.15, 2),
        support_threshold=round(min(area, 1) * first.support_threshold, 2),
        gt_sampling_up_to=first.gt_sampling_up_to,
    )


def _suggest_scale(intensity: float, base: Config) -> float:
    """Return the intensity to read as 1: the base config's if it serves, or else one that sensors use."""
    own = base.input.intensity_scale
    return own if intensity <= own else fitting_scale(intensity)


def _with_capacities(
    config: Config, labels: Sequence[_Labels], dataset: Dataset, track: Callable[[range], Iterable[int]]
) -> Config:
    """Return the config with capacities for the frames, the objects that sampling adds, and augmentation."""
    frames, objects = _measure(config, dataset, track)
    mean, variance = (
        sum(one.gt_sampling_up_to * of(mine, axis=0) for one, mine in zip(config.classes, objects, strict=True))
        for of in (np.mean, np.var)
    )
    max_points, max_voxels, *strided, out = (_tidy(_ROOM * amount) for amount in _covering(frames) + mean)
    # Two rounds are drawn for every object that is wanted; a sum of many is nearly normal.
    drawn = 2 * mean[0] + _DEVIATIONS * math.sqrt(2 * variance[0])
    first, *others = config.backbone.stages
    stages = (first, *(replace(stage, capacity=slots) for stage, slots in zip(others, strided, strict=True)))
    max_boxes = _tidy(float(_covering([_count_boxes(frame, config) for frame in labels])))
    return replace(
        config,
        grid=replace(config.grid, max_voxels=max_voxels),
        backbone=replace(config.backbone, stages=stages, out_capacity=out),
        data=replace(config.data, max_points=max_points, max_boxes=max_boxes, max_gt_sampling_points=_tidy(drawn)),
    )


def _measure(
    config: Config, dataset: Dataset, track: Callable[[range], Iterable[int]]
) -> tuple[Int[np.ndarray, "F S"], list[Int[np.ndarray, "O S"]]]:
    """Return the points, voxels and sites of every frame, and of every object of each class that may be sampled."""

    def amounts(points: Float[np.ndarray, "P 4"]) -> tuple[int, ...]:
        return len(points), *count_sites(points, config)

    label_of = config.labels_by_name(similar=False)
    frames, objects = [], [[amounts(np.zeros((0, 4), np.float32))] for _ in config.classes]
    for index in track(range(len(dataset))):
        # Its warnings were given when its labels were read.
        with collected_warnings():
            frame = dataset.read(index)
        frames.append(amounts(frame.points))
        for name, inside in zip(frame.names, np.asarray(points_in_boxes(frame.points, frame.boxes)), strict=True):
            label = label_of.get(name.lower())
            if label is not None and inside.sum() >= config.classes[label].gt_sampling_min_points:
                objects[label].append(amounts(frame.points[inside]))
    return np.array(frames), [np.array(mine[1:] or mine) for mine in objects]


def _count_boxes(frame: _Labels, config: Config) -> int:
    """Return the number of objects, with those that sampling adds."""
    present = Counter(name.lower() for name in frame.names)
    return len(frame.names) + sum(max(c.gt_sampling_up_to - present[c.name.lower()], 0) for c in config.classes)


def _covering(amounts: Sequence[float] | Int[np.ndarray, "F S"]) -> np.ndarray:
    """Return the least amount, of every column, that covers enough frames."""
    return np.quantile(amounts, _COVERED, axis=0, method="inverted_cdf")


def _tidy(amount: float) -> int:
    """Round up to two digits, and at least to tens."""
    step = 10 ** max(len(str(math.ceil(amount))) - 2, 1)
    return step * max(math.ceil(amount / step), 1)


def _listed(types: dict[str, int]) -> str:
    return ", ".join(f"{name} ({count})" for name, count in types.items())


def _class_notes(config: Config, types: dict[str, int]) -> tuple[str, ...]:
    notes = [
        f"Class {c.name} ({types[c.name]}): anchors of {c.length:g} x {c.width:g} x {c.height:g} m centred at "
        f"z = {c.center_z - config.input.z_shift:g} m."
        for c in config.classes
    ]
    notes += [
        f"Only {types[c.name]} objects of class {c.name}: its sizes and the range may not fit other frames."
        for c in config.classes
        if types[c.name] < _FEW_OBJECTS
    ]
    if others := {name: count for name, count in types.items() if name not in config.class_names}:
        remedy = "name a type as `classes` to learn it, or under `similar` of a class to count it as that one"
        notes.append(f"Left out: {_listed(others)}; {remedy}.")
    return tuple(notes)


def _size_notes(config: Config, base: Config, own: dict[str, np.ndarray], frames: int) -> tuple[str, ...]:
    extent = ", ".join(f"{axis} {low:g}..{high:g}" for axis, low, high in zip("xyz", *config.range, strict=True))
    held = boxes_held(np.concatenate([*own.values()]), config)
    capacities = ", ".join(map(str, config.backbone.capacities(config.grid.max_voxels)))
    notes = (
        f"Range {extent} m: it holds {held.sum()} of {len(held)} boxes.",
        f"Capacities for {_COVERED:.1%} of {frames} frames, and what augmentation adds: {config.data.max_points} "
        f"points, {config.data.max_boxes} boxes, {capacities} voxels and sites.",
    )
    if config.bev_channels == base.bev_channels:
        return notes
    return (*notes, f"With {config.grid.cells[2]} layers, weights that were trained with the base config do not fit.")


def _scale_notes(config: Config, intensity: float) -> tuple[str, ...]:
    scale = config.input.intensity_scale
    return () if scale == 1 else (f"Intensities reach {intensity:g}; {scale:g} is read as 1.",)
