"""The API reference, built from the docstrings of the package: `python docs/reference FOLDER`.

pdoc renders. `members.py` says what of the package it shows and in which words, `links.py` turns names into
links. Whatever warns fails the build, a name in back-ticks that the package does not know included.
"""

from __future__ import annotations

import platform
import shutil
import sys
import warnings
from pathlib import Path

import pdoc.doc
import pdoc.extract
import pdoc.render
from links import Links
from members import exports, present, written_annotations
from text import Formulas, to_html, to_markdown

PACKAGE = "bayes_impedance"
FORMULAS = Path(__file__).resolve().parent.parent / "model.md"


def build(folder: Path) -> None:
    """Write every page into `folder`, in place of an older reference."""
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "formulas.html").is_file():
        raise SystemExit(
            f"{folder}: expected a new folder or an older reference, found other content; name another"
        )
    # h5py asks for it when it is imported, and pdoc lets no import run a command; from now on it is known.
    platform.processor()
    with written_annotations():
        modules = {name: pdoc.doc.Module.from_name(name) for name in pdoc.extract.walk_specs([PACKAGE])}
        for module in modules.values():
            present(module)
        formulas = Formulas(FORMULAS)
        pdoc.render.configure(docformat="google", template_directory=Path(__file__).parent / "templates")
        links = Links(modules, formulas.anchors)
        environment = pdoc.render.env
        environment.filters |= {
            "to_markdown": to_markdown,
            "to_html": to_html,
            "linkify": links.linkify,
        }
        environment.globals["exports"] = {name: exports(module) for name, module in modules.items()}
        pages = {
            f"{name.replace('.', '/')}.html": pdoc.render.html_module(module, modules)
            for name, module in modules.items()
        }
        pages["formulas.html"] = environment.get_template("formulas.html.jinja2").render(formulas=formulas)
        pages["index.html"] = pdoc.render.html_index(modules)
        pages["search.js"] = pdoc.render.search_index(modules)
    if links.broken:
        raise SystemExit("\n".join(["the reference was not written:", *links.broken]))
    shutil.rmtree(folder, ignore_errors=True)
    for name, page in pages.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    warnings.simplefilter("error")
    # linear_operator, which gpytorch imports, decorates a function with it.
    warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", DeprecationWarning)
    if len(sys.argv) != 2:
        raise SystemExit("expected the folder to write to; give it as the only argument")
    build(Path(sys.argv[1]))
