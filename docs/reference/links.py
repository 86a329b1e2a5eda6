"""Names in docstrings, signatures and annotations as links; a name in back-ticks that nobody knows is broken."""

from __future__ import annotations

import ast
import builtins
import html
import inspect
import re
from collections.abc import Mapping

import pdoc.doc
from jinja2 import pass_context
from jinja2.runtime import Context
from markupsafe import Markup
from pdoc.render_helpers import relative_link

NAME = r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*"
#: A name, perhaps called, indexed or followed by its shape: `FeatureMap(config, axes)`, `best[a]`, `time (n,)`.
REFERENCE = re.compile(rf"({NAME})(\s?[(\[].*)?", flags=re.DOTALL)
#: What is looked at in the HTML of a docstring; blocks of code and links that stand already pass by.
DOCSTRING = re.compile(
    r"(?P<skip><pre>.*?</pre>|<a .*?</a>)"
    r"|<code>(?P<code>.*?)</code>"
    r"|(?P<formulas>docs/model\.md)(?: §(?P<section>\d+))?"
    r"|\b(?P<error>[A-Z]\w*(?:Error|Warning))\b",
    flags=re.DOTALL,
)
SIGNATURE = re.compile(rf"(?P<skip><[^>]*>|&\w+;|'[^']*')|(?P<name>{NAME})")

#: Module and qualified name of what a link leads to.
Target = tuple[str, str]


class Links:
    """Links between the pages of some modules; `anchors` are those of the sections of the formulas."""

    def __init__(self, modules: Mapping[str, pdoc.doc.Module], anchors: Mapping[str, str]) -> None:
        self.modules = modules
        self.anchors = anchors
        self.package = min(modules, key=len)
        self.broken: list[str] = []
        self._vocabulary = set[str]().union(*(_vocabulary(module) for module in modules.values()))
        everywhere: dict[str, list[Target]] = {}
        for module in modules.values():
            for name in module.members:
                everywhere.setdefault(name, []).append((module.modulename, name))
        #: Classes of a name that no other module has; functions are too often called as a word is.
        self._unique = {
            name: targets[0]
            for name, targets in everywhere.items()
            if len(targets) == 1 and name[0].isupper()
        }

    @pass_context
    def linkify(self, context: Context, code: str, namespace: str = "", shorten: bool = True) -> Markup:
        """In place of pdoc's filter, which knows only full names; `shorten` tells signatures from docstrings."""
        module = context["module"]

        def in_docstring(match: re.Match[str]) -> str:
            if match["skip"]:
                return match[0]
            if match["formulas"]:
                return self._formulas_link(module, match)
            if match["error"]:
                target = self.resolve(match["error"], module, namespace)
                if target is None and not hasattr(builtins, match["error"]):
                    self._report(module, namespace, match["error"])
                return self._link(module, target, match[0])
            return f"<code>{self._reference(module, namespace, match['code'])}</code>"

        def in_signature(match: re.Match[str]) -> str:
            name = match["name"]
            # A parameter has a name of lower case, and is no reference.
            if not name or not name.rpartition(".")[2][0].isupper():
                return match[0]
            return self._link(module, self.resolve(name, module, namespace), name)

        pattern, replace = (SIGNATURE, in_signature) if shorten else (DOCSTRING, in_docstring)
        return Markup(pattern.sub(replace, str(code)))

    def resolve(self, name: str, module: pdoc.doc.Module, namespace: str) -> Target | None:
        """Where `name` is documented, as the code at `namespace` in `module` would find it."""
        while namespace:
            if self._shows(module.modulename, f"{namespace}.{name}"):
                return module.modulename, f"{namespace}.{name}"
            namespace = namespace.rpartition(".")[0]
        if self._shows(module.modulename, name):
            return module.modulename, name
        if "." in name:
            for full in (name, f"{self.package}.{name}"):
                if full in self.modules:
                    return full, ""
                owner, _, member = full.rpartition(".")
                if owner in self.modules and self._shows(owner, member):
                    return owner, member
        head, _, rest = name.partition(".")
        if head in module.obj.__dict__:
            # pathlib's Path, say, which is not the Path of another page.
            target = self._imported(head, module)
        else:
            target = self._imported(head, self.modules[self.package]) or self._unique.get(head)
        if target is None or not rest:
            return target
        return (target[0], f"{target[1]}.{rest}") if self._shows(target[0], f"{target[1]}.{rest}") else None

    def _imported(self, name: str, module: pdoc.doc.Module) -> Target | None:
        """A class, function or described variable of another module that `module` has imported."""
        thing = module.obj.__dict__.get(name)
        if thing is None or inspect.ismodule(thing):
            return None
        origin = str(getattr(thing, "__module__", None))
        if origin in self.modules and self._shows(origin, name):
            return origin, name
        return next(
            (
                (other, name)
                for other, page in self.modules.items()
                if page.obj.__dict__.get(name) is thing and self._shows(other, name)
            ),
            None,
        )

    def _shows(self, module: str, qualname: str) -> bool:
        """Whether a page has such an entry; what a class inherits from another library has none."""
        doc = self.modules[module].get(qualname)
        return doc is not None and doc.taken_from[0] in self.modules and not doc.name.startswith("_")

    def _reference(self, module: pdoc.doc.Module, namespace: str, code: str) -> str:
        """What stands in back-ticks, with a link where it names something; broken where it seems to and does not."""
        match = REFERENCE.fullmatch(html.unescape(code))
        if match is None or self._is_parameter(match[1], module, namespace):
            return code
        target = self.resolve(match[1], module, namespace)
        if target is None:
            if not self._is_known(match[1], module, namespace):
                self._report(module, namespace, match[1])
            return code
        return self._link(module, target, match[1]) + html.escape(match[2] or "")

    def _is_known(self, name: str, module: pdoc.doc.Module, namespace: str) -> bool:
        """Whether a name without an entry of its own means something: a column, a key, a file, an attribute."""
        head, _, rest = name.partition(".")
        target = self.resolve(head, module, namespace) if rest else None
        owner = None if target is None else self.modules[target[0]].get(target[1])
        if isinstance(owner, pdoc.doc.Class):
            return hasattr(owner.obj, rest)
        return name in self._vocabulary or self._vocabulary.issuperset(name.split("."))

    @staticmethod
    def _is_parameter(name: str, module: pdoc.doc.Module, namespace: str) -> bool:
        function = module.get(namespace)
        return isinstance(function, pdoc.doc.Function) and name in function.signature.parameters

    def _formulas_link(self, module: pdoc.doc.Module, match: re.Match[str]) -> str:
        section = match["section"]
        if section is not None and section not in self.anchors:
            self._report(module, "", match[0])
            return match[0]
        anchor = "" if section is None else f"#{self.anchors[section]}"
        return f'<a href="{"../" * module.modulename.count(".")}formulas.html{anchor}">{match[0]}</a>'

    def _link(self, module: pdoc.doc.Module, target: Target | None, text: str) -> str:
        if target is None:
            return text
        page, qualname = target
        return f'<a href="{relative_link(module.modulename, page)}#{qualname}">{text}</a>'.replace(
            '#">', '">'
        )

    def _report(self, module: pdoc.doc.Module, namespace: str, name: str) -> None:
        where = ".".join(filter(None, (module.modulename, namespace)))
        self.broken.append(f"{where}: expected a name of the package or of its data, found `{name}`; mend it")


def _vocabulary(module: pdoc.doc.Module) -> set[str]:
    """Every name and every short text in the code of a module: parameters, attributes, keys, columns, files."""
    words: set[str] = set()
    for node in ast.walk(ast.parse(inspect.getsource(module.obj))):
        match node:
            case ast.Name(id=word) | ast.arg(arg=word) | ast.Attribute(attr=word) | ast.alias(name=word):
                words.add(word)
            case ast.keyword(arg=str(word)) | ast.Constant(value=str(word)) if len(word) < 50:
                words.add(word)
            case ast.FunctionDef(name=word) | ast.ClassDef(name=word):
                words.add(word)
    return words
