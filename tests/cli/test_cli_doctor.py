"""`ciassd doctor`: its verdict, and what each check says when something is wrong."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

from ciassd_jax.inference import self_checks
from ciassd_jax.inference.self_checks import Check, Finding


def finding(state: Any, text: str) -> Check:
    def find() -> Iterator[Finding]:
        yield Finding(state, text)

    return Check(find, "Broken", "start again")


def texts(check: str, state: str) -> list[str]:
    return [one.text for one in self_checks.run_check(self_checks.CHECKS[check]) if one.state == state]


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[Path]:
    """A compilation cache in a folder of the test."""
    before = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.slow
def test_the_doctor_finds_this_machine_ready(run: Any) -> None:
    result = run("doctor")
    assert result.code == 0
    assert result.out.endswith("Ready: every check passed.\n")
    assert {line.split()[1] for line in result.out.splitlines()[:-1]} == set(self_checks.CHECKS)
    assert "stored result" in result.out
    assert "worker process started" in result.out


def test_a_note_is_no_failure(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    checks = {"disk": finding("ok", "much"), "extras": finding("note", "Without it nothing; install it.")}
    monkeypatch.setattr(self_checks, "CHECKS", checks)
    result = run("doctor")
    assert (result.code, result.err) == (0, "")
    assert result.out.splitlines() == [
        "ok    disk      much",
        "note  extras    Without it nothing; install it.",
        "Ready: every check passed.",
    ]


def test_a_failure_and_an_exception_fail(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> Iterator[Finding]:
        raise OSError("no device.\nmore")
        yield

    checks = {
        "disk": finding("FAIL", "full"),
        "memory": finding("ok", "much"),
        "devices": Check(broken, "None found", "add one"),
    }
    monkeypatch.setattr(self_checks, "CHECKS", checks)
    result = run("doctor")
    assert result.code == 1
    assert result.out.splitlines()[-2:] == [
        "FAIL  devices   None found (no device); add one.",
        "Not ready; failed: disk, devices.",
    ]


def test_versions_are_compared_with_what_is_needed_and_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    assert texts("versions", "FAIL") == []
    monkeypatch.setattr(self_checks, "version", lambda name: {"jax": "0.9.1", "numpy": "3.0.0rc1"}.get(name, "0.12.8"))
    monkeypatch.setattr(self_checks, "requires", lambda name: ["jax>=0.10", "numpy>=2.0", "x>=1; extra == 'viz'"])
    monkeypatch.setattr(self_checks, "_TESTED", {"jax": ("0.10.2", "0.12.0"), "numpy": ("2.4", "2.5")})
    (failed,) = texts("versions", "FAIL")
    assert failed == "jax 0.9.1 is older than 0.10, the oldest that works; pip install -U 'jax>=0.10'."
    assert [text.split(" was")[0] for text in texts("versions", "note")] == ["jax 0.9.1", "numpy 3.0.0rc1"]


@pytest.mark.parametrize(("text", "number"), [("0.12.0.1", (0, 12, 0)), ("2.5", (2, 5)), ("3.13.0rc1+x9", (3, 13, 0))])
def test_versions_are_numbers(text: str, number: tuple[int, ...]) -> None:
    assert self_checks._number(text) == number


def test_too_little_memory_and_disk_fail(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    assert texts("memory", "FAIL") == texts("disk", "FAIL") == []
    monkeypatch.setattr(self_checks, "_ENOUGH", 1e18)
    assert texts("memory", "FAIL") == ["Detection needs 1000000000.0 GB; close other programs."]
    assert all(
        text.endswith(f"free some space in {where}.")
        for text, where in zip(texts("disk", "FAIL"), (Path.cwd(), cache.parent), strict=True)
    )


def test_the_cache_is_created_and_measured(cache: Path) -> None:
    (text,) = texts("cache", "ok")
    assert text == f"{cache} is writable and holds 0 MB in 0 files"
    cache.rmdir()
    cache.write_text("a file")
    (text,) = texts("cache", "FAIL")
    assert re.search("set JAX_COMPILATION_CACHE_DIR to a folder that can be written", text)


def test_another_result_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    means = dict(self_checks._MEANS)
    monkeypatch.setattr(self_checks, "forward", lambda: (self_checks._VOXELS, means))
    assert len(texts("forward", "ok")) == 1
    for voxels, factor, off in (
        (self_checks._VOXELS, 1.01, "1.0e-02"),
        (self_checks._VOXELS, float("nan"), "nan"),
        (1, 1.0, "0"),
    ):
        monkeypatch.setattr(self_checks, "forward", lambda: (voxels, means | {"iou": means["iou"] * factor}))  # noqa: B023
        (text,) = texts("forward", "FAIL")
        assert f"{voxels} voxels instead of {self_checks._VOXELS}, and outputs that are off by {off}" in text


def test_missing_extras_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_checks, "_installed", lambda name: name != "plotly")
    assert texts("extras", "note") == [
        "Without plotly there are no pictures and 3D pages; pip install 'ciassd_jax[viz]'."
    ]
    assert texts("extras", "ok") == ["tb for TensorBoard events"]


def test_without_a_device_the_forward_pass_is_not_blamed(monkeypatch: pytest.MonkeyPatch) -> None:
    def devices() -> list[Any]:
        raise RuntimeError("no backend")

    monkeypatch.setattr(jax, "devices", devices)
    assert texts("forward", "note") == ["Not run, because there is no device; see devices."]


def test_without_a_cache_the_disk_is_not_blamed(cache: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", None)
    assert texts("disk", "FAIL") == []
    (text,) = texts("cache", "FAIL")
    assert text == (
        "Compiled programs cannot be kept (~/.cache cannot be written); set JAX_COMPILATION_CACHE_DIR to a folder that "
        "can be written."
    )
