"""`ciassd demo`: the pipeline on one scene, from points to a picture."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from ciassd_jax.detector import BUNDLED, Detector, FrameResult
from ciassd_jax.formats.points import read_points
from ciassd_jax.formats.writing import check_folder, replacing
from ciassd_jax.model.detector import init_variables
from ciassd_jax.predict_files import write_json
from ciassd_jax.presets import car_lite
from ciassd_jax.weights import Weights

UNTRAINED = """No trained weights are bundled yet, so this network is UNTRAINED: its boxes mean nothing.
It shows the pipeline only, from points to results; give trained weights with --weights."""


def run_demo(file: Path | None, weights: Weights | None, out: Path) -> None:
    """Detect in `file`, or in the bundled synthetic scene, print the result and write JSON and a picture to `out`."""
    check_folder(out)
    if weights is None:
        print(UNTRAINED)
    points, truth = _scene() if file is None else (read_points(file), None)
    name = "scene" if file is None else file.stem
    source = "a synthetic scene" if file is None else str(file)
    print(f"Detecting in {source} of {len(points)} points; the compiler needs a moment.", flush=True)
    if weights is None:
        config = car_lite()
        weights = Weights(init_variables(jax.random.key(0), config), config, [])
    result = Detector(weights.variables, weights.config).detect(points)
    print(result)
    written = [write_json(out / f"{name}.json", result)]
    title = f"ciassd demo: {source}" + ("" if weights.report else ", untrained weights")
    written += _picture(out / f"{name}.png", points, truth, result, title)
    print(f"Wrote {' and '.join(map(str, written))}.")


def _scene() -> tuple[np.ndarray, np.ndarray]:
    """Points and true cars of the bundled scene."""
    with np.load(BUNDLED / "scene.npz") as scene:
        return scene["points"], scene["boxes"]


def _picture(path: Path, points: np.ndarray, truth: np.ndarray | None, result: FrameResult, title: str) -> list[Path]:
    """Draw the scene where matplotlib is installed; the path, or nothing and a sentence that says what is missing."""
    try:
        from ciassd_jax.view.bev import plot_bev
    except ModuleNotFoundError as error:
        print(error)
        return []
    figure = plot_bev(points, result.boxes, truth, result.scores, result.labels, title=title)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    return [path]
