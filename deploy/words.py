"""Count the words of documents: words a page, sentences that are too long, words that a reader has to read twice.

`make words` prints the figures; `tests/docs/test_words.py` holds those that must not grow. User documents are README
and `docs/` without its lab notes, in which sentences may be as long as their figures need.
"""

from __future__ import annotations

import ast
import json
import re
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
BANNED = Path(__file__).with_name("banned-words.txt")
SIDES = ("common", "coordinator", "worker", "dreamfleet/experiments")
LONG_SENTENCE = 30  # words
USER = ("tutorials", "how-to", "reference", "explanation")  # folders of docs/ whose words have one limit together
PRINTED = "printed"  # the name under which texts of the code are counted

FENCE = re.compile(r"^( *)(```+|~~~+).*?^\1\2\s*$", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"<!--.*?-->|\A---\n.*?^---$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(`+).+?\1", re.DOTALL)
LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)(?:\{[^}]*\})?")
# What begins a block of its own: a heading, an item of a list, a quotation, an admonition.
BEGINNING = re.compile(r"^\s*(?:#+|[-*+]|\d+[.)]|>|!!!|\?\?\?|===)\s+")
END = re.compile(r"(?:(?<=[.!?])|(?<=[.!?][\"')*_])|(?<=[.!?][\"')*_]{2}))\s+(?=[A-Z0-9\"'(*_`\[±])")
ABBREVIATION = re.compile(r"\b(?:e\.g|i\.e|etc|vs|cf|s\.e)\.$")


def pages() -> list[Path]:
    """The documents of the project, relative to its folder."""
    found = (
        path for part in ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "deploy/*.md") for path in ROOT.glob(part)
    )
    return sorted(path.relative_to(ROOT) for path in found)


def is_for_users(page: Path) -> bool:
    """Whether sentences of a page are held to `LONG_SENTENCE`."""
    return page.parts[:2] != ("docs", "lab")


def prose(text: str) -> str:
    """A page without code blocks and comments, its links as their texts and each piece of code as one word."""
    text = COMMENT.sub("", FENCE.sub("\n\n", text))
    return LINK.sub(r"\1", CODE.sub("CODE", text))


def words(text: str) -> list[str]:
    """What of a text between blanks holds a letter or a digit."""
    return [word for word in text.split() if any(letter.isalnum() for letter in word)]


def blocks(text: str) -> Iterator[str]:
    """Headings, paragraphs, items and table cells of a page's prose."""
    block: list[str] = []
    for line in (*prose(text).splitlines(), ""):
        row = line.strip().startswith("|")
        if (row or not line.strip() or BEGINNING.match(line)) and block:
            yield " ".join(block)
            block = []
        if row:
            yield from (cell.strip() for cell in line.strip().strip("|").split("|"))
        elif line.strip():
            block.append(BEGINNING.sub("", line).strip())


def sentences(text: str) -> Iterator[str]:
    """The sentences of a page, one after the other."""
    for block in blocks(text):
        begun = ""
        for part in END.split(block):
            begun = f"{begun} {part}".strip()
            if not ABBREVIATION.search(begun):
                yield begun
                begun = ""
        if begun:
            yield begun


def long_sentences(page: Path) -> list[str]:
    """The sentences of a page that have more than `LONG_SENTENCE` words."""
    return [each for each in sentences((ROOT / page).read_text()) if len(words(each)) > LONG_SENTENCE]


@cache
def banned() -> re.Pattern[str]:
    """All expressions of `banned-words.txt` as one."""
    lines = (line for line in BANNED.read_text().splitlines() if line and not line.startswith("#"))
    return re.compile("|".join(rf"\b(?:{line.partition(' : ')[0]})\b" for line in lines), re.IGNORECASE)


def banned_in(page: Path) -> list[str]:
    """The banned words of a page, in the order of the page."""
    return [" ".join(match.group().split()) for match in banned().finditer(prose((ROOT / page).read_text()))]


def printed(path: Path) -> Iterator[tuple[int, str]]:
    """The texts in a file's code with a blank in them, each with its line: no docstrings, no names."""
    tree = ast.parse((ROOT / path).read_text())
    alone = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in alone and " " in node.value:
            yield node.lineno, node.value


def banned_in_code() -> list[str]:
    """The banned words in texts that programs print, as `file:line: word`."""
    found = []
    for path in sorted(path for side in SIDES for path in (ROOT / side).rglob("*.py")):
        name = path.relative_to(ROOT)
        found += [f"{name}:{line}: {each.group()}" for line, text in printed(name) for each in banned().finditer(text)]
    return found


def sizes() -> dict[str, int]:
    """The words of two kinds of pages that have a limit.

    "user": tutorials, how-to, reference (generated pages too) and explanation, without the code blocks that tests run.
    "lab": lab notes, all of it.
    """
    texts = {page: (ROOT / page).read_text() for page in pages() if page.parts[0] == "docs"}
    user = [prose(text) for page, text in texts.items() if page.parts[1] in USER]
    return {
        "user": sum(len(words(text)) for text in user),
        "lab": sum(len(words(text)) for page, text in texts.items() if page.parts[1] == "lab"),
    }


def measure() -> dict[str, dict[str, int]]:
    """For each page and for printed texts: words, long sentences where they count, banned words."""
    figures = {
        str(page): {
            "words": len(words((ROOT / page).read_text())),
            "long": len(long_sentences(page)) if is_for_users(page) else 0,
            "banned": len(banned_in(page)),
        }
        for page in pages()
    }
    return {**figures, PRINTED: {"words": 0, "long": 0, "banned": len(banned_in_code())}}


def check_spelling() -> int:
    """Look for American spelling in the documents with codespell's own list of British words, turned round.

    Code within a line is left out. Returns how many words were found; codespell prints them. `pyproject.toml` lists
    words that are right as they are.
    """
    import codespell_lib

    british = Path(codespell_lib.__file__).parent / "data" / "dictionary_en-GB_to_en-US.txt"
    pairs = (line.split("->") for line in british.read_text().splitlines())
    american = [f"{word.strip()}->{own}\n" for own, words in pairs for word in words.split(",") if word.strip()]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.writelines(american)
        file.flush()
        code = ("--ignore-regex", "`[^`]+`")
        found: int = codespell_lib.main("--quiet-level", "3", "--dictionary", file.name, *code, *map(str, pages()))
    return found


def show(names: list[str]) -> None:
    """Print what is to be changed in these pages, or in `printed` texts."""
    for name in names:
        if name == PRINTED:
            print(*banned_in_code(), sep="\n")
            continue
        page = Path(name)
        for sentence in long_sentences(page):
            print(f"{name}: {len(words(sentence))} words: {sentence}")
        for word in banned_in(page):
            print(f"{name}: banned: {word}")


def main() -> None:
    """Print a table; with names of pages what is to be changed there; `--json`: one document; `--spelling`: words."""
    arguments = sys.argv[1:]
    if arguments == ["--spelling"]:
        raise SystemExit(check_spelling())
    if arguments and arguments != ["--json"]:
        show(arguments)
        return
    figures = measure()
    if arguments:
        print(json.dumps(figures, indent=1))
        return
    total = {key: sum(each[key] for each in figures.values()) for key in ("words", "long", "banned")}
    print(f"{'words':>7} {'> 30':>5} {'banned':>7}")
    for name, each in (*figures.items(), ("together", total)):
        print(f"{each['words']:>7} {each['long']:>5} {each['banned']:>7}  {name}")
    print(*(f"{count:>7} words of {kind} pages" for kind, count in sizes().items()), sep="\n")


if __name__ == "__main__":
    main()
