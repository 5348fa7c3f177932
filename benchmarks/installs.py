"""Size and time of an installation with each extra, in fresh environments, as a table for docs.

    python -m benchmarks.installs [--keep FOLDER] [EXTRA ...]

`base` is the package without extras. Sizes are of site-packages without pip. pip is timed once, with what its
cache holds; the other times are the best of three calls. Only the standard library is used.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXTRAS = ("base", "labels", "cluster", "sim", "train", "all")
IMPORT = "import datagen"


def megabytes(folder: Path) -> float:
    """Size of the files below a folder, each counted once, without pip."""
    seen: dict[int, int] = {}
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink() and path.relative_to(folder).parts[0][:3] != "pip":
            found = path.stat()
            seen[found.st_ino] = found.st_blocks * 512
    return sum(seen.values()) / 1e6


def seconds(*command: str | Path) -> float:
    """The shortest of three runs."""
    times: list[float] = []
    for _ in range(3):
        started = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd="/")
        times.append(time.perf_counter() - started)
    return min(times)


def measure(extra: str, folder: Path) -> str:
    """A row of the table: the extra installed into a fresh environment in the folder."""
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    source = str(ROOT) if extra == "base" else f"{ROOT}[{extra}]"
    command = [python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", source]
    started = time.perf_counter()
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    took = time.perf_counter() - started
    (packages,) = folder.glob("lib/python*/site-packages")
    count = sum(1 for _ in packages.glob("*.dist-info")) - 1
    importing = max(0.0, seconds(python, "-c", IMPORT) - seconds(python, "-c", ""))
    helping = seconds(folder / "bin" / "datagen", "--help")
    sizes = f"{count} | {megabytes(packages):,.0f} MB"
    return f"| `{extra}` | {sizes} | {took:.0f} s | {importing:.2f} s | {helping:.2f} s |"


def main() -> None:
    """Print the table, a row as soon as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("extras", nargs="*", default=EXTRAS, metavar="EXTRA")
    parser.add_argument(
        "--keep", type=Path, help="folder for the environments, instead of one that is removed"
    )
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = chosen.keep or Path(scratch)
        print("| extra | packages | on disk | pip | `import datagen` | `datagen --help` |")
        print("| --- | ---: | ---: | ---: | ---: | ---: |")
        for extra in chosen.extras:
            print(measure(extra, folder / extra), flush=True)


if __name__ == "__main__":
    main()
