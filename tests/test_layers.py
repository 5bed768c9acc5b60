"""The order of the rooms: who may import whom."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "torchsfm"

# room -> the rooms it may import from, lower ones only; `_types` is open to all.
ALLOWED: dict[str, set[str]] = {
    "_types": set(),
    "linalg": set(),
    "optim": {"linalg"},
    "robust": {"linalg", "optim"},
    "geometry": {"linalg"},
    "images": {"linalg", "optim", "geometry"},
    "tensors": {"linalg", "geometry"},
    "simulation": {"linalg", "geometry", "tensors", "images"},
    "triangulation": {"linalg", "optim", "robust", "geometry", "tensors"},
    "resection": {"linalg", "optim", "robust", "geometry", "tensors"},
    "bundle": {"linalg", "optim", "geometry"},
    "motion": {"linalg", "optim", "robust", "geometry", "tensors", "triangulation"},
    "autocalibration": {"linalg", "optim", "robust", "geometry", "tensors", "motion"},
    "reconstruction": {
        "linalg", "optim", "robust", "geometry", "tensors", "images",
        "triangulation", "resection", "motion", "autocalibration", "bundle",
    },
    "formats": {"linalg", "geometry", "images", "reconstruction"},
    "plot": {"linalg", "geometry", "tensors", "images", "reconstruction"},
}  # fmt: skip
INSIDE = {
    "reconstruction": (
        "messages", "model", "matching", "mapping", "evidence", "mappers", "lines", "curves", "merging",
    ),
}  # fmt: skip
"""Large rooms are divided: each part may import from those before it, and the doors, which stand beside the parts, from all."""
FREE = {"__init__", "cli", "__main__"}
LAZY = {"kornia", "cv2", "matplotlib"}
"""Slow or optional packages, imported inside the functions that use them, and only in the rooms named below."""
OWNERS = {
    "kornia": {"images"},
    "cv2": {"images"},
    "matplotlib": {"plot"},
}

HARMLESS = {
    "vector_norm", "matrix_norm", "norm", "cross", "vecdot", "det", "solve_triangular", "lu_solve",
    "cholesky_ex", "inv_ex", "lu_factor_ex", "solve_ex",
}  # fmt: skip
"""What of `torch.linalg` never raises over the values of its data, and treats each matrix by itself."""
METHODS = {"svd", "qr", "pinverse", "lu", "cholesky", "eig", "lstsq"}
"""Decompositions that are functions of `torch` and methods of tensors too."""


def room_of(path: Path) -> str:
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


def imported_modules(tree: ast.AST) -> list[str]:
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute here"
            names.append(node.module or "")
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


SOURCES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("room", INSIDE)
def test_imports_go_down_inside_a_room(room: str) -> None:
    parts, climbing = INSIDE[room], []
    folders = {path.name for path in (PACKAGE / room).iterdir() if path.is_dir() and (path / "__init__.py").exists()}
    assert folders < set(parts), "every folder has its place in the order"
    for path in sorted((PACKAGE / room).rglob("*.py")):
        part = path.relative_to(PACKAGE / room).parts[0].removesuffix(".py")
        if part in parts:
            names = [name.split(".") for name in imported_modules(ast.parse(path.read_text()))]
            used = {name[2] for name in names if name[:2] == ["torchsfm", room] and len(name) > 2} - {part}
            climbing += [(str(path.relative_to(PACKAGE)), other) for other in used if other not in parts[: parts.index(part)]]
    assert not climbing


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_down(path: Path) -> None:
    room = room_of(path)
    tree = ast.parse(path.read_text())
    used = {name.split(".")[1] for name in imported_modules(tree) if name.startswith("torchsfm.")} - {room, "_types"}
    assert not {name for name in imported_modules(tree) if name == "torchsfm"}, "import from rooms, not from the package"
    if room in FREE:
        return
    assert room in ALLOWED, f"{room} is not in the table of rooms"
    assert used <= ALLOWED[room], f"{room} may not import {sorted(used - ALLOWED[room])}"


FLOORS = ("two_views", "three_views", "many_views")
"""Of `motion`, each of which stands on those before it."""


@pytest.mark.parametrize("floor", FLOORS)
def test_more_views_stand_on_fewer(floor: str) -> None:
    higher = FLOORS[FLOORS.index(floor) + 1 :]
    for path in (PACKAGE / "motion" / floor).glob("*.py"):
        for name in imported_modules(ast.parse(path.read_text())):
            assert not any(name.startswith(f"torchsfm.motion.{above}") for above in higher), (path.name, name)
            assert not name.startswith("torchsfm.motion.") or name.split(".")[2] in FLOORS, (path.name, name)


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_file_is_private(path: Path) -> None:
    """What a room exports is public and all else is free to change; the names of files say nothing of that."""
    assert not path.stem.startswith("_") or path.stem in {"__init__", "__main__", "_types"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_slow_packages_stay_in_their_rooms(path: Path) -> None:
    tree = ast.parse(path.read_text())
    for package in {name.split(".")[0] for name in imported_modules(tree)} & LAZY:
        assert room_of(path) in OWNERS[package], f"{package} belongs to {OWNERS[package]}"
    top_level = ast.Module(body=[n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)], type_ignores=[])
    eager = {name.split(".")[0] for name in imported_modules(top_level)} & LAZY
    assert not eager, f"import {sorted(eager)} inside the functions that use them"


def linalg_names(tree: ast.AST) -> set[str]:
    """What a module takes from `torch.linalg`, by whatever name."""
    modules = {"torch"}
    aliases = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.asname for alias in node.names if alias.name == "torch" and alias.asname}
            assert not any(alias.name.startswith("torch.linalg") for alias in node.names), "write torch.linalg.name"
        elif isinstance(node, ast.ImportFrom):
            assert node.module != "torch.linalg", "write torch.linalg.name"
            assert node.module != "torch" or all(alias.name != "linalg" for alias in node.names), "write torch.linalg.name"
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "linalg":
            owner = node.value.value
            if isinstance(owner, ast.Name) and owner.id in modules:
                aliases.add(node.attr)
    return aliases


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_decompositions_are_guarded(path: Path) -> None:
    if room_of(path) == "linalg":
        return
    tree = ast.parse(path.read_text())
    taken = linalg_names(tree) - HARMLESS
    taken |= METHODS & {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert not taken, f"{sorted(taken)} may raise for the whole batch: take it from torchsfm.linalg"


def test_the_table_has_no_cycle() -> None:
    seen: set[str] = set()
    rooms = dict(ALLOWED)
    while rooms:
        free = [room for room, below in rooms.items() if below <= seen]
        assert free, f"cycle among {sorted(rooms)}"
        seen.update(free)
        for room in free:
            del rooms[room]


def test_every_room_has_a_tenant() -> None:
    for room in PACKAGE.iterdir():
        if room.is_dir() and room.name != "__pycache__":
            assert len(list(room.rglob("*.py"))) > 1, f"{room.name} is empty"
