"""Export `predict` as one file: voxeliser, network and NMS as StableHLO, with the weights inside.

`load_exported` runs the file with the checks and results of a `Detector`. This runs it with jax, numpy and flatbuffers
alone, without this package:

    import json
    import zipfile
    import jax
    import numpy as np
    from jax import export

    with zipfile.ZipFile("car_lite.ciassd") as file:
        manifest = json.loads(file.read("manifest.json"))
        detect = jax.jit(export.deserialize(bytearray(file.read("program.bin"))).call)
    points, count, frustum = (np.zeros(one["shape"], one["type"]) for one in manifest["inputs"])
    cloud = np.fromfile("000010.bin", np.float32).reshape(-1, 4)  # x, y, z in metres, intensity
    points[0, : len(cloud)], count[0] = cloud, len(cloud)
    found = {name: value[0] for name, value in jax.device_get(detect(points, count, frustum)).items()}
    for label, score, box in zip(found["label"][: found["count"]], found["score"], found["boxes"]):
        print(manifest["class_names"][label], score, box.round(2))

The manifest gives the shapes, the config and the meaning of every output.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from ciassd_jax.config import Config
from ciassd_jax.formats.errors import InputError, Pathlike
from ciassd_jax.inference.artefact import (
    AGAIN,
    INPUTS,
    Artefact,
    Golden,
    config_of,
    describe,
    misfit,
    read_artefact,
    write_artefact,
)
from ciassd_jax.inference.detector import SMALLEST_BUCKET, CloudDetector, pad_clouds
from ciassd_jax.inference.predict import predict
from ciassd_jax.inference.programs import compile_program
from ciassd_jax.model.checks import variables_of
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.simulation import Lidar, open_synthetic
from ciassd_jax.types import Boxes, Counts, Detections, PointCloud, Variables

PLATFORMS = ("cpu", "cuda", "tpu")
# How much boxes (metres, radians) and scores may differ from the golden ones. In float32 the forms of the program for
# CPUs and for accelerators differ by 2e-6 on simulated streets; bfloat16 differs from float32 by 1e-2.
_TOLERANCE = {"float32": 1e-3, "float64": 1e-3, "bfloat16": 5e-2}
# Streets that are tried for the golden case.
_STREETS = 4


def export_predict(
    variables: Variables,
    config: Config,
    path: Pathlike,
    *,
    num_points: int = SMALLEST_BUCKET,
    batch: int = 1,
    platforms: Sequence[str] = PLATFORMS,
) -> Artefact:
    """Write `predict` for clouds [batch, num_points, 4] to a file, for all given platforms at once.

    The file is a zip of a manifest, the program and a golden case (`artefact.py`): a simulated street and what the
    program finds in it here, which `load_exported` compares. The program takes (points, count, frustum) and returns
    arrays by name; a frustum of zeros does not limit.

    Return what was written. Raises ValueError for numbers below 1 and unknown platforms, and InputError if the file
    cannot be written.
    """
    if num_points < 1 or batch < 1:
        raise ValueError(f"`num_points` is {num_points} and `batch` is {batch}; both must be at least 1.")
    if not platforms or not set(platforms) <= set(PLATFORMS):
        raise ValueError(f"`platforms` is {tuple(platforms)}; choose from {', '.join(PLATFORMS)}.")
    run = _program(variables, config)
    program = export.export(jax.jit(run), platforms=list(platforms))(*_shapes(num_points, batch))
    # The exported program itself if it runs here: then loading it finds it compiled.
    here = export.default_export_platform() in platforms
    golden = _golden(_compile(program.call if here else run, num_points, batch), config, num_points, batch)
    artefact = Artefact(describe(program, config), program, golden)
    write_artefact(path, artefact)
    return artefact


class ExportedDetector(CloudDetector):
    """An exported `predict`: a `Detector` of one size, which is called in the same way.

    A batch holds up to `batch_size` clouds of up to `num_points` points; empty clouds fill it. `manifest` describes the
    program.
    """

    def __init__(self, artefact: Artefact, program: Callable[..., Any]) -> None:
        self.manifest = artefact.manifest
        self.config = config_of(artefact.manifest)
        self.batch_size, self.num_points, _ = artefact.manifest["inputs"][0]["shape"]
        self._program = program

    def _run(self, clouds: Sequence[np.ndarray], frustum: np.ndarray) -> tuple[Detections, float]:
        if len(clouds) > self.batch_size:
            raise ValueError(
                f"{len(clouds)} clouds exceed the exported batch of {self.batch_size}; leave out `batch_size`, or "
                f"export with `batch` {len(clouds)}."
            )
        largest = max(map(len, clouds))
        if largest > self.num_points:
            raise ValueError(
                f"A cloud of {largest} points exceeds the {self.num_points} of the exported program; export it with "
                f"`num_points` {largest} or more (ciassd export --points)."
            )
        start = time.perf_counter()
        planes = np.zeros((self.batch_size, *ANYWHERE.shape), np.float32)
        planes[: len(clouds)] = frustum[: len(clouds)]
        found = jax.device_get(self._program(*pad_clouds(clouds, self.batch_size, self.num_points), planes))
        counts = Counts(**{name: found[name] for name in Counts._fields})
        boxes = Boxes.from_array(found["boxes"])
        return Detections(boxes, found["score"], found["label"], found["count"], counts), time.perf_counter() - start


def load_exported(path: Pathlike) -> ExportedDetector:
    """Read the file of `export_predict`, compile it for this device and compare its golden case.

    Raises InputError, with the remedy, for another or a damaged file, another version of the format, a program for
    other platforms, and a golden output that is not reproduced.
    """
    artefact = read_artefact(path)
    here, platforms = export.default_export_platform(), artefact.program.platforms
    if here not in platforms:
        raise InputError(
            f"{path} is a program for {', '.join(platforms)}, and JAX runs on {here} here; {AGAIN} and --platforms "
            f"{here}."
        )
    batch, num_points, _ = artefact.program.in_avals[0].shape
    program = _compile(artefact.program.call, num_points, batch)
    if difference := misfit(jax.device_get(program(*artefact.golden.inputs.values())), artefact.golden):
        raise InputError(f"{path} does not reproduce its golden output here: {difference}; {AGAIN} on this machine.")
    return ExportedDetector(artefact, program)


def _compile(call: Callable[..., Any], num_points: int, batch: int) -> jax.stages.Compiled:
    """Compile a function of (points, count, frustum) for the running platform."""
    what = f"the exported predict for {batch} x {num_points} points"
    return compile_program(jax.jit(call), *_shapes(num_points, batch), what=what)


def _program(variables: Variables, config: Config) -> Callable[..., dict[str, Any]]:
    """Return the function that is exported: plain arrays in, arrays by name out."""
    weights = jax.tree.map(jnp.asarray, variables_of(variables))
    config = config.for_inference()

    def run(points: jax.Array, count: jax.Array, frustum: jax.Array) -> dict[str, Any]:
        planes = jnp.where((frustum == 0).all(-1, keepdims=True), ANYWHERE, frustum)
        found = predict(weights, PointCloud(points, count), config, frustum=planes)
        own = {"boxes": found.boxes.to_array(), "score": found.score, "label": found.label, "count": found.count}
        return own | found.counts._asdict()

    return run


def _shapes(num_points: int, batch: int) -> tuple[jax.ShapeDtypeStruct, ...]:
    return (
        jax.ShapeDtypeStruct((batch, num_points, 4), np.float32),
        jax.ShapeDtypeStruct((batch,), np.int32),
        jax.ShapeDtypeStruct((batch, *ANYWHERE.shape), np.float32),
    )


def _golden(call: Callable[..., Any], config: Config, num_points: int, batch: int) -> Golden:
    """Run the program on simulated streets; keep the first with boxes that no threshold decides on.

    Another device finds these boxes too: they stay within the tolerance when the intensities change a little. If no
    street has such boxes, as without training, keep the last.
    """
    tolerance = _TOLERANCE[config.dtype]
    for index in range(_STREETS):
        points = _street(index, config, num_points)
        padded = np.zeros((batch, num_points, 4), np.float32)
        padded[:, : len(points)] = points
        inputs = (padded, np.full(batch, len(points), np.int32), np.zeros((batch, *ANYWHERE.shape), np.float32))
        outputs = jax.device_get(call(*inputs))
        golden = Golden(dict(zip(INPUTS, inputs, strict=True)), outputs, tolerance)
        changed = call(padded * np.array([1, 1, 1, 1 - tolerance], np.float32), *inputs[1:])
        if outputs["count"].all() and misfit(changed, golden) is None:
            break
    return golden


def _street(index: int, config: Config, num_points: int) -> np.ndarray:
    """Simulate a street on the config's ground, with its scale of intensities, thinned to `num_points` in range."""
    points = open_synthetic(seed=0, frames=_STREETS).read(index).points.copy()
    points[:, 2] += config.ground + Lidar().height
    points[:, 3] *= config.input.intensity_scale
    minimum, maximum = config.range
    points = points[((points[:, :3] >= minimum) & (points[:, :3] < maximum)).all(1)]
    return points[:: max(1, -(-len(points) // num_points))]
