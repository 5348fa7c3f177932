"""Make everything that a release publishes, with digests: python -m scripts.release OUT (make release).

    OUT/dist      wheel and source archive, of the last commit
    OUT/benchmark the pack that comes with datagen
    OUT/model     the released model, its program without torch, and its card
    OUT/labels    180,000 heuristic and 20,000 plan labels as folders for the Hugging Face Hub
    OUT/SHA256SUMS, OUT/UPLOAD.md

The same commit, assets and versions of libraries give the same bytes. An interrupted release continues.
Labels are of the houses and objects in DATAGEN_ASSETS, or of the built-in ones. NUMBER=HEURISTIC,PLAN makes
fewer.
"""

from __future__ import annotations

import gzip
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from hashlib import sha256
from pathlib import Path

from datagen import cli

ROOT = Path(__file__).resolve().parent.parent
_LABELS = {
    "heuristic": (180_000, ()),
    "plan": (20_000, ("--candidates", "in-range", "--candidates-per-scene", "20")),
}
_UPLOAD = """# How to publish this release

Check the files first: `sha256sum --check SHA256SUMS`. Each part states its licences: `labels/*/README.md`,
`benchmark/ATTRIBUTION.md`, `model/MODEL_CARD.md`; the code is Apache-2.0.

    twine upload dist/*                                                        # package index
    hf upload OWNER/datagen-heuristic labels/heuristic . --repo-type dataset   # Hugging Face
    hf upload OWNER/datagen-plan labels/plan . --repo-type dataset
    hf upload OWNER/datagen-released model .

The page of the release gets `benchmark` and `SHA256SUMS`.
"""


def make_release(out: Path, numbers: dict[str, int]) -> None:
    """Make all parts below `out`; `numbers` are of labels by source."""
    out.mkdir(parents=True, exist_ok=True)
    _distributions(out / "dist")
    shutil.copytree(ROOT / "datagen/evaluation/pack", out / "benchmark", dirs_exist_ok=True)
    shutil.copytree(
        ROOT / "datagen/released",
        out / "model",
        ignore=shutil.ignore_patterns("*.py", "__pycache__"),
        dirs_exist_ok=True,
    )
    for source, n in numbers.items():
        _labels(out, source, n)
    (out / "UPLOAD.md").write_text(_UPLOAD, "utf-8")
    files = sorted(
        p for p in out.rglob("*") if p.is_file() and "runs" not in p.parts and p.name != "SHA256SUMS"
    )
    sums = [f"{sha256(path.read_bytes()).hexdigest()}  {path.relative_to(out)}\n" for path in files]
    (out / "SHA256SUMS").write_text("".join(sums), "utf-8")


def _labels(out: Path, source: str, n: int) -> None:
    run, more = out / "runs" / source, list(_LABELS[source][1])
    if assets := os.environ.get("DATAGEN_ASSETS"):
        more += ["--houses", f"procthor:{assets}/procthor", "--objects", f"ycb:{assets}/ycb"]
    _run("submit", source, "--n", str(n), "--seed", "1", *more, "--out", str(run))
    _run("export", str(run), "--to", "huggingface", "--out", str(out / "labels" / source))


def _run(*words: str) -> None:
    if code := cli.run(list(words)):
        raise SystemExit(code)


def _distributions(out: Path) -> None:
    """Wheel and source archive of the last commit, without times and users of this machine."""
    epoch = subprocess.check_output(["git", "log", "-1", "--format=%ct"], cwd=ROOT, text=True).strip()
    out.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.check_output(["git", "archive", "HEAD"], cwd=ROOT)
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            files.extractall(folder, filter="data")
        build = "import setuptools.build_meta as b, sys; o = sys.argv[1]; b.build_wheel(o); b.build_sdist(o)"
        environment = {**os.environ, "SOURCE_DATE_EPOCH": epoch, "PYTHONHASHSEED": "0"}
        subprocess.run(
            [sys.executable, "-c", build, str(out.resolve())], cwd=folder, env=environment, check=True,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip
    for path in out.glob("*.tar.gz"):
        _normalise(path, int(epoch))


def _normalise(path: Path, epoch_s: int) -> None:
    """Write a source archive again: members by name, one time, no user."""
    with tarfile.open(path) as old:
        members = sorted(old.getmembers(), key=lambda member: member.name)
        data = io.BytesIO()
        with tarfile.open(fileobj=data, mode="w", format=tarfile.PAX_FORMAT) as new:
            for member in members:
                member.mtime, member.uid, member.gid, member.uname, member.gname = epoch_s, 0, 0, "", ""
                member.pax_headers = {}
                new.addfile(member, old.extractfile(member) if member.isfile() else None)
    path.write_bytes(gzip.compress(data.getvalue(), mtime=0))


if __name__ == "__main__":
    given = os.environ.get("NUMBER", "").split(",") if os.environ.get("NUMBER") else []
    wanted = {source: n for source, (n, _) in _LABELS.items()}
    make_release(Path(sys.argv[1]), wanted | dict(zip(_LABELS, map(int, given), strict=False)))
