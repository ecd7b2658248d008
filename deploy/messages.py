"""Every message of the product: what errors, logs, verbs and pages say to a person, as its text stands in the code.

`make messages` writes them to tests/golden/messages.txt, so that a change of wording is reviewed in one place.
`keyed` replaces each by a key: what still works then reads no sentence of ours (tests/support/keyed).
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from hashlib import sha1
from pathlib import Path

ROOT = Path(__file__).parents[1]
PARTS = ("common", "coordinator", "worker", "dreamfleet")
SPEAKERS = {
    "debug",
    "info",
    "warning",
    "error",
    "exception",
    "critical",
    "log",
    "log_event",
    "print",
    "warn",
    "print_answer",
    "Failure",
}
LISTS_FLAGS = "configure"  # its texts are those of docs/reference/verbs.md
PROSE = re.compile(r"(?<![\w<{./-])[a-z]{2,}[,;:]? (?:[a-z]+[,;:]? )+[a-z]{2,}")
NO_PROSE = re.compile(
    r"^\s*(?:SELECT|INSERT|UPDATE|DELETE|CREATE|PRAGMA|ALTER|WITH|BEGIN|<)|</|/>|\bimport \w|\bdef \w"
    r"|^\s*\w+(?:, \w+)+\s*$"  # columns of a table
    r"|^outside \w+ \w+$"  # matplotlib's place of a legend
)
VALUE = "\ue000-\uf8ff"  # each stands for an expression of an f-string
# What is data within a sentence: names in backquotes, flags, values and what they stand in, numbers, ends of lines, &&.
DATA = re.compile(
    rf"`[^`]*`|--[a-z{VALUE}][a-z0-9{VALUE}-]*|(?:[{VALUE}][:/.=]?)*[{VALUE}]|(?<!\w)\d[\d.,]*(?!\w)"
    r"|%\(\w+\)[#0-9.+-]*[a-zA-Z]|%[#0-9.+-]*[a-zA-Z]|\{[^{}]*\}|\n|&&"
)


def product_files() -> Iterator[Path]:
    """The modules of the product."""
    for part in PARTS:
        for path in sorted((ROOT / part).rglob("*.py")):
            if not any(each.is_symlink() for each in path.parents if each != ROOT):
                yield path


def template(node: ast.expr) -> str | None:
    """The text of a literal, with the expressions of an f-string in braces; None for what is no text."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(map(template_of_part, parts))
    return None


def template_of_part(part: ast.expr) -> str:
    """A part of an f-string: its text, or its expression in braces."""
    return f"{{{ast.unparse(part.value)}}}" if isinstance(part, ast.FormattedValue) else str(template(part))


def own_words(node: ast.JoinedStr) -> str:
    """An f-string without the code of its expressions."""
    return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)


class Messages(ast.NodeTransformer):
    """Finds the messages of a module; with `replace` each literal gives way to a key and to the data in it."""

    def __init__(self, module: str, *, replace: bool = False) -> None:
        self.found: list[tuple[str, str]] = []
        self._module, self._replace = module, replace
        self._place: list[str] = []
        self._speaks = False

    def visit(self, node: ast.AST) -> ast.AST:
        """The node with its messages replaced. What is compared or looked up is data, or a fault that this shows."""
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name) if (
                name != LISTS_FLAGS
            ):
                self._place.append(name)
                described = ast.get_docstring(node, clean=False) is not None
                node.body = node.body[:described] + [self.visit(each) for each in node.body[described:]]  # type: ignore[misc]
                self._place.pop()
            case ast.Call():
                self._visit_call(node)
            case ast.JoinedStr():
                for each in node.values:
                    if isinstance(each, ast.FormattedValue):
                        each.value = self._visit_value(each.value, speaks=False)
                return self._literal(node)
            case ast.Constant():
                return self._literal(node)
            case ast.Compare() | ast.Subscript() | ast.FunctionDef():
                pass
            case _:
                self.generic_visit(node)
        return node

    def _visit_value(self, node: ast.expr, *, speaks: bool) -> ast.expr:
        before, self._speaks = self._speaks, speaks
        new: ast.expr = self.visit(node)  # type: ignore[assignment]
        self._speaks = before
        return new

    def _visit_call(self, node: ast.Call) -> None:
        """What is said: an error's text, a line of a log, an answer."""
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if isinstance(node.func, ast.Attribute):
            node.func = self._visit_value(node.func, speaks=False)
        speaks = name in SPEAKERS or name.endswith("Error")
        has_code = len(node.args) > 1 and (name.endswith("Error") or name == "log_event")  # a text, and what kind it is
        node.args = [self._visit_value(each, speaks=speaks and not (has_code and _is_code(each))) for each in node.args]
        for keyword in node.keywords:
            if keyword.arg not in {"help", "metavar", "description"}:
                keyword.value = self._visit_value(keyword.value, speaks=False)

    def _literal(self, node: ast.Constant | ast.JoinedStr) -> ast.expr:
        text = template(node)
        if text is None or not self._place or NO_PROSE.search(text) or DATA.fullmatch(text):
            return node
        own = text if isinstance(node, ast.Constant) else own_words(node)
        if not (self._speaks and re.search(r"[a-z]{2,}", own)) and not PROSE.search(own):
            return node
        self.found.append((".".join((self._module, *self._place)), text))
        if not self._replace:
            return node
        place = f"{self._module}:{node.lineno}:{node.col_offset}"
        key = "m" + sha1(place.encode(), usedforsecurity=False).hexdigest()[:8]
        if isinstance(node, ast.Constant):
            new: ast.expr = ast.Constant(" ".join([key, *DATA.findall(text)]))
        else:
            new = ast.JoinedStr(_with_data(key, node.values))
        return ast.fix_missing_locations(ast.copy_location(new, node))


def _with_data(key: str, parts: Sequence[ast.expr]) -> list[ast.expr]:
    """The parts of an f-string of a key and the data in these parts."""
    values = {chr(0xE000 + number): part for number, part in enumerate(parts) if isinstance(part, ast.FormattedValue)}
    marked = "".join(chr(0xE000 + number) if isinstance(part, ast.FormattedValue) else str(template(part))
                     for number, part in enumerate(parts))  # fmt: skip
    kept = " ".join([key, *DATA.findall(marked)])
    return [values.get(each) or ast.Constant(each) for each in re.split(f"([{VALUE}])", kept)]


def _is_code(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and str(node.value).count(" ") < 2


def keyed(tree: ast.Module, module: str) -> ast.Module:
    """The module with a key in place of each message; flags, numbers, names and values in it stay."""
    Messages(module, replace=True).visit(tree)
    return tree


def catalogue() -> str:
    """Each message with the place that says it, in the order of the code."""
    lines = []
    for path in product_files():
        finder = Messages(".".join(path.relative_to(ROOT).with_suffix("").parts))
        finder.visit(ast.parse(path.read_text()))
        lines += [f"{place}: {' '.join(text.split())}" for place, text in finder.found]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(catalogue(), end="")
