"""Overfit four real frames: every car of moderate difficulty should be found at a 3D IoU of 0.7.

    python experiments/overfit_four_frames.py --data ../shared/kitti --workdir /tmp/overfit

Checks that targets, losses, optimiser and detection fit together, without augmentation. The exit code is 1 if a car is
missed. `tests/training/test_overfit.py` is a small version. Results: README.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

from ciassd_jax import car_lite, make_batches, open_dataset
from ciassd_jax.training.loop import Intervals, fit
from ciassd_jax.training.validation import count_found

FRAMES = ("000010", "000038", "000095", "000120")
MODERATE = 1


def main() -> int:
    """Train on the four frames and count the cars that are found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--workdir", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1000)
    options = parser.parse_args()

    config = car_lite()
    config = replace(config, schedule=replace(config.schedule, total_steps=options.steps, learning_rate=1e-3))
    dataset = replace(open_dataset(options.data, "all"), names=FRAMES)
    batches = make_batches(dataset, config, seed=0, batch_size=len(FRAMES), augmented=False)
    start = time.perf_counter()
    state = fit(config, batches, options.workdir, intervals=Intervals(save=options.steps)).state
    print(f"{options.steps} steps in {time.perf_counter() - start:.0f} s")
    for name, hardest in (("moderate", MODERATE), ("any", None)):
        found, targets = count_found(state, dataset, config, hardest=hardest)
        print(f"{found} of {targets} cars of {name} difficulty are found at a 3D IoU of 0.7")
        if hardest == MODERATE:
            missed = targets - found
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
