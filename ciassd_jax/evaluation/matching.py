"""Greedy matching of labelled and detected objects, for all frames and score thresholds at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int


class Pairs(NamedTuple):
    """E pairs of objects that may be matched, in the order in which they are tried.

    Objects of a frame choose in the order of the file, each the first of its pairs whose detection is still free.
    `start` is where each object's pairs begin, `round` where each round of one object per frame begins in `start`;
    both also hold their end.
    """

    truth: Int[np.ndarray, " E"]
    detection: Int[np.ndarray, " E"]
    start: Int[np.ndarray, " S"]
    round: Int[np.ndarray, " R"]


def order_pairs(
    truth: Int[np.ndarray, " E"],
    detection: Int[np.ndarray, " E"],
    frame: Int[np.ndarray, " E"],
    cost: Float64[np.ndarray, " E"],
) -> Pairs:
    """Sort pairs for `assign` by round, object and ascending `cost`; pairs of equal cost keep their order.

    `frame` is that of each pair; `frame` and `truth` are ascending.
    """
    objects, first, owner = np.unique(truth, return_index=True, return_inverse=True)
    frames = frame[first]
    place = np.arange(len(objects)) - np.searchsorted(frames, frames)
    order = np.lexsort((cost, truth, place[owner]))
    sorted_truth = truth[order]
    start = np.flatnonzero(np.diff(sorted_truth, prepend=-1))
    rounds = np.searchsorted(np.sort(place), np.arange(place.max(initial=-1) + 2))
    return Pairs(sorted_truth, detection[order], np.append(start, len(order)), rounds)


def assign(
    pairs: Pairs, visible: Bool[np.ndarray, "T E"], num_detections: int
) -> tuple[Bool[np.ndarray, "T E"], Bool[np.ndarray, "T D"]]:
    """Match at T thresholds at once; returns the chosen pairs and the matched detections.

    Rounds run one after the other. Within a round no two objects compete for a detection, so that all frames and
    thresholds are matched together, with the result of the loop over frames and objects.
    """
    chosen = np.zeros(visible.shape, bool)
    taken = np.zeros((len(visible), num_detections), bool)
    for begin, end in zip(pairs.round[:-1], pairs.round[1:], strict=True):
        start = pairs.start[begin:end]
        tried = slice(start[0], pairs.start[end])
        free = visible[:, tried] & ~taken[:, pairs.detection[tried]]
        place = np.where(free, np.arange(tried.start, tried.stop), tried.stop)
        best = np.minimum.reduceat(place, start - start[0], axis=1)
        threshold, owner = np.nonzero(best < tried.stop)
        pair = best[threshold, owner]
        chosen[threshold, pair] = True
        taken[threshold, pairs.detection[pair]] = True
    return chosen, taken


def pick_thresholds(scores: Float64[np.ndarray, " hits"], num_truths: int) -> Float64[np.ndarray, " T"]:
    """Return the scores, descending, at which recall is closest to 0, 1/40, 2/40, ... of `num_truths` objects.

    As in the devkit the fortieths are accumulated, because their rounding decides exact ties.
    """
    ordered = np.sort(scores)[::-1]
    picked, recall = [], 0.0
    for index, score in enumerate(ordered.tolist()):
        last = index == len(ordered) - 1
        left, right = (index + 1) / num_truths, (index + 2) / num_truths
        if last or right - recall >= recall - left:
            picked.append(score)
            recall += 1 / 40
    return np.array(picked, np.float64)
