"""The API reference is whole and its links lead somewhere; docstrings name the errors that their code raises."""

import ast
import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

import pytest

import bayes_impedance
from bayes_impedance import errors

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = Path(bayes_impedance.__file__).parent

SOURCES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if path.name != "__main__.py"
}
ERRORS = {name for name in vars(errors) if name.endswith("Error")}
#: What a page shows of the source, with a number at each line.
SOURCE_CODE = re.compile(
    r'<div class="pdoc-code codehilite"><pre><span></span><span id=.*?</pre>', flags=re.DOTALL
)
#: Special methods that a page may show.
SHOWN = {"__init__", "__getitem__", "__call__"}


class Page(HTMLParser):
    """Anchors, links, visible text and preformatted text of a page, without the source code in it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self.preformatted = ""
        self._open: list[str] = []
        content = path.read_text(encoding="utf-8")
        self.feed(SOURCE_CODE.sub("<div>", content))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        self.anchors += [value for name, value in attrs if name == "id" and value]
        if tag == "a" and attributes.get("href"):
            self.links.append(str(attributes["href"]))
        if tag in ("pre", "style", "script"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if self._open and self._open[-1] == tag:
            self._open.pop()

    def handle_data(self, data: str) -> None:
        if "style" not in self._open and "script" not in self._open:
            self.text += data
            if self._open:
                self.preformatted += data


@dataclass(frozen=True)
class Reference:
    """The reference as built, and the pages that were looked at."""

    folder: Path
    seen: dict[Path, Page] = field(default_factory=dict)

    def page(self, path: Path) -> Page:
        if path not in self.seen:
            self.seen[path] = Page(path)
        return self.seen[path]

    def page_of(self, module: str) -> Page:
        return self.page(self.folder / f"{module.replace('.', '/')}.html")

    @property
    def pages(self) -> dict[Path, Page]:
        return {path: self.page(path) for path in sorted(self.folder.rglob("*.html"))}


def build(folder: Path, package: Path = PACKAGE) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "docs" / "reference"), str(folder)]
    environment = os.environ | {"PYTHONPATH": str(package.parent)}
    return subprocess.run(
        command, cwd=folder.parent, env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    folder = tmp_path_factory.mktemp("reference") / "api"
    result = build(folder)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    return Reference(folder)


def test_every_public_module_has_a_page(reference: Reference) -> None:
    for module in SOURCES:
        assert module in reference.page_of(module).text


@pytest.mark.parametrize("package", [name for name, path in SOURCES.items() if path.name == "__init__.py"])
def test_a_package_lists_what_it_offers_by_name(reference: Reference, package: str) -> None:
    names = [
        alias.name
        for node in ast.parse(SOURCES[package].read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    ]
    links = reference.page_of(package).links
    for name in names:
        assert [link for link in links if link.endswith(f"#{name}")], name


def test_front_page_opens_with_the_example_of_the_readme(reference: Reference) -> None:
    code, *_ = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert code in reference.page_of("bayes_impedance").preformatted


def test_formulas_are_preformatted_and_reachable_from_every_page(reference: Reference) -> None:
    formulas = reference.folder / "formulas.html"
    lines = (ROOT / "docs" / "model.md").read_text(encoding="utf-8").splitlines()
    shown = [line.strip() for line in lines if line.startswith("    ")]
    assert shown
    for line in shown:
        assert line in reference.page(formulas).preformatted
    for module in SOURCES:
        path = reference.folder / f"{module.replace('.', '/')}.html"
        targets = [(path.parent / link.partition("#")[0]).resolve() for link in reference.page(path).links]
        assert formulas in targets, module


def test_aligned_text_is_preformatted(reference: Reference) -> None:
    for path in reference.folder.rglob("*.html"):
        content = path.read_text(encoding="utf-8")
        for shown in re.findall(r'<div class="docstring">(.*?)</div>', content, re.DOTALL):
            prose = re.sub(r"<pre>.*?</pre>", "", shown, flags=re.DOTALL)
            assert not re.search(r"\S {3,}\S|<blockquote", prose), f"{path.name}: {prose}"


def test_internal_links_resolve(reference: Reference) -> None:
    for path, page in reference.pages.items():
        for link in page.links:
            if link.startswith("https://"):
                continue
            name, _, anchor = link.partition("#")
            target = (path.parent / name).resolve() if name else path
            assert target.is_file(), f"{path.name}: {link}"
            assert not anchor or anchor in reference.page(target).anchors, f"{path.name}: {link}"


def test_nothing_private_is_listed(reference: Reference) -> None:
    for path, page in reference.pages.items():
        parts = {part for anchor in page.anchors for part in anchor.removesuffix("-view-source").split(".")}
        assert {part for part in parts if part.startswith("_")} <= SHOWN, path.name
        assert not re.search(r"(?:^|[\s(\[.,=])_[A-Za-z]\w+", page.text), path.name


def test_pages_know_nothing_of_the_machine_or_the_run(reference: Reference) -> None:
    places = {str(ROOT), str(reference.folder), sys.prefix, sys.base_prefix, str(Path.home())} - {"/"}
    for path in reference.folder.rglob("*.*"):
        content = path.read_text(encoding="utf-8")
        assert not [place for place in places if place in content], path.name
        assert not re.search(r"0x[0-9a-f]{6,}", content), path.name


def test_fields_of_the_configuration_show_what_they_allow(reference: Reference) -> None:
    def page(section: str) -> str:
        return re.sub(r"\s+", " ", reference.page_of(f"bayes_impedance.config.{section}").text)

    assert "median: float (required, > 0)" in page("sections")
    assert "log_sd: float (> 0, ≤ 5) = 1.0" in page("sections")
    assert "smoother: Smoother | None = Smoother()" in page("preprocessing")


def test_a_broken_reference_fails_the_build_and_writes_nothing(tmp_path: Path) -> None:
    package = tmp_path / "bayes_impedance"
    package.mkdir()
    whole = ["`Arm.stiffness`", "`LIMIT`", "ValueError", "docs/model.md §2", "`(n, axes)`", "`best[a]`"]
    broken = ["`Arn`", "`stifness`", "`Arm.best`", "MissingError", "docs/model.md §99"]
    (package / "__init__.py").write_text(
        f'"""{", ".join(whole + broken)}."""\n\n#: A limit.\nLIMIT = 1\nbest = []\n\n\n'
        'class Arm:\n    """Of a person."""\n\n    stiffness = 1.0\n',
        encoding="utf-8",
    )
    result = build(tmp_path / "api", package)
    assert result.returncode == 1
    reports = re.findall(r"bayes_impedance: expected .*?, found `(.*?)`", result.stderr)
    assert reports == [name.strip("`") for name in broken]
    assert not (tmp_path / "api").exists()


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "letters"
    folder.mkdir()
    (folder / "letter.txt").write_text("Dear Ada", encoding="utf-8")
    result = build(folder)
    assert result.returncode == 1
    assert "found other content" in result.stderr and "Traceback" not in result.stderr
    assert [path.name for path in folder.iterdir()] == ["letter.txt"]


def raised(function: ast.FunctionDef) -> set[str]:
    """Errors of ours that a function raises itself."""
    calls = [
        node.exc
        for node in ast.walk(function)
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)
    ]
    return {call.func.id for call in calls if isinstance(call.func, ast.Name)} & ERRORS


def lacking(body: list[ast.stmt], owner: ast.ClassDef | None = None) -> list[str]:
    """Functions whose docstring lacks an error that they raise; a class speaks for its constructor."""
    found = []
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            found += lacking(node.body, node)
        elif isinstance(node, ast.FunctionDef):
            # What typer shows as help has no such section.
            if any(ast.unparse(decorator).startswith("app.command") for decorator in node.decorator_list):
                continue
            constructs = owner is not None and node.name in ("__init__", "__post_init__")
            if node.name.startswith("_") and not constructs:
                continue
            docstring = ast.get_docstring(owner if constructs and owner else node) or ""
            _, _, section = docstring.partition("\nRaises:\n")
            found += [f"{node.name}: {error}" for error in sorted(raised(node)) if error not in section]
    return found


@pytest.mark.parametrize("module", SOURCES)
def test_docstrings_name_the_errors_that_their_code_raises(module: str) -> None:
    assert lacking(ast.parse(SOURCES[module].read_text(encoding="utf-8")).body) == []
