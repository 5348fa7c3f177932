"""Print the size of a checkout, per package: lines, syntax nodes, verbs, options, words, files of one run.

    python -m scripts.measures [CHECKOUT] [--static]

Lines and nodes are those of all Python files; nodes are counted by `ast.walk`, so that neither long lines nor
missing docstrings and blank lines save any. Options are those of `--help`, without --help and --version.
`--static` leaves out what needs the checkout to be imported: verbs, options and the files that
`submit heuristic` enters.
"""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Old checkouts have these packages beside datagen/, with links to them in it.
PRODUCT = ("datagen", "workers", "train", "schemas", "cluster")
WORDS = ("README.md", "docs/**/*.md")

_VERBS = """
import json
from datagen.cli import VERBS, build_app
def options(app):
    named = 0
    for name in app:
        if not name.startswith("-"):
            named += options(app[name])
    if app.default_command is not None:
        shown = app.assemble_argument_collection()
        named += sum(a.show and any(n.startswith("--") for n in a.names) for a in shown)
    return named
print(json.dumps({verb: options(build_app(verb)[verb]) for verb in VERBS}))
"""

# Modules and class bodies are entered by imports alone; only code of functions is CO_OPTIMIZED.
_WALK = """
import inspect, json, sys, threading
from pathlib import Path
root, out = sys.argv[1:]
entered = set()
def look(frame, event, _):
    if event == "call" and frame.f_code.co_flags & inspect.CO_OPTIMIZED:
        entered.add(frame.f_code.co_filename)
from datagen import cli
threading.setprofile(look)
sys.setprofile(look)
size = ["--n", "16", "--candidates-per-scene", "8", "--workers", "0"]
code = cli.run(["submit", "heuristic", *size, "--out", out])
sys.setprofile(None)
own = {Path(file).resolve() for file in entered if file.endswith(".py")}
own = {str(file.relative_to(root)) for file in own if file.is_relative_to(root)}
print(json.dumps(sorted(file for file in own if not file.startswith("."))))
sys.exit(code)
"""


def python_files(folder: Path) -> list[Path]:
    """The Python files below a folder; no link is followed."""
    return [] if folder.is_symlink() else sorted(p for p in folder.rglob("*.py") if p.is_file())


def package_of(file: Path, checkout: Path) -> str:
    """The package that a file of the product is counted under: datagen, or datagen.cluster and the like."""
    parts = file.relative_to(checkout).parts
    parts = parts if parts[0] == "datagen" else ("datagen", *parts)
    return ".".join(parts[:2]) if len(parts) > 2 else "datagen"


def lines_and_nodes(checkout: Path) -> tuple[Counter[str], Counter[str]]:
    """Lines and syntax nodes of each package of the product."""
    lines: Counter[str] = Counter()
    nodes: Counter[str] = Counter()
    for folder in PRODUCT:
        for file in python_files(checkout / folder):
            text = file.read_text("utf-8")
            package = package_of(file, checkout)
            lines[package] += text.count("\n")
            nodes[package] += sum(1 for _ in ast.walk(ast.parse(text)))
    return lines, nodes


def words(checkout: Path) -> int:
    """Words of the documents."""
    files = {file for pattern in WORDS for file in checkout.glob(pattern)}
    return sum(len(file.read_text("utf-8").split()) for file in files)


def asked(checkout: Path, program: str, *arguments: str) -> str:
    """The last line that a program prints, with the checkout's own `datagen`."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        cwd=checkout,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"error: {checkout}: {done.stderr.strip()[-500:]}")
    return done.stdout.strip().splitlines()[-1]


def main(arguments: list[str]) -> None:
    """Print the table."""
    static = "--static" in arguments
    checkout = Path(next((a for a in arguments if not a.startswith("-")), str(ROOT))).resolve()
    lines, nodes = lines_and_nodes(checkout)
    print(f"{'package':28} {'lines':>8} {'nodes':>9}")
    for package in sorted(lines):
        print(f"{package:28} {lines[package]:8,} {nodes[package]:9,}")
    print(f"{'product':28} {sum(lines.values()):8,} {sum(nodes.values()):9,}")
    tests = sum(file.read_text("utf-8").count("\n") for file in python_files(checkout / "tests"))
    print(f"{'tests':28} {tests:8,}")
    print(f"{'words of documents':28} {words(checkout):8,}")
    if static:
        return
    verbs = json.loads(asked(checkout, _VERBS))
    print(f"{'verbs':28} {len(verbs):8,}")
    print(f"{'options':28} {sum(verbs.values()):8,}")
    with tempfile.TemporaryDirectory() as folder:
        entered = json.loads(asked(checkout, _WALK, str(checkout), f"{folder}/run"))
    print(f"{'files of submit heuristic':28} {len(entered):8,}")
    if "--list" in arguments:
        print(json.dumps(verbs), *entered, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
