"""The page in a real browser: it draws without errors and requests, and its controls work.

Needs Chromium (Debian: apt-get install -y chromium); skipped without it.
"""

import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small import CALIBRATION, IMAGE_SIZE

from ciassd_jax.formats.kitti_camera import read_camera
from ciassd_jax.view.html import Page, view_html
from ciassd_jax.view.outlines import outline_boxes
from ciassd_jax.view.sources import read_image
from ciassd_jax.view.view_frame import ViewFrame

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed (apt-get install -y chromium)"),
]

BOXES = np.array([[10, 2, -1, 4, 2, 1.5, 0.3], [14, -3, -1, 4, 2, 1.5, 2.0], [18, 5, -1, 4, 2, 1.5, -1.0]])
SCORES = np.array([0.9, 0.5, 0.2])
LABELS = ("Car", "<b>Van</b>", "Car")
EVIL = "</script><b>second</b>"
# Runs first: records every failure, and lets animation frames follow the clock, as there is no screen.
LISTEN = """<script>
  window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 16);
  window.cancelAnimationFrame = clearTimeout;
  window.failures = [];
  for (const level of ["error", "warn"]) console[level] = (...words) => failures.push(words.join(" "));
  addEventListener("error", (event) => failures.push(String(event.message || event.target)), true);
  addEventListener("unhandledrejection", (event) => failures.push(String(event.reason)));
  addEventListener("securitypolicyviolation", (event) => failures.push(event.violatedDirective + event.blockedURI));
</script>"""
# Operates the controls and writes what the page then shows into the document, for --dump-dom.
ACT = """<script>
  const settled = () => new Promise((done) => setTimeout(done, 200));
  function look() {
    const traces = Object.fromEntries(document.getElementById("scene").data.map((trace) => [trace.name, trace]));
    const vertices = ({ x, y, z }) => x.map((_, i) => [x[i], y[i], z[i]]).filter(([first]) => first !== null);
    return {
      name: element("name").textContent,
      note: element("note").hidden ? "" : element("note").textContent,
      truth: element("truth-count").textContent,
      found: element("found-count").textContent,
      points: traces.points.x.length,
      trueVertices: [...vertices(traces.truth), ...vertices(traces.dimmed)],
      dimmedVertices: vertices(traces.dimmed),
      dimmed: element("dimmed").hidden ? "" : element("dimmed").textContent,
      captions: document.getElementById("scene").layout.scene.annotations.map((one) => one.text),
      written: [...document.querySelectorAll("figure text")].map((one) => one.textContent),
      foundVertices: vertices(traces.found),
      said: [...new Set(traces.found.text)].filter(Boolean),
      image: document.querySelectorAll("figure path.found").length,
      picture: !document.querySelector("figure").hidden,
      bold: document.querySelectorAll("b").length,
    };
  }
  const steps = {
    first() {},
    score() {
      element("score").value = 0.4;
      element("score").dispatchEvent(new Event("input"));
    },
    hidden: () => element("truth").click(),
    next: () => element("next").click(),
    back: () => document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft", bubbles: true })),
    above: () => element("above").click(),
    bare: () => element("captions").click(),
  };
  async function act() {
    const seen = {};
    for (const [name, step] of Object.entries(steps)) {
      step();
      await settled();
      seen[name] = look();
    }
    seen.failures = failures;
    seen.fetched = performance.getEntriesByType("resource").map((entry) => entry.name.slice(0, 99));
    const report = document.createElement("pre");
    report.id = "report";
    report.textContent = JSON.stringify(seen);
    document.body.append(report);
  }
  act();
</script>"""


def browse(page: Path, folder: Path, *arguments: str, budget: int = 4000) -> "subprocess.CompletedProcess[str]":
    """Open a page in headless Chromium, without GPU and network."""
    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless", "--no-sandbox", f"--user-data-dir={folder / 'profile'}", "--no-first-run"]
    command += ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
    command += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command += [f"--log-net-log={folder / 'net.json'}"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr", "--window-size=1000,800"]
    command += [f"--virtual-time-budget={budget}", *arguments, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=True)


def street(seed: int) -> np.ndarray:
    """A ground and a wall of points."""
    rng = np.random.default_rng(seed)
    ground = np.stack([rng.uniform(2, 40, 4000), rng.uniform(-15, 15, 4000), np.full(4000, -1.7)], -1)
    wall = np.stack([rng.uniform(5, 40, 2000), np.full(2000, 10.0), rng.uniform(-1.7, 2, 2000)], -1)
    return np.concatenate([ground, wall]).astype(np.float32)


def make_page(folder: Path) -> Page:
    (folder / "calib.txt").write_text(CALIBRATION)
    camera = read_camera(folder / "calib.txt", image_size=IMAGE_SIZE)
    image = np.full((480, 640, 3), 120, np.uint8)
    first = ViewFrame("first", street(0), BOXES, SCORES, LABELS, BOXES[:2] + 0.1, ("Car", "Tram"), camera, image)
    first = first._replace(is_target=np.array([True, False]))
    spoilt = street(1)
    spoilt[0, 0] = np.nan
    with pytest.warns(UserWarning, match="1 of 6,000 points"):
        return view_html([first, ViewFrame(EVIL, spoilt, BOXES[:1])], title=EVIL)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the page shows after each step of `ACT`."""
    folder = tmp_path_factory.mktemp("browser")
    text = make_page(folder).html.replace("<head>", "<head>" + LISTEN, 1)
    head, tail = text.rsplit("</body>", 1)
    (folder / "page.html").write_text(f"{head}{ACT}</body>{tail}", encoding="utf-8")
    done = browse(folder / "page.html", folder, "--dump-dom")
    (report,) = re.findall(r'<pre id="report">(.*?)</pre>', done.stdout, re.DOTALL)
    return {**json.loads(unescape(report)), "stderr": done.stderr, "asked": asked_of_network(folder)}


def asked_of_network(folder: Path) -> list[str]:
    """Initiators of network requests, without the browser itself."""
    log = (folder / "net.json").read_text(errors="replace")
    return [who for who in re.findall(r'"initiator":"([^"]*)"', log) if who != "not an origin"]


def corners(vertices: Sequence[Sequence[float]]) -> np.ndarray:
    return np.unique(np.round(vertices, 3), axis=0)


def test_nothing_fails_and_nothing_is_fetched(seen: dict[str, Any]) -> None:
    assert seen["failures"] == []
    assert [
        line for line in seen["stderr"].splitlines() if "CONSOLE" in line and "willReadFrequently" not in line
    ] == []
    assert [url for url in seen["fetched"] if not url.startswith(("data:", "blob:"))] == []
    assert seen["asked"] == []


def test_the_log_of_the_network_would_show_it(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text('<img src="http://127.0.0.1:9/picture.png">')
    browse(tmp_path / "page.html", tmp_path, "--dump-dom", budget=500)
    assert asked_of_network(tmp_path)


def test_points_and_boxes_are_where_they_belong(seen: dict[str, Any]) -> None:
    first = seen["first"]
    assert (first["name"], first["points"], first["truth"], first["found"]) == ("first", 6000, "2", "3")
    np.testing.assert_allclose(corners(first["foundVertices"]), corners(outline_boxes(BOXES).reshape(-1, 3)), atol=2e-3)
    np.testing.assert_allclose(
        corners(first["trueVertices"]), corners(outline_boxes(BOXES[:2] + 0.1).reshape(-1, 3)), atol=2e-3
    )


def test_hovering_tells_class_score_size_and_distance(seen: dict[str, Any]) -> None:
    assert seen["first"]["said"][0].split("<br>") == [
        "prediction: Car",
        "score 0.900",
        "4.00 × 2.00 × 1.50 m",  # noqa: RUF001
        "10.2 m away, yaw 17°",
    ]
    assert "prediction: &lt;b>Van&lt;/b>" in seen["first"]["said"][1]


def test_captions_name_each_visible_box_until_they_are_switched_off(seen: dict[str, Any]) -> None:
    truth, found = ["Car", "Tram"], ["Car 0.90", "&lt;b>Van&lt;/b> 0.50", "Car 0.20"]
    assert seen["first"]["captions"] == truth + found
    assert seen["first"]["written"] == [text.replace("&lt;", "<") for text in truth + found]
    assert seen["hidden"]["captions"] == found[:2]
    assert seen["above"]["captions"] != []
    assert seen["bare"]["captions"] == seen["bare"]["written"] == []


def test_truth_that_is_no_target_is_dimmed(seen: dict[str, Any]) -> None:
    expected = corners(outline_boxes(BOXES[1:2] + 0.1).reshape(-1, 3))
    np.testing.assert_allclose(corners(seen["first"]["dimmedVertices"]), expected, atol=2e-3)
    assert seen["first"]["dimmed"] == "no target 1"
    assert seen["hidden"]["dimmedVertices"] == []


def test_the_score_slider_hides_boxes_in_space_and_image(seen: dict[str, Any]) -> None:
    assert (seen["first"]["found"], seen["score"]["found"]) == ("3", "2 of 3")
    assert (seen["first"]["image"], seen["score"]["image"]) == (3, 2)
    expected = corners(outline_boxes(BOXES[:2]).reshape(-1, 3))
    np.testing.assert_allclose(corners(seen["score"]["foundVertices"]), expected, atol=2e-3)
    assert seen["score"]["truth"] == "2"


def test_a_switch_hides_its_kind(seen: dict[str, Any]) -> None:
    assert (seen["hidden"]["truth"], seen["hidden"]["trueVertices"]) == ("0 of 2", [])
    assert seen["hidden"]["found"] == "2 of 3"


def test_frames_are_stepped_through_and_keep_the_settings(seen: dict[str, Any]) -> None:
    following, back = seen["next"], seen["back"]
    assert (following["name"], following["picture"], following["points"]) == (EVIL, False, 5999)
    assert following["note"] == "1 of 6,000 points are not finite and not shown."
    # The slider does not hide boxes without a score.
    assert following["found"] == "1"
    assert (back["name"], back["found"], back["truth"], back["note"]) == ("first", "2 of 3", "0 of 2", "")
    assert {state["bold"] for state in (seen["first"], following)} == {0}


def test_points_and_boxes_are_visible(tmp_path: Path) -> None:
    page = make_page(tmp_path).save(tmp_path / "page.html")
    browse(page, tmp_path, f"--screenshot={tmp_path / 'shot.png'}")
    # The scene without the bar above it and the image below.
    shot = read_image(tmp_path / "shot.png").astype(int)[90:450]
    red, green, blue = np.moveaxis(shot, -1, 0)
    assert ((red > 200) & (green < 120) & (blue < 120)).sum() > 100
    assert ((green > 180) & (red < 110) & (blue < 140)).sum() > 100
    assert ((blue > 90) & (blue > red + 20)).sum() > 3000
