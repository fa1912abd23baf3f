"""The layers of the package: imports point down only, without circles, and heavy libraries stay where they are used."""

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "ciassd_jax"
# From the bottom to the top: what a folder (or a module at the root) may import besides itself.
BELOW = {
    "types": set(),
    "config": set(),
    "ops": {"types"},
    "formats": {"types", "ops"},
    "model": {"types", "config", "ops", "formats"},
    "data": {"types", "config", "ops", "formats"},
    "simulation": {"types", "config", "ops", "formats", "data"},
    "evaluation": {"types", "config", "ops", "formats", "data"},
    "view": {"types", "config", "ops", "formats", "data"},
    "inference": {"types", "config", "ops", "formats", "model", "data", "simulation", "evaluation", "view"},
}
BELOW["training"] = BELOW["inference"] | {"inference"}
BELOW["cli"] = BELOW["training"] | {"training"}
BELOW["__init__"] = BELOW["training"] | {"training"}
BELOW["__main__"] = {"cli", "inference"}
# Imported where they are used, never at the top of a module, but for tyro in the commands.
LAZY = {"grain", "orbax", "tyro", "tqdm", "matplotlib", "plotly", "PIL", "tensorboardX", "absl", "torch", "spconv"}
# All that `import ciassd_jax` may need; chex brings absl.
AT_THE_TOP = {"jax", "flax", "optax", "chex", "jaxtyping", "safetensors", "numpy"}
MODULES = sorted(PACKAGE.rglob("*.py"))
SCRIPTS = sorted(path for folder in ("benchmarks", "experiments") for path in (ROOT / folder).glob("*.py"))


def imports(path: Path) -> list[tuple[str, bool]]:
    """Imported modules of a file, and whether the import runs when the file is imported."""
    tree = ast.parse(path.read_text())
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    inside = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for inner in ast.walk(node)
    }
    found = []
    for node in ast.walk(tree):
        top = id(node) not in typing_only | inside
        if isinstance(node, ast.Import):
            found += [(alias.name, top) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            found += [(module_of(node.module or "", alias.name), top) for alias in node.names]
    return found


def module_of(module: str, name: str) -> str:
    """The module that `from module import name` imports."""
    place = ROOT / module.replace(".", "/")
    is_module = (place / f"{name}.py").is_file() or (place / name / "__init__.py").is_file()
    return f"{module}.{name}" if is_module else module


def name_of(path: Path) -> str:
    """Module name of a file."""
    return str(path.relative_to(ROOT).with_suffix("")).replace("/", ".").removesuffix(".__init__")


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path: Path) -> None:
    mine = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    for name, top in imports(path):
        package, *rest = name.split(".")
        if package == "ciassd_jax":
            theirs = rest[0] if rest else "__init__"
            assert theirs == mine or theirs in BELOW[mine], f"{path} imports {name}, which is not below it"
        elif package in LAZY:
            assert not top or (package, mine) == ("tyro", "cli"), f"{path} imports {package} at its top"
        elif top and package not in sys.stdlib_module_names:
            assert package in AT_THE_TOP, f"{path} imports {package} at its top"
        if package == "flax":
            assert mine == "model", f"{path} imports flax"
        if package == "orbax":
            assert path.name == "checkpoint.py", f"{path} imports orbax"


@pytest.mark.parametrize("paths", [MODULES, SCRIPTS], ids=["package", "scripts"])
def test_no_module_imports_itself_by_way_of_others(paths: list[Path]) -> None:
    names = {name_of(path) if path in MODULES else path.stem: path for path in paths}
    graph = {name: {other for other, _ in imports(path) if other in names} - {name} for name, path in names.items()}
    # The package's own `__init__` imports everything and is imported by nobody.
    assert not any("ciassd_jax" in others for others in graph.values())
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_three_files_stand_at_the_root() -> None:
    assert {path.name for path in PACKAGE.glob("*.py")} == {"__init__.py", "__main__.py", "types.py"}


@pytest.mark.smoke
def test_import_is_silent_and_starts_no_device() -> None:
    code = (
        "import ciassd_jax, sys, jax._src.xla_bridge as bridge; "
        "assert not bridge._backends, 'a device was initialised'; "
        f"loaded = {LAZY - {'absl'}} & set(sys.modules); assert not loaded, loaded"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
