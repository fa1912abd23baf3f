"""The bundled weights: `car_lite` trained on synthetic scenes alone, scored on others and on real frames.

    python experiments/train_on_synthetic.py --workdir /tmp/synthetic [--kitti ../shared/kitti]

Each part is a command of `ciassd`, printed before it runs. Started again it goes on: the scenes are kept, the training
resumes. Writes WORKDIR/car_lite.safetensors; the one in the package is such a file. Results: README.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

from ciassd_jax.cli import main as ciassd


class Cycle(NamedTuple):
    """A training: the seed of its streets, the frames of them, steps, peak of the learning rate."""

    seed: int
    split: str
    steps: int
    learning_rate: float


# The second goes on from the first on other streets. The first leaves its split val to look at.
CYCLES = (Cycle(1, "train", 5000, 2e-3), Cycle(3, "trainval", 2000, 1e-3))
FRAMES = 2000
HELD_OUT, HELD_OUT_SEED = 200, 2
TRAINING = "--preset car_lite --batch-size 2 --evaluate-every 0 --seed 0"


def run(*words: str | Path) -> None:
    """Run one command of `ciassd`; the program ends with its exit code where that is not 0."""
    arguments = [str(word) for word in words]
    print("\n$ ciassd", *arguments, flush=True)
    code = ciassd(arguments)
    if code:
        sys.exit(code)


def simulate(folder: Path, frames: int, seed: int) -> None:
    """Write the scenes, unless all are there."""
    if not (folder / f"training/label_2/{frames - 1:06d}.txt").is_file():
        run("data", "synth", folder, "--frames", str(frames), "--seed", str(seed), "--overwrite")


def main() -> None:
    """Simulate, train, convert, score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workdir", type=Path, required=True)
    parser.add_argument("--kitti", type=Path, help="real frames to score too")
    options = parser.parse_args()

    held_out, weights = options.workdir / "held_out", options.workdir / "car_lite.safetensors"
    start: tuple[str | Path, ...] = ()
    for cycle in CYCLES:
        scenes, workdir = (options.workdir / f"{name}_{cycle.seed}" for name in ("scenes", "training"))
        simulate(scenes, FRAMES, cycle.seed)
        numbers = ("--steps", str(cycle.steps), "--learning-rate", str(cycle.learning_rate), "--split", cycle.split)
        run("train", "--data", scenes, "--workdir", workdir, *numbers, *TRAINING.split(), *start)
        start = ("--init-from", workdir / "last.safetensors")
    run("convert", workdir / "last.safetensors", weights, "--half")
    simulate(held_out, HELD_OUT, HELD_OUT_SEED)
    run("eval", "--weights", weights, "--data", held_out, "--split", "trainval")
    if options.kitti is not None:
        run("eval", "--weights", weights, "--data", options.kitti)


if __name__ == "__main__":
    main()
