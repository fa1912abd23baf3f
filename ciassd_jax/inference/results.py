"""Detections of one frame: as NumPy arrays, label rows, pictures and files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Int

from ciassd_jax.formats.errors import Pathlike
from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.formats.kitti_rows import ObjectRow, write_rows
from ciassd_jax.formats.writing import replacing
from ciassd_jax.types import Boxes, Counts, Detections

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ciassd_jax.view.html import Page
    from ciassd_jax.view.view_frame import ViewFrame


@dataclass(frozen=True)
class FrameResult:
    """Detections of one frame as NumPy arrays.

    `boxes` [N, 7] are x, y, z, length, width, height in metres and yaw in [-pi, pi), in the LiDAR frame, in the order
    of selection. `labels` are class names, `counts` the numbers of points, voxels, sites and candidates used and
    dropped, `seconds` the time from points to boxes without compilation.
    """

    boxes: np.ndarray
    scores: np.ndarray
    labels: tuple[str, ...]
    counts: dict[str, Any]
    seconds: float

    def __len__(self) -> int:
        return len(self.scores)

    def __repr__(self) -> str:
        head = f"{len(self)} detections in {1e3 * self.seconds:.0f} ms"
        rows = [
            f"  {label:<10} {score:.2f}  at ({x:6.2f}, {y:6.2f}, {z:5.2f})  {length:.2f} x {width:.2f} x {height:.2f} m"
            f"  yaw {yaw:+.2f}"
            for label, score, (x, y, z, length, width, height, yaw) in zip(
                self.labels[:10], self.scores, self.boxes, strict=False
            )
        ]
        more = [f"  ... and {len(self) - 10} more"] if len(self) > 10 else []
        return "\n".join([head, *rows, *more])

    def plot_bev(self, points: np.ndarray, truth: np.ndarray | None = None) -> Figure:
        """Return a bird's-eye view of the points [N, 4], these boxes and true boxes [G, 7], as a matplotlib figure."""
        from ciassd_jax.view.bev import plot_bev

        return plot_bev(np.asarray(points), self.boxes, truth, self.scores, self.labels)

    def view(self, points: np.ndarray, truth: np.ndarray | None = None, *, name: str = "points") -> Page:
        """Return a 3D page of the points [N, 4], these boxes and true boxes [G, 7]; `.save(path)` writes it."""
        from ciassd_jax.view.html import view_html
        from ciassd_jax.view.view_frame import NO_BOXES, ViewFrame

        true_boxes = NO_BOXES if truth is None else np.asarray(truth)
        frame = ViewFrame(name, np.asarray(points), self.boxes, self.scores, self.labels, true_boxes)
        return view_html([frame], title=name)

    def rows(self, camera: Camera) -> tuple[list[ObjectRow], Int[np.ndarray, " kept"]]:
        """Return KITTI's rows of the boxes that the image shows, and the indices of those boxes."""
        return boxes_to_rows(Boxes.from_array(self.boxes), self.scores, self.labels, *camera)

    def show_in(self, frame: ViewFrame) -> ViewFrame:
        """Return the frame with these boxes as its detections."""
        return frame._replace(boxes=self.boxes, scores=self.scores, labels=self.labels)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists, ready for JSON."""
        return {
            "boxes": self.boxes.tolist(),
            "scores": self.scores.tolist(),
            "labels": list(self.labels),
            "counts": self.counts,
            "seconds": self.seconds,
        }


def frame_result(
    batch: Detections, index: int, class_names: Sequence[str], seconds: float, changed: dict[str, int]
) -> FrameResult:
    """Return the detections of scene `index` of a batch, which took `seconds`, as NumPy arrays.

    `changed` are the numbers of its points that were changed or dropped before, by reason.
    """
    scene = jax.tree.map(lambda leaf: np.asarray(leaf[index]), batch)
    count = int(scene.count)
    labels = tuple(class_names[label] for label in scene.label[:count])
    counts = _plain_counts(scene.counts, changed)
    return FrameResult(scene.boxes.to_array()[:count], scene.score[:count], labels, counts, seconds)


def write_result(result: FrameResult, name: str, folder: Pathlike, camera: Camera | None = None) -> list[Path]:
    """Write `folder/NAME.json` and, with a camera, KITTI's rows as `folder/NAME.txt`; return the paths.

    Each file is written whole or not at all. Raises InputError if it cannot be written.
    """
    written = [write_json(Path(folder) / f"{name}.json", result)]
    if camera is not None:
        rows, _ = result.rows(camera)
        written.append(Path(folder) / f"{name}.txt")
        with replacing(written[-1]) as temporary:
            write_rows(temporary, rows)
    return written


def write_json(path: Path, result: FrameResult) -> Path:
    """Write one result as JSON, whole or not at all; return the path."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(result.to_dict(), allow_nan=False) + "\n", encoding="utf-8")
    return path


def _plain_counts(counts: Counts, changed: dict[str, int]) -> dict[str, Any]:
    """Return the counts of one scene as nested plain numbers."""
    value = {name: np.asarray(leaf).tolist() for name, leaf in counts._asdict().items()}
    return {
        "points": {name: value[f"points_{name}"] for name in ("given", "in_range", "dropped")} | changed,
        "voxels": {name: value[f"voxels_{name}"] for name in ("kept", "dropped")},
        "sites": [
            {"kept": kept, "dropped": dropped}
            for kept, dropped in zip(value["sites_kept"], value["sites_dropped"], strict=True)
        ],
        "candidates": {name: value[f"candidates_{name}"] for name in ("kept", "dropped")},
    }
