"""Commands around a network with its weights: predict, convert, info, demo."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ciassd_jax.cli.messages import UsageError, warnings_as_lines
from ciassd_jax.config import Config
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.formats.errors import InputError

if TYPE_CHECKING:
    from ciassd_jax.data.clouds import CloudFile
    from ciassd_jax.inference.detector import Detector
    from ciassd_jax.inference.results import FrameResult
    from ciassd_jax.inference.weights import Weights

Preset = Literal["car", "car_released", "car_lite", "three_class", "tiny"]


@dataclass(frozen=True)
class Predict:
    """Detect boxes in a cloud or a folder of clouds; writes OUT/NAME.json, and KITTI rows with a calibration."""

    path: Annotated[Path, tyro.conf.Positional]
    """A .bin, .npy, .npz or .pcd file, or a folder of them."""
    weights: Path
    """Weights: a file that `ciassd convert` wrote, a released .pth, or the name of bundled ones."""
    out: Path
    """Folder for the results."""
    calib: Path | None = None
    """Calibration file, or a folder of them; found by itself in a KITTI layout."""
    image_size: tuple[int, int] | None = None
    """Width and height of the image in pixels, for cameras that KITTI does not have."""
    preset: Preset | None = None
    """Use this preset instead of the config in the weights file; the parameters must fit."""
    dtype: Literal["float32", "bfloat16"] | None = None
    """Compute type of the network."""
    score_threshold: float | None = None
    """Class probability that a candidate needs (the preset's: 0.3)."""

    def run(self) -> int:
        from ciassd_jax.data.clouds import find_clouds
        from ciassd_jax.formats.writing import check_folder
        from ciassd_jax.inference.detector import Detector

        frames = find_clouds(self.path, calib=self.calib, image_size=self.image_size)
        weights = load_as(self.weights, self.preset)
        config = override(weights.config, self.dtype, self.score_threshold)
        check_folder(self.out)
        detector = Detector(weights.variables, config)
        if self.path.is_dir():
            self._folder(detector, frames)
        else:
            result, written = self._frame(detector, frames[0])
            print(f"{self.path}: {_table(result)}")
            print(f"Wrote {' and '.join(map(str, written))}.")
        return 0

    def _frame(self, detector: Detector, frame: CloudFile) -> tuple[FrameResult, list[Path]]:
        from ciassd_jax.formats.kitti_camera import frustum_of
        from ciassd_jax.formats.points import read_points
        from ciassd_jax.inference.results import write_result

        with warnings_as_lines(frame.cloud):
            result = detector.detect(read_points(frame.cloud), frustum=frustum_of(frame.camera))
            return result, write_result(result, frame.cloud.stem, self.out, frame.camera)

    def _folder(self, detector: Detector, frames: list[CloudFile]) -> None:
        from tqdm.auto import tqdm

        boxes, seconds = 0, 0.0
        with tqdm(frames, unit="frame") as bar:
            for frame in bar:
                result, _ = self._frame(detector, frame)
                best = f"best {result.scores.max():.2f}" if len(result) else "none"
                bar.write(f"{frame.cloud.name}: {len(result)} boxes, {best}, {result.seconds:.3f} s")
                boxes, seconds = boxes + len(result), seconds + result.seconds
        print(
            f"{len(frames)} frames, {boxes} boxes, {seconds / len(frames):.3f} s a frame without reading and "
            f"compilation; results are in {self.out}."
        )


@dataclass(frozen=True)
class Convert:
    """Convert the authors' published weights to a file of ours, with a report for every tensor.

    With --half also a file of ours to one of half the size.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """A released .pth (read without torch; nothing in it is run), or a .safetensors with the released names."""
    out: Annotated[Path, tyro.conf.Positional]
    """The file to write: OUT.safetensors."""
    half: bool = False
    """Write the kernels in float16."""

    def run(self) -> int:
        from ciassd_jax.formats.writing import check_folder
        from ciassd_jax.inference.weights import load_released_weights, load_weights, save_weights

        if self.out.suffix != ".safetensors":
            raise InputError(f"{self.out} must end in .safetensors; name the output so.")
        if self.out.resolve() == self.source.resolve():
            raise InputError(f"{self.out} is the input itself; name another output.")
        check_folder(self.out.parent)
        weights = (load_weights if self.half else load_released_weights)(self.source)
        for row in weights.report:
            print(f"{row.status:<10}  {row.source:<58}  {row.target:<50}  {row.shape}")
        save_weights(self.out, weights.variables, weights.config, half_kernels=self.half)
        used = sum(row.status != "counter" for row in weights.report)
        print(f"Wrote {self.out}: {used} tensors; {len(weights.report) - used} counters were not needed.")
        return 0


@dataclass(frozen=True)
class Info:
    """Show a config, its parameters, its arithmetic and the memory of the compiled program."""

    preset: Preset | None = None
    """A preset by name; `car` where nothing is given."""
    weights: Path | None = None
    """Or the config of a weights file."""
    points: int = 20000
    """Points per cloud that the program must hold."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        from ciassd_jax.inference import cost

        config = load_as(self.weights, self.preset).config if self.weights else PRESETS[self.preset or "car"]()
        facts = {
            "config": json.loads(config.to_json()),
            "parameters": cost.count_parameters(config),
            "flops": cost.count_flops(config),
            "memory": cost.compiled_memory(config, self.points),
        }
        if self.json:
            print(json.dumps(facts))
            return 0
        print(config.to_json())
        for part, count in facts["parameters"].items():
            print(f"{part:<10} {count:>12,} parameters  {facts['flops'][part] / 1e9:>8.2f} GFLOP")
        print("FLOPs are one scene's convolutions with the backbone at full capacity; real scenes fill less.")
        memory = facts["memory"]
        sizes = ", ".join(
            f"{name} unknown" if memory[name] is None else f"{name} {memory[name] / 1e6:.1f} MB"
            for name in ("arguments", "outputs", "temporaries")
        )
        print(f"Compiled for {memory['platform']} and up to {self.points} points: {sizes}.")
        return 0


@dataclass(frozen=True)
class Demo:
    """Run the whole pipeline on simulated streets, or on your file, and write results, pictures and a page in 3D."""

    file: Annotated[Path | None, tyro.conf.Positional] = None
    """A cloud of your own instead of simulated ones."""
    weights: Path = Path("car_lite")
    """Weights: a file, or the name of bundled ones, which were trained on simulated streets alone."""
    out: Path = Path("ciassd_demo")
    """Folder for the results."""
    scenes: int = 3
    """How many streets to simulate."""
    seed: int = 0
    """Other seeds, other streets."""

    def run(self) -> int:
        from ciassd_jax.cli.demo import run_demo

        if self.scenes < 1:
            raise UsageError(f"--scenes {self.scenes} shows nothing; ask for at least 1.")
        with warnings_as_lines(self.file or "simulated street"):
            run_demo(self.file, load_as(self.weights, None), self.out, scenes=self.scenes, seed=self.seed)
        return 0


def load_as(path: Path, preset: str | None) -> Weights:
    """The weights, with the preset's config in place of their own where one is asked for."""
    from ciassd_jax.inference.weights import check_fits, find_weights, load_weights

    weights = load_weights(find_weights(path))
    if preset is None:
        return weights
    config = PRESETS[preset]()
    check_fits(weights, config, path)
    return weights._replace(config=config)


def override(config: Config, dtype: Literal["float32", "bfloat16"] | None, threshold: float | None) -> Config:
    if dtype is not None:
        config = dataclasses.replace(config, dtype=dtype)
    if threshold is not None:
        try:
            detection = dataclasses.replace(config.detection, score_threshold=threshold)
        except ValueError as error:
            raise UsageError(str(error)) from error
        config = dataclasses.replace(config, detection=detection)
    return config


def _table(result: FrameResult) -> str:
    rows = [f"{len(result)} detections in {1e3 * result.seconds:.0f} ms"]
    if len(result):
        rows.append("  class       score       x       y       z  length   width  height     yaw")
    for label, score, box in zip(result.labels, result.scores, result.boxes, strict=True):
        rows.append(f"  {label:<10} {score:>6.3f} " + " ".join(f"{value:>7.2f}" for value in box))
    return "\n".join(rows)
