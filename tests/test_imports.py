"""Who may import whom: the layers of the package, read from the source with `ast` so that lazy imports count too."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "nfc_gym"

# package -> the packages of ours that it may import ("" is nfc_gym/__init__.py, for `__version__`)
ALLOWED: dict[str, set[str]] = {
    "core": set(),
    "physics": {"core"},
    "terrain": {"core"},
    "assets": {"core"},
    "inference": {"", "core"},
    "envs": {"core", "physics", "terrain", "assets"},
    "wrappers": {"core", "physics", "terrain"},
    "measured": {"", "core", "physics", "terrain", "assets"},
    # of inference only `windows`, the format on disk
    "simulate": {"core", "physics", "terrain", "assets", "envs", "wrappers", "inference"},
    "adaptation": {"", "core", "physics", "terrain", "assets", "inference", "envs", "wrappers", "measured", "simulate"},
    "cli": {
        "",
        "core",
        "physics",
        "terrain",
        "assets",
        "inference",
        "envs",
        "wrappers",
        "measured",
        "simulate",
        "adaptation",
    },
    "__main__": {"cli"},
    "": {"core", "envs", "inference"},
}
# package -> all that it may import from outside the standard library
ALLOWED_OUTSIDE: dict[str, set[str]] = {
    "core": {"numpy"},
    "physics": {"numpy", "mujoco"},
    "cli": {"typer", "rich"},
}
FORBIDDEN_OUTSIDE: dict[str, set[str]] = {
    "inference": {"mujoco", "gymnasium"},
    "measured": {"torch"},
    "wrappers": {"torch"},
}


def imported(tree: ast.AST, module: str) -> Iterator[str]:
    """Dotted names that a module imports anywhere in its source; relative imports are made absolute."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = module.split(".")[: -node.level]
                base = ".".join([*parents, base] if base else parents)
            yield from (f"{base}.{alias.name}" for alias in node.names)


def package_of(name: str) -> str:
    """`nfc_gym.physics.effects.x` -> `physics`; names of `nfc_gym/__init__.py` itself -> the empty string."""
    part = name.split(".")[1] if "." in name else ""
    return part if part in ALLOWED else ""


def violations(source: str, module: str) -> list[str]:
    """Imports in a module's source that the two tables do not allow."""
    own = package_of(module)
    found = []
    for name in imported(ast.parse(source), module):
        top = name.split(".")[0]
        if top == "nfc_gym":
            if package_of(name) not in ALLOWED[own] | {own}:
                found.append(f"{module} imports {name}")
        elif top not in sys.stdlib_module_names:
            outside = ALLOWED_OUTSIDE.get(own)
            if (outside is not None and top not in outside) or top in FORBIDDEN_OUTSIDE.get(own, set()):
                found.append(f"{module} imports {name}")
    return found


def modules() -> list[tuple[str, Path]]:
    """Every module of the package as (dotted name, path); a package's `__init__` keeps that last part."""
    return [
        (".".join(("nfc_gym", *p.relative_to(PACKAGE).with_suffix("").parts)), p) for p in sorted(PACKAGE.rglob("*.py"))
    ]


def test_every_import_follows_the_layers() -> None:
    found = [line for name, path in modules() for line in violations(path.read_text(encoding="utf-8"), name)]
    assert not found, "\n".join(found)


def test_every_subpackage_is_in_the_table() -> None:
    folders = {p.name for p in PACKAGE.iterdir() if p.is_dir() and any(p.rglob("*.py"))}
    assert folders <= set(ALLOWED)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("nfc_gym.physics.state", "from nfc_gym.measured import dataset"),
        ("nfc_gym.physics.effects.drag", "from ...measured import dataset"),
        ("nfc_gym.physics.state", "def f():\n    import scipy.linalg"),
        ("nfc_gym.core.log", "from nfc_gym import physics"),
        ("nfc_gym.wrappers.effects", "import nfc_gym.envs.base"),
        ("nfc_gym.inference.score", "import mujoco"),
    ],
)
def test_a_forbidden_import_is_seen(module: str, source: str) -> None:
    assert violations(source, module)


@pytest.mark.parametrize(
    ("statement", "unwanted"),
    [
        (
            "import nfc_gym",
            {
                "torch",
                "torchrl",
                "stable_baselines3",
                "plotly",
                "pandas",
                "pydantic",
                "pyarrow",
                "cma",
                "jinja2",
                "matplotlib",
            },
        ),
        ("import nfc_gym.cli", {"torch", "plotly", "pandas", "pydantic", "scipy", "mujoco", "yaml"}),
    ],
)
def test_importing_stays_light(statement: str, unwanted: set[str]) -> None:
    code = f"{statement}; import sys; print(sorted({unwanted!r} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=True)
    assert out.stdout.strip() == "[]"
