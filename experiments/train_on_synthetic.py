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

FRAMES, HELD_OUT, HELD_OUT_SEED = 2000, 200, 2
TRAINING = "--preset car_lite --batch-size 2 --evaluate-every 0 --seed 0"


class Cycle(NamedTuple):
    """One training from the weights of the one before, on scenes of its own."""

    scenes_seed: int
    split: str
    steps: int
    learning_rate: float


CYCLES = (Cycle(1, "train", 5000, 2e-3), Cycle(3, "trainval", 4500, 1e-3))


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
    simulate(held_out, HELD_OUT, HELD_OUT_SEED)
    start: tuple[str | Path, ...] = ()
    for number, cycle in enumerate(CYCLES, 1):
        scenes, training = (options.workdir / f"{name}_{number}" for name in ("scenes", "training"))
        simulate(scenes, FRAMES, cycle.scenes_seed)
        rates = ("--steps", str(cycle.steps), "--learning-rate", str(cycle.learning_rate))
        run("train", "--data", scenes, "--split", cycle.split, "--workdir", training, *TRAINING.split(), *rates, *start)
        last = training / "last.safetensors"
        start = ("--init-from", last)
    run("convert", last, weights, "--half")
    run("eval", "--weights", weights, "--data", held_out, "--split", "trainval")
    if options.kitti is not None:
        run("eval", "--weights", weights, "--data", options.kitti)


if __name__ == "__main__":
    main()
