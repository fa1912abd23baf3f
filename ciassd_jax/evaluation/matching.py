"""Greedy matching of labelled and detected objects, for all frames and score thresholds at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int


class Candidates(NamedTuple):
    """E pairs that may be matched, in the order in which they are tried.

    An object chooses after all of its frame that come before it in the file, and takes its first pair whose
    detection is still there. `start` is where each object's pairs begin, `round` where each round of objects of
    different frames begins in `start`; both end with the end.
    """

    truth: Int[np.ndarray, " E"]
    detection: Int[np.ndarray, " E"]
    start: Int[np.ndarray, " S"]
    round: Int[np.ndarray, " R"]


def order_candidates(
    truth: Int[np.ndarray, " E"],
    detection: Int[np.ndarray, " E"],
    frame: Int[np.ndarray, " E"],
    cost: Float64[np.ndarray, " E"],
) -> Candidates:
    """Sort pairs for `assign`: by round, object and ascending `cost`; pairs of equal cost keep their order.

    `frame` is that of each pair and does not descend, nor does `truth`.
    """
    objects, first, owner = np.unique(truth, return_index=True, return_inverse=True)
    frames = frame[first]
    place = np.arange(len(objects)) - np.searchsorted(frames, frames)
    order = np.lexsort((cost, truth, place[owner]))
    sorted_truth = truth[order]
    start = np.flatnonzero(np.diff(sorted_truth, prepend=-1))
    rounds = np.searchsorted(np.sort(place), np.arange(place.max(initial=-1) + 2))
    return Candidates(sorted_truth, detection[order], np.append(start, len(order)), rounds)


def assign(
    candidates: Candidates, visible: Bool[np.ndarray, "T E"], num_detections: int
) -> tuple[Bool[np.ndarray, "T E"], Bool[np.ndarray, "T D"]]:
    """Match at T thresholds at once; returns the chosen pairs and the detections that are taken.

    Rounds follow one another, but in one round no two objects want the same detection, so that all frames and
    thresholds choose together: exactly the loop over frames and objects.
    """
    chosen = np.zeros(visible.shape, bool)
    taken = np.zeros((len(visible), num_detections), bool)
    for begin, end in zip(candidates.round[:-1], candidates.round[1:], strict=True):
        start = candidates.start[begin:end]
        pairs = slice(start[0], candidates.start[end])
        free = visible[:, pairs] & ~taken[:, candidates.detection[pairs]]
        place = np.where(free, np.arange(pairs.start, pairs.stop), pairs.stop)
        best = np.minimum.reduceat(place, start - start[0], axis=1)
        threshold, owner = np.nonzero(best < pairs.stop)
        pair = best[threshold, owner]
        chosen[threshold, pair] = True
        taken[threshold, candidates.detection[pair]] = True
    return chosen, taken


def pick_thresholds(scores: Float64[np.ndarray, " hits"], num_truths: int) -> Float64[np.ndarray, " T"]:
    """The scores, descending, at which recall comes closest to 0, 1/40, 2/40, ... of `num_truths` objects.

    The sum of fortieths is accumulated: exact ties occur, and its rounding decides them.
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
