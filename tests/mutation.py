"""What the tests of the engine notice: small faults, drawn by a seed, each planted alone into a copy of the tree.

`python -m tests.mutation` draws mutants of `dispatch`, `jobs`, `run` and `storage`, and names each by its function,
its operator and the code that it replaces. `--replay FILE` plants the mutants of an earlier report into this tree, so
two states of the tests can be compared; one whose code is no longer there counts as gone.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

ROOMS = ("dispatch", "jobs", "run", "storage")
COPIED = ("common", "coordinator", "worker", "deploy", "docs", "dreamfleet", "tests", "pyproject.toml")
COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
            ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In}  # fmt: skip
COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Add, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult}
SECONDS = 300  # a mutant that makes the tests hang is noticed
NO_TESTS = 5  # pytest's exit code where all are deselected


@dataclass(frozen=True)
class Mutant:
    """One planted fault: `before` in `function` of `module` (a path) becomes `after`, at its `nth` place (from 0)."""

    module: str
    function: str
    operator: str
    before: str
    after: str
    nth: int


def changes_of(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Operator and new code of each small fault that this node allows."""
    match node:
        case ast.Compare(left, [operator], [right]) if type(operator) in COMPARED:
            yield "compare", ast.unparse(ast.Compare(left, [COMPARED[type(operator)]()], [right]))
        case ast.BoolOp(operator, values):
            swapped = ast.Or() if isinstance(operator, ast.And) else ast.And()
            yield "logic", ast.unparse(ast.BoolOp(swapped, values))
        case ast.UnaryOp(ast.Not(), operand):
            yield "negation", ast.unparse(operand)
        case ast.BinOp(left, operator, right) if type(operator) in COMPUTED and not isinstance(left, ast.Constant):
            yield "arithmetic", ast.unparse(ast.BinOp(left, COMPUTED[type(operator)](), right))
        case ast.Constant(bool() as value):
            yield "constant", str(not value)
        case ast.Constant(int() as value):
            yield "constant", str(value + 1)
        case ast.Return(ast.expr()):
            yield "return", "return None"
        case ast.If(test):
            yield "condition", ast.unparse(ast.UnaryOp(ast.Not(), test))
        case ast.Expr(ast.Call()) | ast.AugAssign():
            yield "statement", "pass"


def mutants_of(path: Path, module: str) -> Iterator[tuple[Mutant, ast.AST]]:
    """Each mutant of a module, with the node that its new code replaces."""
    text = path.read_text()

    def visit(node: ast.AST, name: str, seen: Counter[tuple[str, str, str]]) -> Iterator[tuple[Mutant, ast.AST]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                yield from visit(child, f"{name}.{child.name}".lstrip("."), Counter())
                continue
            place = child.test if isinstance(child, ast.If) else child
            before = ast.get_source_segment(text, place) or ""
            for operator, after in changes_of(child) if "." in name or isinstance(node, ast.FunctionDef) else ():
                key = (name, operator, before)
                yield Mutant(module, name, operator, before, after, seen[key]), place
                seen[key] += 1
            yield from visit(child, name, seen)

    yield from visit(ast.parse(text), "", Counter())


def mutated(text: str, node: ast.AST, after: str) -> str:
    """`text` with `after` in the place of `node`."""
    lines = text.encode().splitlines(keepends=True)
    assert isinstance(node, (ast.expr, ast.stmt))
    assert node.end_lineno
    assert node.end_col_offset is not None
    start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
    code = f"({after})" if isinstance(node, ast.expr) else after
    return (text.encode()[:start] + code.encode() + text.encode()[end:]).decode()


def all_mutants(root: Path) -> dict[Mutant, ast.AST]:
    """The mutants of the rooms of a tree, in the order of its files."""
    paths = sorted(path for room in ROOMS for path in (root / "coordinator" / room).glob("*.py"))
    return {mutant: node for path in paths for mutant, node in mutants_of(path, str(path.relative_to(root)))}


def passes(copy: Path, module: str) -> bool:
    """Whether the tests of the rooms and of the simulation pass in `copy`, those next to `module` (a path) first."""
    own = f"tests/{Path(module).parent}"
    others = [path for room in ROOMS if (path := f"tests/coordinator/{room}") != own]
    nearest = f"{own}/test_{Path(module).stem}.py"
    steps = ([nearest] if (copy / nearest).exists() else []), [own], [*others, "tests/simulation"]
    command = [sys.executable, "-m", "pytest", "-xq", "-p", "no:cacheprovider", "-m", "not slow and not long"]
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    try:
        return all(
            subprocess.run(
                [*command, *paths], cwd=copy, env=environment, capture_output=True, timeout=SECONDS, check=False
            ).returncode in (0, NO_TESTS)
            for paths in steps if paths
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return False


def is_noticed(copy: Path, mutant: Mutant, node: ast.AST) -> bool:
    """Whether a test fails in `copy` once the mutant is planted there; the copy is whole again afterwards."""
    path = copy / mutant.module
    text = path.read_text()
    path.write_text(mutated(text, node, mutant.after))
    try:
        return not passes(copy, mutant.module)
    finally:
        path.write_text(text)


def main() -> int:
    """Plant mutants in copies of this tree, and write one line of JSON for each."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--replay", type=Path, metavar="FILE", help="the mutants of this report instead of drawn ones")
    parser.add_argument("--output", type=Path, default=Path("build/mutants.jsonl"))
    args = parser.parse_args()
    root = Path(__file__).resolve().parents[1]
    found = all_mutants(root)
    if args.replay:
        records = [json.loads(line) for line in args.replay.read_text().splitlines()]
        drawn = [Mutant(**{key: value for key, value in record.items() if key != "noticed"}) for record in records]
    else:
        drawn = random.Random(args.seed).sample(list(found), min(args.count, len(found)))
    by_name = {(m.function, m.operator, m.before, m.nth): m for m in found}
    counts: Counter[str] = Counter()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, args.output.open("w") as output:
        copies: SimpleQueue[Path] = SimpleQueue()
        for number in range(args.jobs):
            copy = Path(folder) / str(number)
            copy.mkdir()
            for name in COPIED:
                subprocess.run(["cp", "-a", str(root / name), str(copy)], check=True)
            copies.put(copy)
        if not passes(copy, "coordinator/run/run.py"):
            parser.error("the tests fail without a mutant too")

        def play(mutant: Mutant) -> tuple[Mutant, bool | None]:
            here = by_name.get((mutant.function, mutant.operator, mutant.before, mutant.nth))
            if here is None:
                return mutant, None
            copy = copies.get()
            try:
                return mutant, is_noticed(copy, here, found[here])
            finally:
                copies.put(copy)

        with ThreadPoolExecutor(args.jobs) as pool:
            for mutant, noticed in pool.map(play, drawn):
                output.write(json.dumps({**asdict(mutant), "noticed": noticed}) + "\n")
                output.flush()
                counts["gone" if noticed is None else "noticed" if noticed else "survived"] += 1
    print(f"{len(drawn)} mutants: {dict(counts)}; {args.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
