"""`ciassd demo`: the pipeline on one scene, from points to a picture."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np

from ciassd_jax.config import car_lite
from ciassd_jax.detector import BUNDLED, Detector
from ciassd_jax.formats.errors import FormatError
from ciassd_jax.formats.points import read_points
from ciassd_jax.model.detector import init_variables
from ciassd_jax.predict_files import prepare_folder, write_atomically
from ciassd_jax.view.bev import plot_bev
from ciassd_jax.weights import Weights


def run_demo(file: Path | None, weights: Weights | None, out: Path) -> None:
    """Detect in `file`, or in the bundled synthetic scene, print the result and write JSON and a picture to `out`."""
    truth = None
    if file is None:
        scene = np.load(BUNDLED / "scene.npz")
        points, truth = scene["points"], scene["boxes"]
        print(f"A synthetic scene: {len(points)} points, {len(truth)} cars.")
    else:
        points = read_points(file)
    out = prepare_folder(out)
    if weights is None:
        print("No trained weights are bundled yet: this network is UNTRAINED. It shows that the whole pipeline runs;")
        print("its boxes mean nothing. Give trained weights with --weights.")
        config = car_lite()
        weights = Weights(init_variables(jax.random.key(0), config), config, [])
    result = Detector(weights.variables, weights.config).detect(points)
    print(result)
    write_atomically(out / "scene.json", json.dumps(result.to_dict()))
    written = ["scene.json"]
    try:
        figure = plot_bev(points, boxes=result.boxes, scores=result.scores, truth=truth, title="ciassd demo")
        figure.savefig(out / "scene.png", dpi=130)
        written.append("scene.png")
    except FormatError as error:
        print(error)
    print(f"Wrote {' and '.join(written)} to {out}.")
