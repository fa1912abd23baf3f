"""The page as a file: its data, its notes, and no reference to anything outside."""

import base64
import html
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small import CALIBRATION, IMAGE_SIZE

from ciassd_jax.formats.errors import DroppedWarning, InputError
from ciassd_jax.formats.kitti_camera import Camera, lidar_to_image, read_camera
from ciassd_jax.inference.results import FrameResult
from ciassd_jax.view.html import FRAME_POINTS, STEP, Page, view_html
from ciassd_jax.view.outlines import outline_boxes, project_segments
from ciassd_jax.view.view_frame import SCORE_MEANING, ViewFrame

RNG = np.random.default_rng(0)
POINTS = RNG.uniform([0, -30, -2, 0], [60, 30, 1, 1], (3000, 4)).astype(np.float32)
BOXES = np.array([[10, 2, -1, 4, 2, 1.5, 0], [20, -3, -1, 4, 2, 1.5, 2.0]], np.float32)
FRAME = ViewFrame("000010", POINTS, BOXES, np.array([0.9, 0.25], np.float32), ("Car", "Van"), BOXES[:1] + 0.2, ("Car",))


def data_of(page: Page) -> dict[str, Any]:
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', page.html, re.DOTALL)
    return json.loads(text)


def points_of(frame: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(frame["points"]), "<i2").reshape(-1, 3) * STEP


def camera(tmp_path: Path) -> Camera:
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    return read_camera(tmp_path / "calib.txt", image_size=IMAGE_SIZE)


@pytest.mark.smoke
def test_points_and_boxes_are_in_the_page() -> None:
    data = data_of(view_html([FRAME, FRAME._replace(name="second")]))
    assert [frame["name"] for frame in data["frames"]] == ["000010", "second"]
    first = data["frames"][0]
    np.testing.assert_allclose(points_of(first), POINTS[:, :3], atol=STEP / 2 + 1e-6)
    np.testing.assert_allclose(first["found"]["boxes"], BOXES, atol=1e-4)
    np.testing.assert_allclose(first["found"]["scores"], [0.9, 0.25], atol=1e-4)
    assert first["found"]["labels"] == ["Car", "Van"]
    np.testing.assert_allclose(first["truth"]["boxes"], BOXES[:1] + 0.2, atol=1e-4)
    assert (first["shown"], first["given"], first["notes"]) == (3000, 3000, [])
    low, high = np.transpose(data["bounds"])
    assert (low <= points_of(first).min(0)).all()
    assert (high >= points_of(first).max(0)).all()


class References(HTMLParser):
    """Every attribute of a page that could fetch something."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [f"{tag} {name}={value}" for name, value in attrs if name in ("src", "href", "srcset", "data")]
        assert tag not in ("link", "iframe", "object", "embed", "base")


def test_the_page_refers_to_nothing_and_forbids_it() -> None:
    page = view_html([FRAME])
    parser = References()
    parser.feed(page.html)
    assert parser.found == []
    assert "default-src 'none'" in page.html
    assert "connect-src" not in page.html
    assert 4e6 < len(page.html) < 6e6


@pytest.mark.parametrize("points", [np.zeros((0, 4), np.float32), POINTS])
def test_nothing_to_see_is_a_page_too(points: np.ndarray) -> None:
    data = data_of(view_html([ViewFrame("empty", points)]))
    assert data["frames"][0]["found"] == {"boxes": [], "labels": None, "scores": None, "dimmed": []}
    assert np.isfinite(data["bounds"]).all()


def test_names_are_text_whatever_they_say() -> None:
    evil = "</script><b onclick=alert(1)>{{plotly}} \u2028 &amp; \udcff"
    page = view_html([FRAME._replace(name=evil, labels=(evil, "Van"))], title=evil)
    assert "<b onclick" not in page.html
    assert len(page.html) < 6e6
    assert data_of(page)["frames"][0]["name"] == evil
    assert data_of(page)["frames"][0]["found"]["labels"][0] == evil


def test_ten_million_points_are_thinned_and_the_page_says_so() -> None:
    points = np.broadcast_to(np.float32([1, 2, 3, 0]), (10_000_000, 4))
    with pytest.warns(DroppedWarning, match="huge: 150,000 of 10,000,000 points are shown, chosen evenly"):
        page = view_html([ViewFrame("huge", points)])
    (frame,) = data_of(page)["frames"]
    assert (frame["shown"], frame["given"]) == (FRAME_POINTS, 10_000_000)
    assert frame["notes"] == ["150,000 of 10,000,000 points are shown, chosen evenly."]
    assert page.notes == ("huge: 150,000 of 10,000,000 points are shown, chosen evenly.",)
    assert len(page.html) < 8e6


def test_many_frames_share_the_points_of_a_page() -> None:
    with pytest.warns(DroppedWarning, match="Other frames.*3") as caught:
        page = view_html([FRAME] * 4, page_points=4000)
    assert len(caught) == 1
    assert [frame["shown"] for frame in data_of(page)["frames"]] == [1000] * 4


def test_truth_that_is_no_target_is_marked() -> None:
    truth = np.concatenate([BOXES, BOXES + 5])
    truth[0, 3] = np.nan
    frame = FRAME._replace(truth=truth, truth_labels=("Car", "Tram", "Car", "Cat"), is_target=np.arange(4) % 2 == 0)
    with pytest.warns(DroppedWarning, match="1 of 4 ground truth"):
        page = view_html([frame])
    shown = data_of(page)["frames"][0]
    assert (shown["truth"]["labels"], shown["truth"]["dimmed"]) == (["Tram", "Car", "Cat"], [0, 2])
    assert shown["found"]["dimmed"] == data_of(view_html([FRAME]))["frames"][0]["truth"]["dimmed"] == []


def test_what_a_score_means_is_said_once() -> None:
    assert view_html([FRAME]).html.count(html.escape(SCORE_MEANING)) == 1


def test_boxes_that_are_not_finite_are_left_out_with_a_note() -> None:
    spoilt = BOXES.copy()
    spoilt[0, 3] = np.nan
    with pytest.warns(DroppedWarning, match="1 of 2 detections are not finite or too far"):
        page = view_html([FRAME._replace(boxes=spoilt)])
    found = data_of(page)["frames"][0]["found"]
    assert (found["labels"], found["scores"], len(found["boxes"])) == (["Van"], [0.25], 1)


@pytest.mark.parametrize(
    "change",
    [
        {"scores": np.ones(3)},
        {"labels": ("Car",)},
        {"truth_labels": ("Car", "Van")},
        {"is_target": np.ones(2, bool)},
    ],
    ids=str,
)
@pytest.mark.usefixtures("no_type_checks")
def test_boxes_scores_and_labels_must_belong_together(change: dict) -> None:
    with pytest.raises(ValueError, match=r"000010: .* give"):
        view_html([FRAME._replace(**change)])


def test_no_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="give at least one"):
        view_html([])


def test_boxes_are_projected_into_the_image(tmp_path: Path) -> None:
    frame = FRAME._replace(camera=camera(tmp_path), image=np.zeros((480, 640, 3), np.uint8))
    image = data_of(view_html([frame]))["frames"][0]["image"]
    assert image["source"].startswith("data:image/jpeg;base64,")
    assert (image["width"], image["height"]) == (640, 480)
    expected = project_segments(outline_boxes(BOXES), lidar_to_image(frame.camera.calibration))
    np.testing.assert_allclose(np.array(image["found"]).reshape(2, 13, 2, 2), expected, atol=0.051)
    assert len(image["truth"]) == 1


def test_a_page_is_saved_whole_and_shown_in_a_frame_of_its_own(tmp_path: Path) -> None:
    page = view_html([FRAME])
    assert page.save(tmp_path / "deep" / "page.html") == tmp_path / "deep" / "page.html"
    assert (tmp_path / "deep" / "page.html").read_text() == page.html + "\n"
    (source,) = re.findall(r'^<iframe srcdoc="([^"]*)" style="[^"]*"></iframe>$', page._repr_html_())
    assert html.unescape(source) == page.html
    assert repr(page).startswith("Page of 1 frame, ")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        page.save(tmp_path / "file" / "page.html")


def test_a_result_shows_itself() -> None:
    result = FrameResult(BOXES, np.array([0.9, 0.5], np.float32), ("Car", "Car"), {}, 0.1)
    (frame,) = data_of(result.view(POINTS, BOXES[:1], name="mine"))["frames"]
    assert (frame["name"], len(frame["found"]["boxes"]), len(frame["truth"]["boxes"])) == ("mine", 2, 1)
    assert len(data_of(result.view(POINTS))["frames"][0]["truth"]["boxes"]) == 0
    labels = [text.get_text() for text in result.plot_bev(POINTS, BOXES[:1]).axes[0].get_legend().get_texts()]
    assert labels == ["sensor", "ground truth (1)", "detected (2)"]


@pytest.mark.parametrize("missing", ["plotly", "PIL"])
def test_without_the_extra_one_sentence_names_it(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ModuleNotFoundError, match=rf"{missing}.*pip install 'ciassd_jax\[viz\]'"):
        view_html([FRAME])


def test_nothing_is_opened_on_import() -> None:
    code = "import sys, ciassd_jax.view.html; "
    code += "assert not {'plotly', 'PIL', 'matplotlib', 'tkinter', 'webbrowser'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
