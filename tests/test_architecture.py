# SPDX-License-Identifier: GPL-3.0-or-later
"""The rules of docs/architecture.md that can be read off the source, checked over syntax trees and files.

Each rule is a function from a source text to the breaches found in it, so that a second test can show that it finds what it looks for.
"""

from __future__ import annotations

import ast
import functools
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LINES = 500
OURS = {"adjoint_gi", "solvers", "operators", "panels", "adjgi", "bl_ext"}
BLENDER = {"bpy", "bpy_extras", "bpy_types", "addon_utils", "bl_ui", "blf", "bl_operators", "bmesh", "gpu", "gpu_extras", "mathutils"}
NETWORK = {"socket", "ssl", "http", "urllib", "ftplib", "smtplib", "imaplib", "poplib", "xmlrpc", "socketserver", "requests", "aiohttp"}
UNSAFE = {"pickle", "_pickle", "cPickle", "marshal", "shelve", "dill", "joblib", "cloudpickle"}

# folder -> (libraries beyond Python's own, parts of ours) that its files may import
RULES = {
    "adjoint_gi/core": ({"numpy", "embreex", "OpenEXR", "xatlas"}, {"adjoint_gi/core"}),
    "solvers": ({"numpy"}, {"solvers", "adjoint_gi/core"}),
    "adjoint_gi/bridge": ({"numpy", *BLENDER}, {"adjoint_gi/bridge", "adjoint_gi/core", "solvers", ""}),
    "operators": (BLENDER, {"operators", "adjoint_gi/bridge", ""}),
    "panels": (BLENDER, {"panels", "adjoint_gi/bridge", ""}),
}
# The folders of each side in the one-way order: a file may import from its own folder and from those before it.
ORDER = {
    "adjoint_gi/core": "base images sampling scene gallery bsdf lights receivers method denoise walks elements flux "
    "radiosity two_pass directional comparison",
    "adjoint_gi/bridge": "host results extract props engine baking comparison cli",
}
PARTS = sorted([*RULES, "adjoint_gi", ""], key=len, reverse=True)


def part_of(path: str) -> str:
    """The folder of RULES that `path` (relative, with forward slashes) belongs to; empty for the root."""
    return next(part for part in PARTS if part == "" or path == part or path.startswith((part + "/", part + ".")))


@functools.cache
def parsed(source: str) -> ast.Module:
    """The syntax tree of a source, which most rules ask for."""
    return ast.parse(source)


def dotted(node: ast.AST) -> str:
    """Names joined by dots, as in `numpy.random.rand`; empty for any other expression."""
    if isinstance(node, ast.Attribute):
        before = dotted(node.value)
        return before and f"{before}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def imports(tree: ast.AST, path: str) -> Iterator[tuple[str, bool]]:
    """Every imported thing as (dotted name, False), or as (path from our root, True) for a relative import."""
    folder = path.split("/")[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, False) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module, False
        elif isinstance(node, ast.ImportFrom):
            base = folder[: len(folder) - node.level + 1] + (node.module.split(".") if node.module else [])
            # `from . import x` may import the module x or a name of the package: the longer path names its part as well.
            yield from (("/".join([*base, alias.name]), True) for alias in node.names)


def wrong_imports(source: str, path: str) -> list[str]:
    """Imports that break the table of parts."""
    libraries, ours = RULES[part_of(path)]
    found = []
    for name, relative in imports(parsed(source), path):
        allowed = part_of(name) in ours if relative else name.split(".")[0] in libraries | sys.stdlib_module_names
        if not allowed:
            found.append(f"imports {name}")
    return found


def against_order(source: str, path: str) -> list[str]:
    """Imports from a folder that stands later in `ORDER`, or of a method by another; also inside functions."""
    part = part_of(path)
    names = [name for name, relative in imports(parsed(source), path) if relative]
    if part == "solvers":
        return [f"imports the method {name}" for name in names if name.startswith("solvers/") and path != "solvers/__init__.py"]
    order = ORDER.get(part, "").split()
    if not order or path == f"{part}/__init__.py":
        return []
    rank = {f"{part}/{folder}": i for i, folder in enumerate(order)}
    own = rank.get(path.rsplit("/", 1)[0], -1)
    found = [] if own >= 0 else ["lies in no folder of ORDER"]
    for name in names:
        folder = "/".join(name.split("/")[:3])
        if rank.get(folder, -1) > own:
            found.append(f"imports {name}, which comes later")
    return found


def circles(sources: dict[str, str]) -> list[list[str]]:
    """Groups of modules that import each other, however far around; imports inside functions and for type checkers count."""
    needs = {path: sorted(_modules(source, path, sources)) for path, source in sources.items()}
    found, number, lowest, stack = [], {}, {}, []

    def visit(path: str) -> None:  # Tarjan's strongly connected components
        number[path] = lowest[path] = len(number)
        stack.append(path)
        for other in needs[path]:
            if other not in number:
                visit(other)
            if other in stack:
                lowest[path] = min(lowest[path], lowest[other])
        if lowest[path] == number[path]:
            group = stack[stack.index(path) :]
            del stack[stack.index(path) :]
            if len(group) > 1:
                found.append(sorted(group))

    for path in sources:
        if path not in number:
            visit(path)
    return found


def _modules(source: str, path: str, known: dict[str, str]) -> set[str]:
    """The files of `known` that the module imports, itself left out."""
    out = set()
    for name in [name for name, relative in imports(parsed(source), path) if relative]:
        places = [f"{place}{end}" for place in (name, name.rpartition("/")[0]) for end in (".py", "/__init__.py")]
        out.add(next((place for place in places if place in known), path))
    return out - {path}


def own_names(source: str, path: str) -> list[str]:
    """Absolute imports of our own packages: they would load every module a second time."""
    return [f"imports {name}" for name, relative in imports(parsed(source), path) if not relative and name.split(".")[0] in OURS]


def network(source: str, path: str) -> list[str]:
    """Network modules: the extension asks for no network permission."""
    return [f"imports {name}" for name, relative in imports(parsed(source), path) if not relative and name.split(".")[0] in NETWORK]


def unsafe(source: str, path: str) -> list[str]:
    """Ways to run what a file says: eval, exec, pickles, a shell; and numpy files opened without `allow_pickle=False`."""
    tree = parsed(source)
    found = [f"imports {name}" for name, relative in imports(tree, path) if not relative and name.split(".")[0] in UNSAFE]
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        name = dotted(call.func)
        keywords = {keyword.arg: keyword.value for keyword in call.keywords}
        if name in ("eval", "exec", "__import__", "os.system", "os.popen"):
            found.append(f"calls {name} in line {call.lineno}")
        if "shell" in keywords and ast.unparse(keywords["shell"]) != "False":
            found.append(f"runs a shell in line {call.lineno}")
        if name in ("np.load", "numpy.load") and "allow_pickle" not in keywords:
            found.append(f"{name} without allow_pickle in line {call.lineno}")
        if "allow_pickle" in keywords and ast.unparse(keywords["allow_pickle"]) != "False":
            found.append(f"allow_pickle is not False in line {call.lineno}")
    return found


def hidden_state(source: str, path: str) -> list[str]:
    """Randomness that no generator was passed for, unbuffered sums, and code that looks for its own place on the disk."""
    tree = parsed(source)
    found = [f"imports {name}" for name, relative in imports(tree, path) if not relative and name == "random"]
    for node in ast.walk(tree):
        text = dotted(node)
        legacy = re.fullmatch(r"(?:np|numpy)\.random\.([a-z]\w*)", text)
        if (legacy and legacy[1] != "default_rng") or text in ("np.add.at", "numpy.add.at", "__file__", "sys.path"):
            found.append(f"uses {text} in line {node.lineno}")
    return found


def prints(source: str, path: str) -> list[str]:
    """Printing below the line: a method speaks through its result and its notices only."""
    calls = (node for node in ast.walk(parsed(source)) if isinstance(node, ast.Call))
    return [f"prints in line {call.lineno}" for call in calls if dotted(call.func) in ("print", "sys.stdout.write", "sys.stderr.write")]


def offsets(source: str, path: str) -> list[str]:
    """Rays moved off their surface anywhere but in the two functions `lifted`; the spheres around the scene may ask how far that is."""
    if path in ("adjoint_gi/core/scene/world.py", "adjoint_gi/core/scene/faces.py", "adjoint_gi/core/scene/clusters.py"):
        return []
    nodes = (node for node in ast.walk(parsed(source)) if isinstance(node, ast.Attribute) and node.attr == "offset")
    return [f"reads {ast.unparse(node)} in line {node.lineno}" for node in nodes if ast.unparse(node.value).endswith("world")]


def version_checks(source: str, path: str) -> list[str]:
    """Comparisons of Blender's version outside the one file that is for them."""
    if path == "adjoint_gi/bridge/host/versions.py":
        return []
    nodes = (node for node in ast.walk(parsed(source)) if isinstance(node, ast.Attribute))
    return [f"reads {text} in line {node.lineno}" for node in nodes if (text := dotted(node)) in ("bpy.app.version", "app.version")]


def overrides(source: str, path: str) -> list[str]:
    """`temp_override` outside the two files where no thread can be at work: with one it crashes Blender (docs/architecture.md)."""
    if path in ("adjoint_gi/bridge/cli/demo.py", "adjoint_gi/bridge/comparison/cycles_reference.py"):
        return []
    nodes = (node for node in ast.walk(parsed(source)) if isinstance(node, ast.Attribute))
    return [f"uses it in line {node.lineno}" for node in nodes if node.attr == "temp_override"]


def shared_writes(source: str, path: str) -> list[str]:
    """UVs written by `uv_layers[...].uv`, which before Blender 5.2 reaches the copies of a mesh; its attribute of that name is safe."""
    nodes = [node for node in ast.walk(parsed(source)) if isinstance(node, ast.Attribute)]
    calls = [n for n in nodes if n.attr == "foreach_set" and isinstance(n.value, ast.Attribute) and n.value.attr == "uv"]
    single = [n for n in nodes if n.attr == "vector" and isinstance(n.ctx, ast.Store) and ".uv[" in ast.unparse(n)]
    return [f"writes {ast.unparse(node)} in line {node.lineno}" for node in (*calls, *single)]


def identifiers(source: str, path: str) -> list[str]:
    """Names that cannot be typed or searched for on every keyboard."""
    if source.isascii():
        return []
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return [
        f"name {token.string!r} in line {token.start[0]}" for token in tokens if token.type == tokenize.NAME and not token.string.isascii()
    ]


def length(source: str, path: str) -> list[str]:
    """Files over the limit that do not give their reason in the head comment."""
    count = len(source.splitlines())
    reason = re.search(rf"more than {LINES} lines because", " ".join(source.split("\n")[:30]), re.IGNORECASE)
    return (
        [f"{count} lines, and no reason such as 'More than {LINES} lines because ...' at its head"] if count > LINES and not reason else []
    )


# Written in pieces, so that this file does not break its own rules.
OPEN_WORDS = re.compile(r"\b(" + "|".join(["TO" + "DO", "FIX" + "ME", "X" + "XX", "NotImplemented" + "Error"]) + r")\b")
BARE_SKIP = re.compile(r"@pytest\.mark\.(skip|xfail)(\(|\s*$)", re.MULTILINE)
PLACES = re.compile(
    "|".join(["/ro" + "ot/", "/ho" + "me/", "/wo" + "rk/", "/o" + "pt/", "/t" + "mp/", r"[A-Z]:\\\\?Users", "/Us" + "ers/"])
)
HOSTS = re.compile("|".join([r"py" + r"pi\.", "python" + "hosted", r"deb\." + "debian", r"registry\." + "npm"]))


def left_open(source: str, path: str) -> list[str]:
    """Words for unfinished work, and tests switched off without a condition."""
    return [f"says {match[0].strip()!r}" for pattern in (OPEN_WORDS, BARE_SKIP) for match in pattern.finditer(source)]


def places(source: str, path: str) -> list[str]:
    """Paths of one machine and names of package servers."""
    return [f"names {match[0]!r}" for pattern in (PLACES, HOSTS) for match in pattern.finditer(source)]


def tracked() -> list[str]:
    """All files of the repository, new ones included, as git sees them; in an unpacked archive all but hidden and made ones."""
    answer = subprocess.run(["git", "ls-files", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True)
    if answer.returncode == 0:
        return sorted(line for line in answer.stdout.splitlines() if (ROOT / line).is_file())
    made = {"wheels", "dist", "build", "out"}
    paths = (path.relative_to(ROOT) for path in ROOT.rglob("*") if path.is_file())
    return sorted(path.as_posix() for path in paths if path.parts[0] not in made and not path.parts[0].startswith(".venv"))


@functools.cache
def read(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


FILES = tracked()
PYTHON = [path for path in FILES if path.endswith(".py")]
PRODUCT = [path for path in PYTHON if part_of(path) in RULES]
BELOW = [path for path in PRODUCT if part_of(path) in ("adjoint_gi/core", "solvers")]
TEXT = [path for path in FILES if path.endswith((".py", ".md", ".toml", ".txt", ".json", ".csv", ".html")) or path == ".ci/run"]

CHECKS = [
    (wrong_imports, PRODUCT),
    (against_order, PRODUCT),
    (own_names, PRODUCT),
    (network, PRODUCT),
    (unsafe, PYTHON),
    (hidden_state, PRODUCT),
    (prints, BELOW),
    (offsets, BELOW),
    (version_checks, PRODUCT),
    (overrides, PRODUCT),
    (shared_writes, PRODUCT),
    (identifiers, PYTHON),
    (length, PYTHON),
    (left_open, PYTHON),
    (places, TEXT),
]


@pytest.mark.parametrize(("rule", "paths"), CHECKS, ids=lambda value: getattr(value, "__name__", ""))
def test_rule_holds(rule, paths):
    assert paths, "the rule looks at no file"
    breaches = [f"{path}: {breach}" for path in paths for breach in rule(read(path), path)]
    assert not breaches, "\n".join([rule.__doc__, *breaches])


BREACHES = [
    (wrong_imports, "adjoint_gi/core/x.py", "import bpy"),
    (wrong_imports, "adjoint_gi/core/x.py", "from ...solvers import path_tracing"),
    (wrong_imports, "adjoint_gi/core/x.py", "from ..bridge.extract import extract"),
    (wrong_imports, "solvers/x.py", "def f():\n    import bpy"),
    (wrong_imports, "solvers/x.py", "from ..adjoint_gi import bridge"),
    (wrong_imports, "solvers/x.py", "import scipy.sparse"),
    (wrong_imports, "operators/x.py", "from ..solvers import load"),
    (wrong_imports, "panels/x.py", "import numpy as np"),
    (against_order, "adjoint_gi/core/scene/x.py", "from ..lights import direct"),
    (against_order, "adjoint_gi/core/scene/x.py", "def f():\n    from ..lights.direct import from_hits"),
    (against_order, "adjoint_gi/core/x.py", "import numpy"),
    (against_order, "adjoint_gi/bridge/host/x.py", "from ..cli import main"),
    (against_order, "solvers/x.py", "from .path_tracing import PathSettings"),
    (own_names, "solvers/x.py", "from adjoint_gi.core import scene"),
    (own_names, "operators/x.py", "import bl_ext.user_default.adjoint_gi"),
    (network, "adjoint_gi/bridge/x.py", "from urllib.request import urlopen"),
    (unsafe, "solvers/x.py", "import pickle"),
    (unsafe, "solvers/x.py", "y = eval('1')"),
    (unsafe, "solvers/x.py", "np.load(path)"),
    (unsafe, "solvers/x.py", "np.load(path, allow_pickle=flag)"),
    (unsafe, "bench/x.py", "subprocess.run(text, shell=True)"),
    (hidden_state, "solvers/x.py", "x = np.random.rand(3)"),
    (hidden_state, "solvers/x.py", "np.add.at(a, i, b)"),
    (hidden_state, "adjoint_gi/bridge/x.py", "here = __file__"),
    (prints, "solvers/x.py", "print(1)"),
    (offsets, "adjoint_gi/core/walks/x.py", "origin = position + self.world.offset * normal"),
    (version_checks, "operators/x.py", "new = bpy.app.version >= (5, 0, 0)"),
    (overrides, "operators/x.py", "with context.temp_override(window=window):\n    pass"),
    (shared_writes, "adjoint_gi/bridge/x.py", "layer.uv.foreach_set('vector', values)"),
    (shared_writes, "adjoint_gi/bridge/x.py", "mesh.uv_layers[0].uv[3].vector = (0, 0)"),
    (identifiers, "solvers/x.py", "\u03c1 = 0.5"),
    (length, "solvers/x.py", '"""Doc."""\n' * (LINES + 1)),
    (left_open, "solvers/x.py", "# TO" + "DO later"),
    (left_open, "tests/x.py", "@pytest.mark." + "skip\ndef test(): pass"),
    (places, "docs/x.md", "see /ho" + "me/me/scene.blend"),
    (places, "docs/x.md", "from py" + "pi.org"),
]


@pytest.mark.parametrize(("rule", "path", "source"), BREACHES)
def test_rule_finds_a_breach(rule, path, source):
    assert rule(source, path)


def test_right_code_passes_every_rule():
    source = '"""Doc."""\nimport numpy as np\nfrom ..adjoint_gi.core import scene\nx = np.load(p, allow_pickle=False)\n'
    assert [breach for rule, _ in CHECKS for breach in rule(source, "solvers/x.py")] == []


def test_a_class_name_means_one_thing():
    """No two classes of the product have the same name; those of tests are their own."""
    names = [node.name for path in PRODUCT for node in ast.walk(ast.parse(read(path))) if isinstance(node, ast.ClassDef)]
    public = [name for name in names if not name.startswith("_")]
    assert len(public) > 100
    assert sorted({name for name in public if public.count(name) > 1}) == []


@pytest.mark.parametrize(("part", "order"), ORDER.items())
def test_order_names_every_folder(part, order):
    """Each folder has its place in `ORDER`, a head note, and nothing but that in its `__init__.py`."""
    folders = {path.split("/")[2] for path in PRODUCT if path.startswith(part + "/") and path.count("/") > 2}
    assert sorted(order.split()) == sorted(folders)
    for folder in folders:
        assert f'"adjgi.{part.replace("/", ".")}.{folder}"' in read("pyproject.toml"), f"pyproject.toml does not install {folder}"
        body = ast.parse(read(f"{part}/{folder}/__init__.py")).body
        assert len(body) == 1 and ast.get_docstring(ast.parse(read(f"{part}/{folder}/__init__.py")))


def test_no_circle_of_modules():
    found = circles({path: read(path) for path in PRODUCT})
    assert not found, "\n".join(map(str, found))


def test_circles_are_found():
    lazy = {"core/a.py": "def f():\n    from .b import g", "core/b.py": "from . import c", "core/c.py": "from .a import f"}
    assert circles(lazy) == [["core/a.py", "core/b.py", "core/c.py"]]
    assert circles(lazy | {"core/b.py": "import numpy"}) == []


def test_root_does_nothing_at_import_time():
    body = ast.parse(read("__init__.py")).body
    assert ast.get_docstring(ast.parse(read("__init__.py")))
    assert all(isinstance(node, ast.FunctionDef) for node in body[1:]), "only functions may stand in the root __init__.py"


def test_method_modules_are_listed_once():
    """The tuple in solvers/__init__.py names exactly the method files; files with a leading underscore are shared helpers."""
    from adjgi import solvers

    files = {Path(path).stem for path in PRODUCT if re.fullmatch(r"solvers/[^_/]\w*\.py", path)}
    assert len(set(solvers.MODULES)) == len(solvers.MODULES)
    assert set(solvers.MODULES) == files


def test_registry_agrees_with_the_files():
    """Every module registers the method of its own name, in the order of the tuple, with a number of its own."""
    from adjgi import solvers
    from adjgi.adjoint_gi.core.method import registry

    solvers.load()
    specs = [(method.spec, type(method).__module__.rsplit(".", 1)[-1]) for method in registry.methods()]
    ours = [(spec, module) for spec, module in specs if module in solvers.MODULES]
    assert [module for _, module in ours] == list(solvers.MODULES)
    assert [spec.id for spec, _ in ours] == list(solvers.MODULES)
    assert len({spec.number for spec, _ in ours}) == len(ours)
    for spec, _ in ours:
        assert spec.year and spec.authors and spec.title and spec.equation and spec.limits, spec.id
