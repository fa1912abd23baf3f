"""The layers of the package: imports point down only, and heavy libraries stay where they are used."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "ciassd_jax"
LAYERS = [
    {"types", "rebuilding", "config", "training_config", "presets"},
    {"ops", "formats"},
    {"model", "anchors", "targets", "losses", "detections", "data", "evaluation"},
    {
        "prediction",
        "checkpoint",
        "metrics_log",
        "interruption",
        "parallel",
        "validation",
        "fitting",
        "training",
        "weights",
        "detector",
        "export",
        "info",
        "predict_files",
        "scoring",
        "check",
        "submission",
        "demo",
        "view",
        "cli",
    },
]
SIBLINGS = {("prediction", "weights"), ("weights", "prediction")}
MODULES = sorted(PACKAGE.rglob("*.py"))


def room(module: str) -> str:
    """First part of a module's name below the package."""
    return module.split(".")[1] if "." in module else ""


def layer(name: str) -> int:
    """Layer of a room."""
    return next(i for i, names in enumerate(LAYERS) if name in names)


def imports(path: Path) -> list[tuple[str, bool]]:
    """Imported modules of a file, and whether the import stands at the top of it."""
    tree = ast.parse(path.read_text())
    found = []
    for node in ast.walk(tree):
        top = node in tree.body
        if isinstance(node, ast.Import):
            found += [(alias.name, top) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            full = [f"{node.module}.{a.name}" if node.module == "ciassd_jax" else node.module for a in node.names]
            found += [(name, top) for name in full]
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_down(path: Path) -> None:
    relative = path.relative_to(PACKAGE)
    mine = relative.parts[0].removesuffix(".py")
    if mine in ("__init__", "__main__"):
        return
    for name, top in imports(path):
        package = name.split(".")[0]
        if package == "ciassd_jax":
            theirs = room(name)
            assert layer(theirs) <= layer(mine), f"{relative} imports {name} from a layer above"
            if layer(mine) == 2 and theirs != mine:
                assert layer(theirs) < 2, f"{relative} imports its sibling {name}"
            if mine in ("ops", "formats"):
                assert theirs in ("ops", "formats", "types"), f"{relative} knows of {name}"
        if package == "flax":
            assert mine == "model", f"{relative} imports flax"
        if package in ("grain", "tqdm", "tensorboardX", "plotly", "matplotlib", "torch", "spconv"):
            assert not top, f"{relative} imports {package} at its top"
        if package == "orbax":
            assert mine == "checkpoint", f"{relative} imports orbax"
        if package == "tyro":
            assert mine == "cli", f"{relative} imports tyro"


def test_import_is_silent_and_starts_no_device() -> None:
    code = (
        "import ciassd_jax, sys, jax._src.xla_bridge as bridge; "
        "assert not bridge._backends, 'a device was initialised'; "
        "assert not {'grain', 'orbax', 'tyro', 'tqdm', 'matplotlib', 'torch'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
