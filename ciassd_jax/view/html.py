"""One page that shows frames in 3D: everything is inside it, so that it opens anywhere and asks no network."""

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
from jaxtyping import Float, UInt8

from ciassd_jax.formats.errors import DroppedWarning, Pathlike
from ciassd_jax.formats.kitti import lidar_to_image
from ciassd_jax.formats.writing import write_text
from ciassd_jax.view.outlines import outline_boxes, project_segments
from ciassd_jax.view.sampling import choose_points, usable_boxes
from ciassd_jax.view.view_frame import ViewFrame

try:
    from PIL import Image
    from plotly.offline import get_plotlyjs
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("Pages need plotly and pillow; get them with `pip install 'ciassd_jax[viz]'`.") from error

# Points of a frame and of a page: what a browser still turns smoothly, and a file that can still be mailed.
FRAME_POINTS = 150_000
PAGE_POINTS = 2_000_000
# Points are written as whole centimetres.
STEP = 0.01
# The colours span so much above the ground, in metres: what stands on the road, not the tree tops.
COLOR_SPAN = 3.5


@dataclass(frozen=True, repr=False)
class Page:
    """A self-contained page; a notebook shows it as the value of a cell, `save` writes it to a file."""

    html: str
    num_frames: int
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        frames = "1 frame" if self.num_frames == 1 else f"{self.num_frames} frames"
        return f"Page of {frames}, {len(self.html) / 1e6:.1f} MB; .save(path) writes it."

    def _repr_html_(self) -> str:
        # In a frame of its own: the page's styles and names stay apart from the notebook's and other pages'.
        return f'<iframe srcdoc="{html.escape(self.html)}" style="width:100%;height:640px;border:0"></iframe>'

    def save(self, path: Pathlike) -> Path:
        """Write the page, whole or not at all; raises InputError where that fails."""
        write_text(path, self.html)
        return Path(path)


def view_html(
    frames: Sequence[ViewFrame],
    *,
    title: str = "ciassd view",
    frame_points: int = FRAME_POINTS,
    page_points: int = PAGE_POINTS,
) -> Page:
    """A page to turn each frame's points and boxes in 3D, step through frames and hide boxes by score.

    At most `frame_points` of a frame's points are shown and `page_points` in all. The page says what was left out,
    and so does a DroppedWarning. Raises ValueError for boxes, scores and labels that do not belong together.
    """
    if not frames:
        raise ValueError("there is no frame to show; give at least one.")
    most = max(min(frame_points, page_points // len(frames)), 1)
    described = [_describe(frame, most) for frame in frames]
    notes = _summary(described)
    for note in notes:
        warnings.warn(note, DroppedWarning, stacklevel=2)
    document = _fill(title, {"title": title, "step": STEP, **_extent(frames, described), "frames": described})
    return Page(document, len(frames), notes)


def _describe(frame: ViewFrame, most: int) -> dict[str, Any]:
    """Everything that the page says of a frame, as plain values; `points` are base64 of int16, x, y, z in `STEP`s."""
    points, notes = choose_points(frame.points, most)
    kinds = {
        "truth": _boxes(frame, "ground truth", frame.truth, None, frame.truth_labels),
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
) -> dict[str, Any]:
    """The usable boxes of one kind with their labels and scores."""
    count = len(boxes)
    if boxes.shape != (count, 7) or len(labels) not in (0, count) or (scores is not None and len(scores) != count):
        raise ValueError(
            f"{frame.name}: {what} of shape {boxes.shape} with {len(labels)} labels and "
            f"{'no' if scores is None else len(scores)} scores; give [D, 7] boxes, and D of the others or none."
        )
    usable = usable_boxes(boxes) & (True if scores is None else np.isfinite(scores))
    chosen = np.flatnonzero(usable).tolist()
    lost = count - len(chosen)
    shown = boxes[chosen].astype(np.float64)
    shown[:, 6] = (shown[:, 6] + np.pi) % (2 * np.pi) - np.pi
    return {
        "boxes": np.round(shown, 4).tolist(),
        "labels": [labels[index] for index in chosen] if labels else None,
        "scores": None if scores is None else np.round(scores[chosen].astype(np.float64), 4).tolist(),
        "notes": [f"{lost} of {count} {what} are not finite or too far and not shown."] if lost else [],
    }


def _image(frame: ViewFrame, kinds: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """The frame's image as a data URL, and the segments of its boxes in pixels, rows of x1, y1, x2, y2 per box."""
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
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def _extent(frames: Sequence[ViewFrame], described: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What all frames share, so that nothing jumps from one to the next: bounds, ground, colours, scores."""
    places = [np.frombuffer(base64.b64decode(one["points"]), "<i2").reshape(-1, 3) * STEP for one in described]
    boxes = [
        np.array(one[kind]["boxes"], np.float64).reshape(-1, 7) for one in described for kind in ("truth", "found")
    ]
    corners = [outline_boxes(each).reshape(-1, 3) for each in boxes]
    everything = np.concatenate([np.zeros((1, 3)), *places, *corners])
    heights = np.concatenate([np.zeros(0), *(each[:, 2] for each in places)])
    # Few points lie below the ground, reflections in wet roads among them.
    ground = float(np.quantile(heights, 0.05)) if len(heights) else -1.7
    scores = [score for one in described for score in one["found"]["scores"] or []]
    return {
        "bounds": np.round(np.stack([everything.min(0) - 1, everything.max(0) + 1], -1), 2).tolist(),
        "ground": round(ground, 2),
        "colors": [round(ground - 0.3, 2), round(ground + COLOR_SPAN, 2)],
        "scores": [min([0.0, *scores]), max([1.0, *scores])],
    }


def _summary(described: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """The first note of each kind with its frame, and how many other frames have one like it."""
    kinds: dict[str, list[str]] = {}
    for one in described:
        for note in one["notes"]:
            kinds.setdefault(re.sub(r"[\d,]+", "", note), []).append(f"{one['name']}: {note}")
    return tuple(
        first + (f" Other frames likewise: {len(others)}." if others else "") for first, *others in kinds.values()
    )


def _fill(title: str, data: dict[str, Any]) -> str:
    """The template with the title, the library and the data in their places."""
    # Inside a script element only "<" could end it; JSON may write it as an escape.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    # A name of a file may hold bytes that are no text.
    shown = title.encode("utf-8", "replace").decode("utf-8")
    parts = {"title": html.escape(shown), "plotly": _plotly(), "data": text}
    template = files("ciassd_jax.view").joinpath("page.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


@cache
def _plotly() -> str:
    return get_plotlyjs()
