"""A sealed store as JavaScript reads it: zarrita on Node.js, fetched from npm."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import zarr

PACKAGES = ("zarrita@0.7.5", "@zarrita/storage@0.2.0")
READ = """
import { readdirSync } from "node:fs";
import FileSystemStore from "@zarrita/storage/fs";
import * as zarr from "zarrita";
const folder = process.argv[2], found = {};
const root = zarr.root(new FileSystemStore(folder));
const plain = (value) => (typeof value === "bigint" || typeof value === "boolean" ? Number(value) : value);
for (const name of readdirSync(folder).filter((each) => each !== "zarr.json")) {
  try {
    const { data, shape } = await zarr.get(await zarr.open(root.resolve(name), { kind: "array" }));
    found[name] = { shape, values: Array.from(data, plain) };
  } catch (error) {
    found[name] = { error: String(error) };
  }
}
console.log(JSON.stringify(found));
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program that prints all arrays of the store that it is given."""
    if not (node := shutil.which("node")) or not (npm := shutil.which("npm")):
        pytest.skip("Node.js and npm are not installed")
    folder = tmp_path_factory.mktemp("zarrita")
    (folder / "package.json").write_text("{}")
    command = ["timeout", "120", npm, "install", "--silent", "--no-audit", "--no-fund", *PACKAGES]
    if subprocess.run(command, cwd=folder, check=False).returncode:
        pytest.skip("zarrita cannot be fetched from npm")
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    (folder / "version").write_text(version.strip().lstrip("v"))
    (folder / "read.mjs").write_text(READ)
    return folder / "read.mjs"


@pytest.mark.slow
def test_zarrita_reads_all_arrays_but_those_of_half_precision(program: Path, finished: Path) -> None:
    """As docs/guides/read-data.md says. Node.js has half-precision floats from version 24 on."""
    command = ["node", str(program), str(finished / "data.zarr")]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    arrays = dict(zarr.open_group(finished / "data.zarr", mode="r").arrays())
    assert found.keys() == arrays.keys() and len(arrays) > 40
    has_halves = int(program.with_name("version").read_text().partition(".")[0]) >= 24
    unread = {name for name, each in found.items() if "error" in each}
    assert unread == (set() if has_halves else {"points_m"})
    for name in arrays.keys() - unread:
        wanted = np.asarray(arrays[name][:])
        assert tuple(found[name]["shape"]) == wanted.shape
        if wanted.dtype.kind == "f":  # JSON has null for NaN
            values = np.array(found[name]["values"], np.float64).astype(wanted.dtype)
            np.testing.assert_array_equal(values, wanted.ravel(), err_msg=name)
        else:
            assert found[name]["values"] == wanted.ravel().tolist(), name
