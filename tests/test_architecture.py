"""The house is in order: floors, no circles, one name per file, no room too large. Computed from the sources alone."""

import ast
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import gift_peft

PACKAGE = Path(gift_peft.__file__).parent
ROOT = Path(__file__).parents[1]

# Lowest first. A module imports its own floor or a lower one. The package's own __init__ is the doorway: it stands
# outside, and so does `python -m gift_peft`.
FLOORS = [
    {"losses", "surface_targets", "files", "images", "rules", "options"},
    {"memory", "replayable", "group_inputs", "group_step"},
    {"captures"},
    {"adapters"},
    {"models"},
    {"dataset"},
    {"prepare"},
    {"evaluation"},
    {"colormap"},
    {"reports"},
    {"training"},
    {"deploy"},
    {"predict"},
    {"studio", "demo"},
    {"cli"},
]
FLOOR = {name: number for number, names in enumerate(FLOORS) for name in names}
DOORWAY = {"gift_peft", "gift_peft.__main__"}
NETWORKS = {"vggt", "metric3d", "moge"}


def module_name(path: Path) -> str:
    parts = ("gift_peft", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def imported(module: str) -> set[str]:
    """The modules of the package that a module imports, at its top, in a function or for its type annotations."""
    path = FILES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name in FILES}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                whole = f"{source}.{alias.name}"
                found |= {whole if whole in FILES else source} & FILES.keys()
    return found - {module}


def imported_by_name(module: str) -> set[str]:
    """Modules that a package imports under a name it puts together: `import_module(f"{__name__}.{name}")`."""
    text = FILES[module].read_text(encoding="utf-8")
    if 'import_module(f"{__name__}.' not in text:
        return set()
    words = {node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant)}
    return {f"{module}.{word}" for word in words if f"{module}.{word}" in FILES}


GRAPH = {module: imported(module) | imported_by_name(module) for module in FILES}


def floor(module: str) -> int:
    return FLOOR[module.split(".")[1]]


def test_the_graph_is_really_read():
    assert "gift_peft.losses" in GRAPH["gift_peft.group_step"]
    assert {"gift_peft.models.vggt", "gift_peft.models.metric3d"} <= GRAPH["gift_peft.models"]
    assert sum(map(len, GRAPH.values())) > 100


def test_every_module_has_a_floor():
    assert {module.split(".")[1] for module in FILES if module not in DOORWAY} <= FLOOR.keys()


def test_no_module_imports_a_higher_floor():
    up = [
        f"{module} -> {other}"
        for module, others in GRAPH.items()
        for other in others
        if module not in DOORWAY and (other in DOORWAY or floor(other) > floor(module))
    ]
    assert not up


def test_no_circles():
    # The doorway is imported by everything that imports the package, and imports nothing at once.
    TopologicalSorter({m: others - DOORWAY for m, others in GRAPH.items() if m not in DOORWAY}).prepare()


def test_no_module_imports_from_examples_or_tests():
    for module, path in FILES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not {name.split(".")[0] for name in names} & {"examples", "tests", "helpers", "tools"}, module


def test_two_files_never_have_the_same_name():
    names = Counter(
        path.name
        for path in FILES.values()
        if path.stem not in ("__init__", "__main__") and path.parent.name not in NETWORKS
    )
    assert not [name for name, count in names.items() if count > 1]


def test_a_public_function_never_has_a_modules_or_folders_name():
    names = {path.stem for path in PACKAGE.iterdir()}
    assert not names & set(gift_peft.__all__)


@pytest.mark.parametrize("folder", ["src", "tests", "examples"])
def test_no_file_is_longer_than_400_lines(folder):
    long = {
        path.relative_to(ROOT).as_posix(): count
        for path in (ROOT / folder).rglob("*.py")
        if (count := len(path.read_text(encoding="utf-8").splitlines())) > 400
    }
    assert not long


def test_no_folder_holds_more_than_a_fifth_of_the_lines():
    lines: Counter = Counter()
    for path in FILES.values():
        lines[path.relative_to(PACKAGE).parts[0]] += len(path.read_text(encoding="utf-8").splitlines())
    assert not [name for name, count in lines.items() if count > lines.total() / 5]


def test_tests_mirror_the_package():
    """Every folder of tests is one of the package's, or holds what tests need."""
    folders = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and not path.name.startswith("__")}
    assert folders <= {path.name for path in PACKAGE.iterdir() if path.is_dir()} | {"helpers", "fixtures", "examples"}


def test_the_page_of_the_architecture_has_these_floors():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    block = text.split("## Floors")[1].split("```")[1]
    there = {name.split(".")[1] for name in FILES if name not in DOORWAY}
    floors = [floor & there for floor in FLOORS]
    assert [set(line.split(", ")) for line in block.strip().splitlines()] == list(filter(None, floors))
