"""`ciassd convert`: a report for every tensor, and what it refuses."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from cli_files import evil_pth, names_in
from released import released_state, write_pth

from ciassd_jax import load_weights


def test_convert_reports_every_tensor_and_predict_needs_nothing_else(run: Any, tmp_path: Path) -> None:
    source = write_pth(tmp_path / "released.pth", {"state_dict": released_state(iou=(1, True), counters=True)})
    result = run("convert", source, tmp_path / "new" / "ours.safetensors")
    assert (result.code, result.err) == (0, "")
    *rows, summary = result.out.splitlines()
    assert len(rows) == 176
    assert re.fullmatch(
        r"transposed +neck\.w_0\.0\.weight +params/neck/spatial_attention/kernel +\(1, 128, 1, 1\)",
        next(row for row in rows if "neck.w_0.0.weight" in row),
    )
    assert summary.startswith(f"Wrote {tmp_path / 'new' / 'ours.safetensors'}: 148 tensors; 28 counters")
    assert names_in(tmp_path / "new") == ["ours.safetensors"]
    converted = load_weights(tmp_path / "new" / "ours.safetensors")
    assert (converted.config.head.iou_kernel, converted.config.head.iou_bias) == (1, True)
    kernel = released_state(iou=(1, True))["neck.w_0.0.weight"].transpose(2, 3, 1, 0)
    np.testing.assert_array_equal(converted.variables["params"]["neck"]["spatial_attention"]["kernel"], kernel)


def test_convert_refuses_what_it_must(run: Any, weights: Path, tmp_path: Path) -> None:
    path = tmp_path / "released.safetensors"
    safetensors.numpy.save_file(released_state(), path)
    before = path.read_bytes()
    for source, target, message in [
        (path, tmp_path / "out.npz", "out.npz must end in .safetensors"),
        (path, path, "released.safetensors is the input itself; "),
        (path, weights / "out.safetensors", "small.safetensors cannot be a folder, as "),
        (weights, tmp_path / "out.safetensors", "is already"),
        (tmp_path / "none.pth", tmp_path / "out.safetensors", "does not exist; check the path"),
        (evil_pth(tmp_path / "evil.pth"), tmp_path / "out.safetensors", "asks to run"),
    ]:
        result = run("convert", source, target)
        assert result.code == 2
        assert result.err.startswith("error: ")
        assert message in result.err
        assert result.err.count("\n") == 1
    assert path.read_bytes() == before
    assert names_in(tmp_path) == ["evil.pth", "released.safetensors", "small.safetensors"]
