"""One self-contained page that shows frames in 3D and loads nothing from the network."""

from __future__ import annotations

import base64
import html
import io
import json
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ciassd_jax.formats.errors import DroppedWarning, Pathlike
from ciassd_jax.formats.kitti_camera import lidar_to_image
from ciassd_jax.formats.writing import write_text
from ciassd_jax.view.outlines import outline_boxes, project_segments
from ciassd_jax.view.sampling import choose_boxes, choose_points
from ciassd_jax.view.view_frame import SCORE_MEANING, ViewFrame
from ciassd_jax.view.viz_extra import require

# Points of one frame and of one page: what a browser still turns smoothly, in a file that can still be mailed.
FRAME_POINTS = 150_000
PAGE_POINTS = 2_000_000
# Points are stored as whole centimetres.
STEP = 0.01
# The colours span this height above the ground, in metres: what stands on the road, not the tree tops.
COLOR_SPAN = 3.5


@dataclass(frozen=True, repr=False)
class Page:
    """A self-contained page; a notebook displays it as the value of a cell, and `save` writes it to a file."""

    html: str
    num_frames: int
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        frames = "1 frame" if self.num_frames == 1 else f"{self.num_frames} frames"
        return f"Page of {frames}, {len(self.html) / 1e6:.1f} MB; .save(path) writes it."

    def _repr_html_(self) -> str:
        # A frame of its own keeps the page's styles and names apart from those of the notebook.
        return f'<iframe srcdoc="{html.escape(self.html)}" style="width:100%;height:640px;border:0"></iframe>'

    def save(self, path: Pathlike) -> Path:
        """Write the page atomically and return its path; raises InputError if that fails."""
        write_text(path, self.html)
        return Path(path)


def view_html(
    frames: Sequence[ViewFrame],
    *,
    title: str = "ciassd view",
    frame_points: int = FRAME_POINTS,
    page_points: int = PAGE_POINTS,
) -> Page:
    """Return a page that shows each frame's points and boxes in 3D, with a choice of frame and of the lowest score.

    At most `frame_points` points of a frame are shown and `page_points` in all. The page and a DroppedWarning say what
    is left out. Raises ValueError for no frames and for boxes, scores and labels of different numbers, and
    ModuleNotFoundError without plotly and pillow.
    """
    require("Pages", "plotly", "PIL")
    if not frames:
        raise ValueError("There is no frame to show; give at least one.")
    most = max(min(frame_points, page_points // len(frames)), 1)
    described = [_describe(frame, most) for frame in frames]
    notes = _summary(described)
    for note in notes:
        warnings.warn(note, DroppedWarning, stacklevel=2)
    document = _fill(title, {"title": title, "step": STEP, **_extent(frames, described), "frames": described})
    return Page(document, len(frames), notes)


def _describe(frame: ViewFrame, most: int) -> dict[str, Any]:
    """What the page shows of a frame, as plain values; `points` are base64 of int16 x, y, z in units of `STEP`."""
    points, notes = choose_points(frame.points, most)
    kinds = {
        "truth": _boxes(frame, "ground truth", frame.truth, None, frame.truth_labels, frame.is_target),
        "found": _boxes(frame, "detections", frame.boxes, frame.scores, frame.labels),
    }
    left_out = [note for kind in kinds.values() for note in kind.pop("notes")]
    steps = np.rint(points / STEP).astype("<i2")
    return {
        "name": frame.name,
        "points": base64.b64encode(steps.tobytes()).decode("ascii"),
        "shown": len(points),
        "given": len(frame.points),
        "notes": [*notes, *left_out],
        **kinds,
        "image": _image(frame, kinds),
    }


def _boxes(
    frame: ViewFrame,
    what: str,
    boxes: Float[np.ndarray, "D 7"],
    scores: Float[np.ndarray, " D"] | None,
    labels: Sequence[str],
    is_target: Bool[np.ndarray, " D"] | None = None,
) -> dict[str, Any]:
    """The usable boxes of one kind, with their labels and scores, and the indices of those that are no targets."""
    count = len(boxes)
    targets = np.ones(count, bool) if is_target is None else is_target
    if len(targets) != count:
        raise ValueError(f"{frame.name}: {count} true boxes with {len(targets)} values of `is_target`; give one each.")
    if boxes.shape != (count, 7) or len(labels) not in (0, count) or (scores is not None and len(scores) != count):
        raise ValueError(
            f"{frame.name}: {what} of shape {boxes.shape} with {len(labels)} labels and "
            f"{'no' if scores is None else len(scores)} scores; give [D, 7] boxes, and D of the others or none."
        )
    chosen, notes = choose_boxes(boxes, what, scores)
    shown = boxes[chosen].astype(np.float64)
    shown[:, 6] = (shown[:, 6] + np.pi) % (2 * np.pi) - np.pi
    return {
        "boxes": np.round(shown, 4).tolist(),
        "labels": [labels[index] for index in chosen] if labels else None,
        "scores": None if scores is None else np.round(scores[chosen].astype(np.float64), 4).tolist(),
        "dimmed": np.flatnonzero(~targets[chosen]).tolist(),
        "notes": notes,
    }


def _image(frame: ViewFrame, kinds: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """The frame's image as a data URL, and the segments of each box in pixels as rows of x1, y1, x2, y2."""
    if frame.image is None or frame.camera is None:
        return None
    projection = lidar_to_image(frame.camera.calibration)
    height, width = frame.image.shape[:2]
    segments = {}
    for kind, content in kinds.items():
        boxes = np.array(content["boxes"], np.float64).reshape(-1, 7)
        pixels = np.round(project_segments(outline_boxes(boxes), projection), 1)
        segments[kind] = [ends[np.isfinite(ends).all((1, 2))].reshape(-1, 4).tolist() for ends in pixels]
    return {"source": _data_url(frame.image), "width": width, "height": height, **segments}


def _data_url(image: UInt8[np.ndarray, "rows columns 3"]) -> str:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def _extent(frames: Sequence[ViewFrame], described: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The bounds, ground height, colour range and score range that all frames share, so that the view stays steady."""
    places = [np.frombuffer(base64.b64decode(one["points"]), "<i2").reshape(-1, 3) * STEP for one in described]
    boxes = [
        np.array(one[kind]["boxes"], np.float64).reshape(-1, 7) for one in described for kind in ("truth", "found")
    ]
    corners = [outline_boxes(each).reshape(-1, 3) for each in boxes]
    everything = np.concatenate([np.zeros((1, 3)), *places, *corners])
    heights = np.concatenate([np.zeros(0), *(each[:, 2] for each in places)])
    # A few points lie below the ground, such as reflections in wet roads.
    ground = float(np.quantile(heights, 0.05)) if len(heights) else -1.7
    scores = [score for one in described for score in one["found"]["scores"] or []]
    return {
        "bounds": np.round(np.stack([everything.min(0) - 1, everything.max(0) + 1], -1), 2).tolist(),
        "ground": round(ground, 2),
        "colors": [round(ground - 0.3, 2), round(ground + COLOR_SPAN, 2)],
        "scores": [min([0.0, *scores]), max([1.0, *scores])],
    }


def _summary(described: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """The first note of each kind with its frame, and the number of other frames with such a note."""
    kinds: dict[str, list[str]] = {}
    for one in described:
        for note in one["notes"]:
            kinds.setdefault(re.sub(r"[\d,]+", "", note), []).append(f"{one['name']}: {note}")
    return tuple(
        first + (f" Other frames with such a note: {len(others)}." if others else "")
        for first, *others in kinds.values()
    )


def _fill(title: str, data: dict[str, Any]) -> str:
    """Fill the title, the library and the data into the template."""
    # Only "<" can end a script element, and JSON allows it as an escape.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    # File names may contain bytes that are not text.
    shown = title.encode("utf-8", "replace").decode("utf-8")
    parts = {"title": html.escape(shown), "plotly": _plotly(), "data": text, "meaning": html.escape(SCORE_MEANING)}
    template = files("ciassd_jax.view").joinpath("page.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


@cache
def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    return get_plotlyjs()
