"""Downloads, the cache and the lock, against a server that breaks connections and lies."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datagen import cli
from datagen.assets.catalogue import CATALOGUE, CatalogueEntry, select
from datagen.assets.fetch import LOCK_NAME, download, fetch, read_lock
from datagen.schemas.errors import InputError
from datagen.workers.source_statement import read_statement
from tests.datagen.assets.flaky_server import Site, serve

BODY = np.random.default_rng(0).bytes(700_000)
DIGEST = hashlib.sha256(BODY).hexdigest()


@pytest.fixture
def site() -> Iterator[Site]:
    with serve() as running:
        running.files["/a.bin"] = BODY
        yield running


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Pauses between tries, which take no time here."""
    noted: list[float] = []
    monkeypatch.setattr("datagen.assets.fetch.time.sleep", noted.append)
    return noted


def _get(site: Site, target: Path, *, sha256: str | None = DIGEST, size: int | None = None) -> str:
    return download(f"{site.url}/a.bin", target, sha256=sha256, size=size, progress=lambda here, total: None)


def test_broken_connections_are_continued_not_repeated(
    site: Site, tmp_path: Path, pauses: list[float]
) -> None:
    site.cut_after = [100_000, 200_000, 50_000]
    assert _get(site, tmp_path / "a", sha256=None) == DIGEST
    assert (tmp_path / "a").read_bytes() == BODY and len(pauses) == 3
    assert [r[1] for r in site.requests] == [None, "bytes=100000-", "bytes=300000-", "bytes=350000-"]
    assert all(r[2] for r in site.requests[1:]), "a continued download must name the content it continues"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]


def test_a_later_run_continues_a_half_and_finds_that_one_is_spoilt(
    site: Site, tmp_path: Path, pauses: list[float]
) -> None:
    part = tmp_path / "a.part"
    for spoilt in (False, True):
        site.cut_after, site.statuses = [100_000], []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("datagen.assets.fetch.time.sleep", lambda seconds: site.statuses.append(503))
            with pytest.raises(InputError, match="gave up"):
                _get(site, tmp_path / "a")
        assert not (tmp_path / "a").exists() and part.stat().st_size == 100_000
        site.statuses.clear()
        if spoilt:
            part.write_bytes(bytes(100_000))
            with pytest.raises(InputError, match="not the expected file"):
                _get(site, tmp_path / "a")
        else:
            assert _get(site, tmp_path / "a") == DIGEST
            (tmp_path / "a").unlink()
        assert site.requests[-1][1] == "bytes=100000-"
    assert _get(site, tmp_path / "a") == DIGEST and site.requests[-1][1] is None


def test_without_an_etag_nothing_is_continued(site: Site, tmp_path: Path, pauses: list[float]) -> None:
    site.etag = False
    site.cut_after = [100_000]
    assert _get(site, tmp_path / "a", sha256=None) == DIGEST
    assert [r[1] for r in site.requests] == [None, None]


def test_changed_content_is_not_glued_to_the_old_half(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.cut_after = [100_000]
    changed = {"/a.bin": BODY[::-1]}
    monkeypatch.setattr("datagen.assets.fetch.time.sleep", lambda seconds: site.files.update(changed))
    assert _get(site, tmp_path / "a", sha256=None) == hashlib.sha256(BODY[::-1]).hexdigest()


def test_passing_errors_are_tried_again_with_growing_pauses(
    site: Site, tmp_path: Path, pauses: list[float]
) -> None:
    site.statuses = [503, 500, 429]
    _get(site, tmp_path / "a")
    assert pauses == [1.0, 2.0, 4.0]


@pytest.mark.parametrize("options", [{"sha256": "0" * 64}, {"size": len(BODY) + 1}], ids=str)
def test_what_is_wrong_is_refused_and_leaves_nothing(
    site: Site, tmp_path: Path, options: dict[str, Any]
) -> None:
    with pytest.raises(InputError) as caught:
        _get(site, tmp_path / "a", **options)
    assert site.url in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_no_file_and_redirects_out_of_http_are_refused(site: Site, tmp_path: Path) -> None:
    site.files.clear()
    with pytest.raises(InputError, match=site.url):
        _get(site, tmp_path / "a")
    site.redirect_to = "file:///etc/hostname"
    with pytest.raises(InputError, match=r"(?i)redirect"):
        _get(site, tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("url", ["file:///etc/hostname", "ftp://127.0.0.1/a", "a.bin"])
def test_only_http_addresses(url: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="address"):
        download(url, tmp_path / "a", sha256=None, size=None, progress=lambda here, total: None)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cuts=st.lists(st.integers(0, 60_000), max_size=5), ranges=st.booleans(), etag=st.booleans())
def test_whatever_breaks_the_bytes_are_right(
    tmp_path_factory: pytest.TempPathFactory, pauses: list[float], cuts: list[int], ranges: bool, etag: bool
) -> None:
    with serve() as site:
        site.files["/a.bin"], site.cut_after, site.ranges, site.etag = BODY[:60_000], cuts, ranges, etag
        target = tmp_path_factory.mktemp("d") / "a"
        _get(site, target, sha256=None)
        assert target.read_bytes() == BODY[:60_000]


def _zip(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as packed:
        for name, data in files.items():
            packed.writestr(name, data)
    return out.getvalue()


def _asset(**changes: object) -> CatalogueEntry:
    values: dict[str, object] = {"name": "toy", "file": "toy.zip", "url": "http://127.0.0.1:9/toy.zip"}
    values |= {"licence": "CC0-1.0", "into": "toy", "about": "a toy"}
    return CatalogueEntry(**(values | changes))  # type: ignore[arg-type]


def test_first_use_is_recorded_and_then_held_to(site: Site, tmp_path: Path) -> None:
    site.files["/toy.zip"] = _zip({"a/b.txt": b"hello", "c.txt": b"there"})
    done = fetch(_asset(), tmp_path / "out", cache=tmp_path / "c1", mirror=site.url)
    assert (done.trust, done.files, done.from_cache) == ("first-use", 2, False)
    assert (tmp_path / "out/toy/a/b.txt").read_bytes() == b"hello"
    (entry,) = read_lock(tmp_path / "out").downloads
    assert (entry.name, entry.licence, entry.sha256) == ("toy", "CC0-1.0", done.sha256)

    site.files["/toy.zip"] = _zip({"a/b.txt": b"changed"})
    with pytest.raises(InputError, match="not the expected file"):
        fetch(_asset(), tmp_path / "out", cache=tmp_path / "c2", mirror=site.url)
    assert (tmp_path / "out/toy/a/b.txt").read_bytes() == b"hello"


def test_the_folder_states_its_licence_and_keeps_a_statement_of_its_own(site: Site, tmp_path: Path) -> None:
    site.files["/toy.zip"] = _zip({"set/a.txt": b"hello"})
    asset = _asset(title="Toys", attribution="A. Maker", holds="toy/set")
    fetch(asset, tmp_path / "out", cache=tmp_path / "c", mirror=site.url)
    stated = {"title": "Toys", "licence": "CC0-1.0", "attribution": "A. Maker"}
    assert read_statement(tmp_path / "out/toy/set") == stated
    (tmp_path / "out/toy/set/source.json").write_text('{"title": "Mine"}')
    fetch(asset, tmp_path / "out", cache=tmp_path / "c", mirror=site.url)
    assert read_statement(tmp_path / "out/toy/set") == {"title": "Mine"}
    fetch(_asset(), tmp_path / "plain", cache=tmp_path / "c", mirror=site.url)
    assert read_statement(tmp_path / "plain/toy/set") == {}


def test_a_spoilt_cache_is_fetched_again_and_a_kept_download_used_again(site: Site, tmp_path: Path) -> None:
    body = site.files["/toy.zip"] = _zip({"a.txt": b"hello"})
    asset = _asset(sha256=hashlib.sha256(body).hexdigest(), size=len(body))
    (tmp_path / "c").mkdir()
    (tmp_path / "c/toy.zip").write_bytes(b"spoilt")
    done = fetch(asset, tmp_path / "out", cache=tmp_path / "c", mirror=site.url)
    assert (done.trust, done.from_cache) == ("published", False)
    assert (tmp_path / "c/toy.zip").read_bytes() == body
    assert fetch(asset, tmp_path / "other", cache=tmp_path / "c").from_cache  # without the mirror


def test_a_page_in_place_of_an_archive_is_not_kept(site: Site, tmp_path: Path) -> None:
    site.files["/toy.zip"] = b"<html>Log in to use this network</html>"
    with pytest.raises(InputError, match="cannot be unpacked, and is removed"):
        fetch(_asset(), tmp_path / "out", cache=tmp_path / "c", mirror=site.url)
    site.files["/toy.zip"] = _zip({"a.txt": b"hello"})
    assert fetch(_asset(), tmp_path / "out", cache=tmp_path / "c", mirror=site.url).files == 1


def test_the_catalogue_is_whole() -> None:
    assert len({asset.file for asset in CATALOGUE.values()}) == len(CATALOGUE)
    for asset in CATALOGUE.values():
        assert asset.url.startswith("https://")
        assert asset.licence and asset.about
        assert asset.sha256 is None or len(bytes.fromhex(asset.sha256)) == 32
        assert asset.size is None or asset.size > 0
    chosen = [asset.name for asset in select(["procthor-10k/val", "procthor-10k", "ycb"])]
    assert chosen[0] == "ycb" and len(chosen) == len(set(chosen)) == 5
    assert len(select(["ycb-scans"])) > 60
    with pytest.raises(InputError, match="is not an asset"):
        select(["yc"])


@pytest.mark.parametrize(
    "text",
    [
        "{",
        json.dumps({"version": 2}),
        json.dumps({"version": 1, "surprise": 1}),
        json.dumps({"version": 1, "downloads": [{"name": "a", "sha256": "0", "size": 1}]}),
    ],
)
def test_broken_locks_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / LOCK_NAME).write_text(text)
    with pytest.raises(InputError) as caught:
        fetch(_asset(), tmp_path, cache=tmp_path / "c")
    assert LOCK_NAME in str(caught.value) and "\n" not in str(caught.value)


def test_the_command_line(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                          capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "cache"))
    asset = CATALOGUE["procthor-10k/asset-sizes"]
    site.files[f"/{asset.file}"] = b"{}"
    arguments = ["--out", str(tmp_path / "out"), "--mirror", site.url]
    assert cli.run(["assets", "fetch", asset.name, *arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["fetched"][0]["trust"] == "first-use"
    assert (tmp_path / "out/procthor/asset-database.json").read_bytes() == b"{}"
    assert cli.run(["assets", "list"]) == 0
    assert "procthor-10k/train" in capsys.readouterr().out
    for wrong in (["fetch"], ["fetch", "nothing"]):
        capsys.readouterr()
        assert cli.run(["assets", *wrong]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
