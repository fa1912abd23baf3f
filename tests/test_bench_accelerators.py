"""The report on accelerators: what it reads from a compiled program, and, where a compiler is installed, its rows."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
TEXT = """HloModule jit_f, is_scheduled=true

%sum (a: f32[], b: f32[]) -> f32[] {
  %a = f32[] parameter(0)
  %b = f32[] parameter(1)
  ROOT %c = f32[] add(%a, %b)
}

%inside (p: f32[8,128]) -> f32[8,128] {
  %p = f32[8,128]{1,0} parameter(0)
  ROOT %n = f32[8,128]{1,0} negate(%p)
}

%body (s: (f32[8,128], s32[])) -> (f32[8,128], s32[]) {
  %s = (f32[8,128]{1,0}, s32[]) parameter(0)
  %x = f32[8,128]{1,0} get-tuple-element(%s), index=0
  %y = f32[8,128]{1,0:T(8,128)} fusion(%x), kind=kLoop, calls=%inside
  %r = bf16[3,5]{1,0} all-reduce(%y), to_apply=%sum
  ROOT %t = (f32[8,128]{1,0}, s32[]) tuple(%y, %x)
}

%test (s: (f32[8,128], s32[])) -> pred[] {
  %s.1 = (f32[8,128]{1,0}, s32[]) parameter(0)
  ROOT %l = pred[] fusion(%s.1), kind=kLoop, calls=%inside
}

%branch (s: f32[8]) -> f32[8] {
  %s.2 = f32[8]{0} parameter(0)
  ROOT %k = f32[8]{0} sort(%s.2), dimensions={0}, to_apply=%sum
}

ENTRY %main (p: f32[8,128]) -> f32[8,128] {
  %p.1 = f32[8,128]{1,0} parameter(0)
  %g = (f32[2]{0}, f32[8]{0}) all-gather-start(%p.1), dimensions={0}
  %h = f32[8]{0} all-gather-done(%g)
  %w = (f32[8,128]{1,0}, s32[]) while(%p.1), condition=%test, body=%body, backend_config={"known_trip_count":{"n":"3"}}
  %v = (f32[8,128]{1,0}, s32[]) while(%w), condition=%test, body=%body
  %d = f32[8]{0} conditional(%v, %h, %h), branch_computations={%branch, %branch}
  ROOT %o = f32[8,128]{1,0} custom-call(%v), custom_call_target="f"
}
"""


@pytest.fixture(autouse=True)
def scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)


def test_summary_of_a_text_counted_by_hand() -> None:
    from compiled_hlo import summarise

    found = summarise(TEXT)
    # Three steps of the first loop and one of the other, each with its test; both branches.
    assert found.kernels == {"fusion": 8, "all-reduce": 4, "sort": 2, "all-gather": 1, "custom-call": 1}
    assert (found.unknown_loops, found.counted_steps, found.conditionals) == (1, 3, 1)
    assert found.collectives == {"all-reduce": (4, 4 * 30), "all-gather": (1, 32)}


def test_summary_of_a_program_of_this_backend() -> None:
    from compiled_hlo import summarise

    def program(x: jax.Array, n: jax.Array) -> jax.Array:
        x = jax.lax.fori_loop(0, 40, lambda i, x: jnp.sin(x @ x), x)
        x = jax.lax.while_loop(lambda x: x.sum() < n, lambda x: jnp.cos(x @ x), x)
        return jax.lax.cond(n > 0, lambda x: jnp.sort(x), lambda x: x @ x, x)

    found = summarise(jax.jit(program).lower(jnp.ones((64, 64)), 1.0).compile().as_text())
    assert (found.unknown_loops, found.counted_steps, found.conditionals) == (1, 40, 1)
    assert sum(found.kernels.values()) > 40
    assert found.collectives == {}


@pytest.mark.slow
def test_parts_follow_one_another() -> None:
    from programs import predict, predict_parts, train_parts

    from ciassd_jax.config.presets import tiny

    config = tiny()
    parts = list(predict_parts(config, 2))
    results = {name: jax.eval_shape(part, *given) for name, part, given in parts}
    given = {name: given for name, _, given in parts}
    assert results["fold to BEV"] == given["neck"][-1]
    assert results["neck"] == given["head"][-1]
    assert results["head"] == given["postprocess"][0].predictions
    _, whole, arguments = predict(config, 2)
    assert results["postprocess"] == jax.eval_shape(whole, *arguments)
    for _, part, arguments in train_parts(config, 2):
        jax.eval_shape(part, *arguments)


def test_communication_of_a_ring() -> None:
    from bench_accelerators import Target, communication

    target = Target("cuda", "", 0, link=1e9, latency=1e-3)
    assert communication(target, {"all-reduce": (3, 10**9)}, 2) == pytest.approx(1 + 3e-3)
    assert communication(target, {"all-reduce": (1, 10**9), "all-gather": (1, 10**9)}, 4) == pytest.approx(2.25 + 2e-3)


def run(*options: str) -> subprocess.CompletedProcess[str]:
    script = str(BENCHMARKS / "bench_accelerators.py")
    return subprocess.run([sys.executable, script, *options], capture_output=True, text=True, check=False)


@pytest.mark.skipif(find_spec("libtpu") is not None, reason="the compiler for the TPU is installed")
def test_missing_compiler_is_one_sentence() -> None:
    done = run("--targets", "v5e")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == (
        "The compiler for v5e is not installed; on Python 3.12 or newer, run pip install -e '.[accelerators]'.\n"
    )


@pytest.mark.skipif(find_spec("jax_cuda13_plugin") is None, reason="the compiler for GPUs is not installed")
def test_rows_for_a_gpu_and_what_does_not_fit_it() -> None:
    options = ("--targets", "h100", "--presets", "tiny", "--dtypes", "float32", "--parts", "--only", "predict: head")
    done = run(*options, "--batch", "1", "800000", "--json")
    assert done.returncode == 0, done.stderr
    small, large = map(json.loads, done.stdout.splitlines())
    assert small["program"] == "predict: head"
    assert small["kernels"] > 0
    assert "too many MB" not in small
    assert large["too many MB"] > 0
    assert "GB more than the 84.9 GB of the device; choose a smaller --batch." in done.stderr
