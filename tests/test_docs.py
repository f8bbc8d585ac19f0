# SPDX-License-Identifier: GPL-3.0-or-later
"""The documentation tells the truth: links lead somewhere, commands parse, tables name every file, generated pages are up to date."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import shlex
from pathlib import Path

import pytest
from adjgi import solvers
from adjgi.adjoint_gi.core.method import registry
from adjgi.tests.test_architecture import ORDER

ROOT = Path(__file__).resolve().parents[1]
PAGES = [p.relative_to(ROOT).as_posix() for p in (ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md")))]
LARGEST = 200_000  # bytes of a picture
LINK = re.compile(r"\]\(([^)\s]+)\)")
ENTRIES = ("adjoint-gi ", "blender -b ")
BAKE_ONLY = {"--report", "--save-blend", "--overwrite"}


def read(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def slug(heading: str) -> str:
    """The anchor that a heading gets on the usual hosts."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def broken_links(text: str, folder: Path) -> list[str]:
    """Relative links and pictures that lead nowhere, anchors included."""
    out = []
    for link in LINK.findall(text):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (folder / name).resolve() if name else None
        if target is not None and not (target.is_file() and target.is_relative_to(ROOT)):
            out.append(link)
            continue
        if anchor:
            there = text if target is None else target.read_text(encoding="utf-8")
            if anchor not in {slug(h) for h in re.findall(r"^#+ (.+)$", there, re.M)}:
                out.append(link)
    return out


def commands(page: str) -> list[str]:
    """Lines of the page's code blocks that call the command line, without their comments."""
    lines = [line.strip() for line in read(page).splitlines() if line.startswith("    ")]
    return [
        re.sub(r"\s+# .*", "", line)
        for line in lines
        if line.startswith(ENTRIES) and ("--command" in line or line.startswith("adjoint-gi"))
    ]


def parser(in_blender: bool):
    pytest.importorskip("bpy", reason="the command line needs bpy")
    from adjgi.adjoint_gi.bridge.cli.arguments import make_parser

    solvers.load()
    return make_parser(in_blender)


def parse(command: str):
    """The options of a command, and the bake or comparison they ask for; raises SystemExit or an AdjointError when it is wrong."""
    in_blender = command.startswith("blender")
    _, _, rest = command.partition("--command adjoint_gi " if in_blender else "adjoint-gi ")
    options = parser(in_blender).parse_args(shlex.split(rest))
    from adjgi.adjoint_gi.bridge.cli import arguments as cli_arguments
    from adjgi.adjoint_gi.bridge.comparison import arguments as compare_arguments

    if options.command in ("bake", "check"):
        assert not cli_arguments.request_of(options).problems()
    elif options.command == "compare":
        compare_arguments.request_of(options)
    elif options.command == "demo":
        for name in options.methods:
            assert name == "all" or registry.method(name)
    return options


def subparsers():
    """Name -> parser of each command."""
    return next(a for a in parser(False)._actions if a.dest == "command").choices


def section(text: str, heading: str, level: str = "### ") -> str:
    """What stands under a heading, up to the next one."""
    _, found, rest = text.partition(f"\n{level}{heading}\n")
    assert found, f"there is no section {heading}"
    return re.split(r"\n##+ ", rest)[0]


@pytest.mark.parametrize("page", PAGES)
def test_links_and_pictures_exist(page):
    assert broken_links(read(page), (ROOT / page).parent) == []


def test_broken_links_are_found():
    text = "# Here\n[a](#here) [b](#there) [c](no/such.md) ![d](README.md) [e](https://x.example/) [f](docs/manual.md#nothing)"
    assert broken_links(text, ROOT) == ["#there", "no/such.md", "docs/manual.md#nothing"]


def test_pictures_are_small():
    pictures = [p for p in (ROOT / "docs").rglob("*") if p.suffix in (".png", ".svg", ".jpg")]
    assert pictures
    assert [p.name for p in pictures if p.stat().st_size > LARGEST] == []


@pytest.mark.parametrize(("page", "least"), [("README.md", 4), ("docs/manual.md", 8)])
def test_commands_parse(page, least):
    shown = commands(page)
    assert len(shown) >= least
    for command in shown:
        try:
            parse(command)
        except SystemExit:
            pytest.fail(f"{page}: {command}")


@pytest.mark.parametrize("command", ["adjoint-gi bake", "adjoint-gi bake x.blend --no-such 1", "adjoint-gi compare x.blend --output"])
def test_wrong_commands_do_not_parse(command, capsys):
    with pytest.raises(SystemExit):
        parse(command)
    assert "usage" in capsys.readouterr().err


def test_developer_commands_exist():
    """`dev.py WORD` in the pages is a command that dev.py documents."""
    known = set(re.findall(r"^    python dev\.py (\w+)", read("dev.py"), re.M))
    used = {word for page in PAGES for word in re.findall(r"dev\.py (\w+)", read(page))}
    assert {"demo", "test", "build"} <= used <= known
    scripts = {name for page in PAGES for name in re.findall(r"python (bench/\w+\.py)", read(page))}
    assert scripts
    assert [name for name in scripts if not (ROOT / name).is_file()] == []


@pytest.mark.parametrize("command", ["bake", "check", "compare", "methods", "demo"])
def test_manual_has_every_option_and_no_other(command):
    own = {o for a in subparsers()[command]._actions for o in a.option_strings if o.startswith("--") and o != "--help"}
    text = section(read("docs/manual.md"), command)
    said = set(re.findall(r"--[a-z][a-z-]*", text)) - {"--help"}
    if command == "check":  # described by its difference to bake
        assert said - {"--method", "--target"} == BAKE_ONLY
        bake = {o for a in subparsers()["bake"]._actions for o in a.option_strings if o.startswith("--") and o != "--help"}
        assert own == bake - BAKE_ONLY
    else:
        assert said == own


@pytest.mark.parametrize("command", ["bake", "compare"])
def test_manual_has_the_defaults(command):
    """A default that the manual's table shows is the parser's."""
    rows = re.findall(r"^\| `(--[a-z-]+)[^`]*` \| ([^|]*) \|", section(read("docs/manual.md"), command), re.M)
    assert len(rows) > 8
    actions = {o: a for a in subparsers()[command]._actions for o in a.option_strings}
    for option, said in rows:
        default = actions[option].default
        if isinstance(default, int | float | str) and not isinstance(default, bool) and default != "":
            shown = f"{default:g}" if isinstance(default, float) else str(default)
            assert said.strip() == shown, option


def bench(name: str):
    """A script of bench/ as a module."""
    spec = importlib.util.spec_from_file_location(f"adjgi_{name}", ROOT / "bench" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_methods_page_is_up_to_date():
    """What `python bench/methods_page.py --page` would write is what stands there."""
    solvers.load()
    made = bench("methods_page").page(json.loads(read("docs/data/methods.json")))
    text = read("docs/methods.md")
    for solver in registry.methods():
        assert f"`{solver.spec.id}`" in text, f"{solver.spec.id} is missing in docs/methods.md"
    different = [(a, b) for a, b in zip(made.splitlines(), text.splitlines(), strict=False) if a != b]
    assert made == text, f"docs/methods.md is old; run `python bench/methods_page.py --page`; first difference: {different[:1]}"


def test_readme_counts_the_methods():
    solvers.load()
    assert f"[{len(registry.methods())} methods](docs/methods.md)" in read("README.md")
    assert f"- {len(registry.methods())} methods." in read("CHANGELOG.md")


@pytest.mark.parametrize("part", ORDER)
def test_architecture_names_every_folder(part):
    """One row a folder, in the one-way order, saying what the folder's own head note says."""
    rows = re.findall(r"^\| `(\w+)/` \| (.+) \|$", section(read("docs/architecture.md"), f"`{part}/`", "## "), re.M)
    notes = {f: ast.get_docstring(ast.parse(read(f"{part}/{f}/__init__.py"))) for f in ORDER[part].split()}
    assert dict(rows) == notes
    assert [folder for folder, _ in rows] == ORDER[part].split()


def test_architecture_names_every_method():
    """One row a file of solvers/, in the order of the menus."""
    rows = re.findall(r"^\| `(\w+)\.py` \|", section(read("docs/architecture.md"), "`solvers/`", "## "), re.M)
    assert rows == list(solvers.MODULES)


def test_picture_of_the_house_is_up_to_date():
    """What `python bench/house_picture.py` would draw is what stands there."""
    assert bench("house_picture").svg() == read("docs/pictures/house.svg"), "run `python bench/house_picture.py`"


NAMED = re.compile(r"`((?:core|bridge|solvers|operators|panels)(?:\.\w+)+)`")


def exists(name: str) -> bool:
    """Whether `folder.module.Class.function`, read from adjoint_gi/ or the root, names a function or class in the sources."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        path = "/".join(["adjoint_gi"] * (parts[0] in ("core", "bridge")) + parts[:end]) + ".py"
        if (ROOT / path).is_file():
            node = ast.parse(read(path))
            for part in parts[end:]:
                kinds = (ast.FunctionDef, ast.ClassDef)
                node = next((n for n in getattr(node, "body", ()) if isinstance(n, kinds) and n.name == part), None)
            return node is not None and end < len(parts)
    return False


def test_architecture_names_what_exists():
    """Every function on one texel's way, and everything else that the page names by its module."""
    text = read("docs/architecture.md")
    way = NAMED.findall(section(text, "One texel's way", "## "))
    assert len(way) > 15 and way[0].startswith("operators") and way[-1].startswith("core.images")
    assert [name for name in NAMED.findall(text) if not exists(name)] == []


@pytest.mark.parametrize(
    "name", ["core.scene.world.Nothing", "core.nowhere.thing", "core.scene.world", "solvers.path_tracing.PathTracing.no"]
)
def test_names_that_do_not_exist_are_found(name):
    assert not exists(name)


def test_to_add_a_method_names_what_a_method_has():
    """The files and tables of the recipe exist, and every method is in them."""
    recipe = section(read("docs/architecture.md"), "To add a method", "## ")
    named = [path for path in re.findall(r"`([\w/.]+\.py)`", recipe) if "my_method" not in path]
    assert named and all((ROOT / path).is_file() for path in named)
    rows = re.findall(r'^    "(\w+)": Row\(', read("tests/methods/test_every_method.py"), re.M)
    assert rows == list(solvers.MODULES)


def test_data_of_benchmarks_is_linked():
    """No numbers without a page that tells where they are from."""
    text = read("docs/benchmarks.md") + read("docs/methods.md")
    assert [p.name for p in (ROOT / "docs" / "data").glob("*.json") if f"data/{p.name}" not in text] == []
    for path in (ROOT / "docs").rglob("*.json"):
        json.loads(path.read_text(encoding="utf-8"))


def test_versions_are_told():
    """The newest entry of the changelog is the version of the manifest, and the README says the oldest Blender."""
    manifest = read("blender_manifest.toml")
    version = re.search(r'^version = "([^"]+)"', manifest, re.M)[1]
    assert re.search(r"^## (\S+)", read("CHANGELOG.md"), re.M)[1] == version
    oldest = re.search(r'^blender_version_min = "(\d+\.\d+)', manifest, re.M)[1]
    assert f"Blender {oldest} LTS" in read("README.md")


def test_benchmark_tables_hold_the_data():
    """The numbers in docs/benchmarks.md are those of the JSON files beside it."""
    text = read("docs/benchmarks.md")
    told = []
    for result in json.loads(read("docs/data/bake_vs_cycles.json"))["results"]:
        for name, ours in (("Cycles", "cycles"), ("path tracing", "ours")):
            told += [
                f"| {result['light']} | {name} | {run['samples']} | {run['seconds']:.2f} | {100 * run['error']:.2f} % |"
                for run in result[ours]
            ]
    for result in json.loads(read("docs/data/cycles_agreement.json"))["results"]:
        told += [
            f"| {100 * row['mean_difference']:+.2f} +- {100 * row['mean_error']:.2f} % | {row['z_rms']:.2f} |" for row in result["rows"]
        ]
    for row in json.loads(read("docs/data/closed_forms.json"))["rows"]:
        told += [
            f"{value:.5f} ({100 * (value / exact - 1):+.2f} %)" for value, exact in zip(row["path_tracing"], row["exact"], strict=True)
        ]
    for row in json.loads(read("docs/data/lightmap_uvs.json"))["rows"]:
        shares = f"{100 * row['covered']:.1f} % | {row['claimed_twice']:,} | {row['too_close']:,} | {row['seconds']:.2f} |"
        told.append(f"| {row['scene']} | {row['resolution']} | {row['way']} | {row['charts']:,} | {shares}")
    assert len(told) > 20
    assert [x for x in told if x not in text] == []
