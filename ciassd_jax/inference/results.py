"""Detections of one frame: as NumPy arrays, label rows, pictures and files."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float, Int

from ciassd_jax.formats.errors import Pathlike
from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_camera import Camera, read_camera
from ciassd_jax.formats.kitti_rows import ObjectRow, format_row, write_rows
from ciassd_jax.formats.writing import replacing
from ciassd_jax.ops.footprints import box_corners
from ciassd_jax.types import Boxes, Counts, Detections
from ciassd_jax.view.view_frame import NO_BOXES, SCORE_MEANING, ViewFrame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ciassd_jax.view.html import Page

BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw")
# Rows of the text and of the table of a notebook.
_TEXT_ROWS, _TABLE_ROWS = 10, 20


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Detections of one frame as NumPy arrays.

    `boxes` [N, 7] are x, y, z, length, width, height in metres and yaw in [-pi, pi), in the LiDAR frame, in the order
    of selection. `scores` are rectified: class probability * predicted IoU ** 4, after NMS. `labels` are class names,
    `counts` the numbers of points, voxels, sites and candidates used and dropped, `seconds` the time from points to
    boxes without compilation, that of a batch divided by its clouds. `class_names` are all classes of the detector. An
    index, a slice or a mask chooses detections: `result[:5]`.
    """

    boxes: np.ndarray
    scores: np.ndarray
    labels: tuple[str, ...]
    counts: dict[str, Any]
    seconds: float
    class_names: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, chosen: int | slice | Sequence[int] | np.ndarray) -> FrameResult:
        indices = np.atleast_1d(np.arange(len(self))[chosen])
        labels = tuple(self.labels[index] for index in indices.tolist())
        return replace(self, boxes=self.boxes[indices], scores=self.scores[indices], labels=labels)

    @property
    def corners(self) -> Float[np.ndarray, "N 8 3"]:
        """Corners (x, y, z) of the boxes: the four at the bottom counter-clockwise from the front left, those above."""
        return np.asarray(box_corners(Boxes.from_array(self.boxes)))

    def filter(self, min_score: float | None = None, classes: str | Sequence[str] | None = None) -> FrameResult:
        """Return the detections whose score reaches `min_score`, and whose class is one of `classes`.

        Case does not matter in names. Raises ValueError for a class that the detector does not know.
        """
        keep = np.ones(len(self), bool) if min_score is None else self.scores >= min_score
        if classes is None:
            return self[keep]
        wanted = [classes] if isinstance(classes, str) else classes
        known = {name.lower(): name for name in (*self.labels, *self.class_names)}
        unknown = [name for name in wanted if name.lower() not in known]
        if unknown:
            raise ValueError(f"{unknown[0]!r} is none of the classes; choose from {', '.join(known.values())}.")
        chosen = {name.lower() for name in wanted}
        return self[keep & np.array([label.lower() in chosen for label in self.labels], bool)]

    def __repr__(self) -> str:
        head = f"{len(self)} detections in {1e3 * self.seconds:.0f} ms"
        rows = [
            f"  {label:<10} {score:.2f}  at ({x:6.2f}, {y:6.2f}, {z:5.2f})  {length:.2f} x {width:.2f} x {height:.2f} m"
            f"  yaw {yaw:+.2f}"
            for label, score, (x, y, z, length, width, height, yaw) in zip(
                self.labels[:_TEXT_ROWS], self.scores, self.boxes, strict=False
            )
        ]
        more = [f"  ... and {len(self) - _TEXT_ROWS} more"] if len(self) > _TEXT_ROWS else []
        return "\n".join([head, *rows, *more])

    def _repr_html_(self) -> str:
        head = f"{len(self)} detections in {1e3 * self.seconds:.0f} ms, in metres and radians; {SCORE_MEANING}"
        table = [
            [label, f"{score:.2f}", *(f"{value:.2f}" for value in box)]
            for label, score, box in zip(self.labels[:_TABLE_ROWS], self.scores, self.boxes, strict=False)
        ]
        names = "".join(f"<th>{name}</th>" for name in ("class", "score", *BOX_COLUMNS))
        rows = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in table)
        more = f"<p>... and {len(self) - _TABLE_ROWS} more</p>" if len(self) > _TABLE_ROWS else ""
        return f"<p>{head}</p><table><thead><tr>{names}</tr></thead><tbody>{rows}</tbody></table>{more}"

    def plot_bev(
        self, points: np.ndarray, truth: np.ndarray | None = None, *, truth_labels: Sequence[str] | None = None
    ) -> Figure:
        """Return a bird's-eye view of the points [N, 4], these boxes and true boxes [G, 7], as a matplotlib figure."""
        from ciassd_jax.view.bev import plot_bev

        return plot_bev(np.asarray(points), self.boxes, truth, self.scores, self.labels, truth_labels=truth_labels)

    def view(
        self,
        points: np.ndarray,
        truth: np.ndarray | None = None,
        *,
        truth_labels: Sequence[str] = (),
        name: str = "points",
    ) -> Page:
        """Return a 3D page of the points [N, 4], these boxes and true boxes [G, 7]; `.save(path)` writes it."""
        from ciassd_jax.view.html import view_html

        true_boxes = NO_BOXES if truth is None else np.asarray(truth)
        frame = ViewFrame(name, np.asarray(points), truth=true_boxes, truth_labels=truth_labels)
        return view_html([self.show_in(frame)], title=name)

    def rows(self, camera: Camera) -> tuple[list[ObjectRow], Int[np.ndarray, " kept"]]:
        """Return KITTI's rows of the boxes that the image shows, and the indices of those boxes."""
        return boxes_to_rows(Boxes.from_array(self.boxes), self.scores, self.labels, *camera)

    def to_kitti(self, calibration: Pathlike | Camera, *, image_size: tuple[int, int] | None = None) -> list[str]:
        """Return the lines of KITTI's result file: a row for each box that the image shows.

        `calibration` is a camera or the path of a calibration file, `image_size` (width, height) that of a camera which
        KITTI does not have. Raises InputError for a file that cannot be used.
        """
        if not isinstance(calibration, Camera):
            calibration = read_camera(calibration, image_size=image_size)
        return [format_row(row) for row in self.rows(calibration)[0]]

    def show_in(self, frame: ViewFrame) -> ViewFrame:
        """Return the frame with these boxes as its detections."""
        return frame._replace(boxes=self.boxes, scores=self.scores, labels=self.labels)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists, ready for JSON; `box_columns` names the numbers of a box."""
        return {
            "box_columns": list(BOX_COLUMNS),
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
    boxes, names = scene.boxes.to_array()[:count], tuple(class_names)
    return FrameResult(boxes, scene.score[:count], labels, counts, seconds, names)


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
