"""The bundled weights: `car_lite` trained only on simulated streets, scored on other streets and on real frames.

    python experiments/train_on_synthetic.py --workdir /tmp/synthetic [--kitti ../shared/kitti]

Each step is a `ciassd` command, printed before it runs. Re-run the same command to resume: scenes are kept and the
training resumes. Writes WORKDIR/car_lite.safetensors, the file bundled with the package. Results: README.md.
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
    """One training on its own scenes, from the weights of the cycle before."""

    scenes_seed: int
    split: str
    steps: int
    learning_rate: float


CYCLES = (Cycle(1, "train", 5000, 2e-3), Cycle(3, "trainval", 4500, 1e-3))


def run(*words: str | Path) -> None:
    """Run one `ciassd` command; exit with its code if that is not 0."""
    arguments = [str(word) for word in words]
    print("\n$ ciassd", *arguments, flush=True)
    code = ciassd(arguments)
    if code:
        sys.exit(code)


def simulate(folder: Path, frames: int, seed: int) -> None:
    """Write the scenes unless they are complete."""
    if not (folder / f"training/label_2/{frames - 1:06d}.txt").is_file():
        run("data", "synth", folder, "--frames", str(frames), "--seed", str(seed), "--overwrite")


def main() -> None:
    """Simulate, train, convert and score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workdir", type=Path, required=True)
    parser.add_argument("--kitti", type=Path, help="also score on these real frames")
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
