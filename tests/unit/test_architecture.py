"""Dependencies point one way, heavy libraries stay where they belong, public names are pinned."""

import ast
import importlib
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import mcsim

ROOT = Path(mcsim.__file__).parent

# Packages from the bottom to the top: each imports only what stands before it.
ORDER = (
    "errors",
    "support",
    "config",
    "sphere",
    "stats",
    "instrument",
    "systematics",
    "bipolar",
    "simulation",
    "ensemble",
    "beamfit",
    "plot",
    "comparison",
    "datavector",
    "reconstruction",
    "information",
    "diagnosis",
    "benchmark",
    "cli",
)

# The only packages that may import what stands on the left of them.
RESERVED = {
    "zarr": {"mcsim.ensemble.datasets", "mcsim.ensemble.store"},
    "dask": {"mcsim.ensemble.runner"},
    "distributed": {"mcsim.ensemble.runner"},
    "pydantic": {"mcsim.config", "mcsim.datavector", "mcsim.diagnosis"},
    "typer": {"mcsim.cli"},
    "camb": set(),
}

# Pure science: numbers in, numbers out. It imports nothing of the wiring, which reads configurations, stores and draws.
SCIENCE = {
    f"mcsim.{name}" for name in ("errors", "support", "sphere", "stats", "instrument", "systematics", "bipolar")
} | {
    f"mcsim.simulation.{name}"
    for name in ("convolve", "inverse_covariance", "mapmaking", "preconditioner", "rings", "tod")
}

PUBLIC = {
    "mcsim.config": [
        "Beam",
        "BeamBlm",
        "BeamEllipticalGaussian",
        "BeamGaussian",
        "BeamMap",
        "BeamWindow",
        "Biposh",
        "Channel",
        "Compute",
        "Effect",
        "Ensemble",
        "Map",
        "Noise",
        "Nuisance",
        "RunConfig",
        "Scan",
        "ScanDifferencing",
        "ScanHitAveraged",
        "ScanMoments",
        "ScanParallelTransport",
        "ScanPointing",
        "Sky",
        "analysis_lmax",
        "channel_path",
        "check_skies",
        "complete",
        "differences",
        "digest",
        "from_json",
        "json_schema",
        "load",
        "map_names",
        "pixel_window",
        "prepared_grid",
        "resolved",
        "science",
        "sky_path",
        "to_dict",
        "to_json",
    ],
    "mcsim.errors": ["InputError", "RunError"],
    "mcsim.support.resources": ["names", "scan_model", "spectrum", "workflow"],
    "mcsim.sphere.spectra": ["last", "load"],
}


def module_name(path: Path) -> str:
    parts = ("mcsim", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(ROOT.rglob("*.py"))}


@cache
def imports(name: str, whole: bool) -> set[str]:
    """Modules that a module imports; ``whole`` includes imports inside functions."""
    found = set()
    tree = ast.parse(MODULES[name].read_text())
    for node in ast.walk(tree) if whole else tree.body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} imports relatively; the project imports absolutely"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in MODULES else str(node.module))
    return found


def inside(name: str, packages: set[str]) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


EDGES = [(name, imported) for name in MODULES for imported in sorted(imports(name, whole=True))]
"""Every module with each that it imports; one test looks at all of them, as a test for each module costs more."""


def test_heavy_libraries_stay_in_their_modules():
    reserved = [(name, imported, RESERVED.get(imported.split(".")[0])) for name, imported in EDGES]
    assert [
        (name, imported) for name, imported, where in reserved if where is not None and not inside(name, where)
    ] == []


def test_science_imports_only_science():
    own = [(name, imported) for name, imported in EDGES if inside(name, SCIENCE) and inside(imported, {"mcsim"})]
    assert len(own) > 100
    assert [edge for edge in own if not inside(edge[1], SCIENCE)] == []


def package(name: str) -> str:
    own = name.split(".")[1] if "." in name else "mcsim"
    return "cli" if own == "__main__" else own


def test_packages_depend_one_way():
    # What ``import mcsim`` offers lazily from its own modules is no dependency.
    edges = [edge for edge in EDGES if edge[0] != "mcsim" and inside(edge[1], {"mcsim"}) and edge[1] != "mcsim"]
    level = {name: ORDER.index(package(name)) for name in MODULES if name != "mcsim"}
    assert [edge for edge in edges if ORDER.index(package(edge[1])) > level[edge[0]]] == []


def test_imports_have_no_circles():
    graph = {name: {target for target in imports(name, whole=True) if target in MODULES} for name in MODULES}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail, name))
        if name not in done:
            for target in graph[name]:
                visit(target, (*trail, name))
            done.add(name)

    for name in graph:
        # What ``import mcsim`` offers lazily from its own modules is no circle.
        if name != "mcsim":
            visit(name, ())


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names(name):
    module = importlib.import_module(name)
    own = getattr(module, "__all__", None)
    if own is None:
        own = [
            key
            for key, value in vars(module).items()
            if not key.startswith("_") and getattr(value, "__module__", "") == name
        ]
    assert sorted(own) == PUBLIC[name]
    assert all(hasattr(module, key) for key in own)


def test_modules_fit_a_screen_of_thought():
    long = {name: lines for name, path in MODULES.items() if (lines := len(path.read_text().splitlines())) > 450}
    assert not long


def test_configuration_is_light():
    """Reading a TOML file must not start dask, zarr, numba or matplotlib: ``--help`` and errors are quick."""
    heavy = ("dask", "distributed", "zarr", "numba", "matplotlib")
    code = f"import sys, mcsim.config; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_scripts_import_what_there_is():
    missing = []
    for script in sorted((Path(__file__).parents[2] / "workflows").rglob("*.py")):
        for node in ast.walk(ast.parse(script.read_text())):
            if isinstance(node, ast.ImportFrom) and inside(str(node.module), {"mcsim"}):
                module = importlib.import_module(str(node.module))
                names = [alias.name for alias in node.names]
                known = [name for name in names if hasattr(module, name) or f"{node.module}.{name}" in MODULES]
                missing += [f"{script.name}: {node.module}.{name}" for name in names if name not in known]
    assert not missing
