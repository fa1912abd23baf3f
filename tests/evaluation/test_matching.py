"""Greedy matching at many thresholds at once against its plain loop, and the choice of thresholds."""

import numpy as np
import pytest

from ciassd_jax.evaluation.matching import assign, order_pairs, pick_thresholds


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_the_plain_loop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    num_frames, per_frame, thresholds = 12, 6, np.linspace(1, 0, 7)
    edges = rng.random((num_frames, per_frame, per_frame)) < 0.4
    frame, truth, detection = np.nonzero(edges)
    truth, detection = truth + per_frame * frame, detection + per_frame * frame
    # Few values, so that ties are common.
    wish = rng.integers(0, 3, len(truth)).astype(float)
    score = rng.random(num_frames * per_frame)
    ordered = order_pairs(truth, detection, frame, wish)
    visible = score[ordered.detection] >= thresholds[:, None]
    chosen, taken = assign(ordered, visible, len(score))
    for row, threshold in enumerate(thresholds):
        used: set[int] = set()
        pairs = set()
        for wanting in range(num_frames * per_frame):
            mine = [(wish[e], detection[e]) for e in np.flatnonzero(truth == wanting)]
            free = [(w, d) for w, d in mine if score[d] >= threshold and d not in used]
            if free:
                used.add(min(free)[1])
                pairs.add((wanting, min(free)[1]))
        ours = set(zip(ordered.truth[chosen[row]], ordered.detection[chosen[row]], strict=True))
        assert ours == pairs
        assert set(np.flatnonzero(taken[row])) == used


def test_nothing_to_match() -> None:
    none = np.zeros(0, np.int64)
    ordered = order_pairs(none, none, none, np.zeros(0))
    chosen, taken = assign(ordered, np.ones((3, 0), bool), 4)
    assert (chosen.shape, taken.sum()) == ((3, 0), 0)


def test_thresholds_follow_recall() -> None:
    scores = np.random.default_rng(0).permutation(1000) / 1000
    picked = pick_thresholds(scores, 1000)
    assert len(picked) == 41
    assert picked[-1] == 0
    # At each of them recall is within half an object of the next fortieth.
    recall = np.array([(scores >= threshold).mean() for threshold in picked])
    np.testing.assert_allclose(recall[1:], np.arange(1, 41) / 40, atol=0.0006)


def test_thresholds_of_few_objects_are_all_scores() -> None:
    assert pick_thresholds(np.array([0.2, 0.9, 0.5]), 3).tolist() == [0.9, 0.5, 0.2]
    assert pick_thresholds(np.array([0.2, 0.9, 0.5]), 400).tolist() == [0.9, 0.2]
    assert pick_thresholds(np.zeros(0), 5).tolist() == []


def test_fortieths_are_accumulated() -> None:
    """Twenty of them exceed one half by a rounding, so that of 181 scores the 91st is taken and not the 90th."""
    picked = pick_thresholds(np.arange(181, 0, -1.0), 181)
    assert 91 in picked
    assert 92 not in picked


def test_a_tie_is_taken() -> None:
    """The sixth of 260 scores lies before 1/40 by exactly as much as the next behind it."""
    assert pick_thresholds(np.arange(260, 0, -1.0), 260)[:2].tolist() == [260, 255]
