"""Downloads, the cache and the lock, against a server that breaks connections and lies."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen import cli
from datagen.assets.catalogue import CATALOGUE, CatalogueEntry, select
from datagen.assets.download import DownloadPolicy, download
from datagen.assets.fetch import LOCK_NAME, fetch, read_lock
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


def _get(
    site: Site, target: Path, *, sha256: str | None = DIGEST, size: int | None = None, tries: int = 4,
    max_bytes: int = 10**6, pause: Callable[[float], None] = lambda seconds: None, **policy: float,
) -> str:  # fmt: skip
    return download(
        f"{site.url}/a.bin", target, sha256=sha256, size=size, max_bytes=max_bytes,
        progress=lambda here, total: None,
        policy=DownloadPolicy(tries=tries, pause=pause, timeout_s=5, **policy),
    )  # fmt: skip


def test_broken_connections_are_continued_not_repeated(site: Site, tmp_path: Path) -> None:
    site.cut_after = [100_000, 200_000, 50_000]
    assert _get(site, tmp_path / "a", sha256=None) == DIGEST
    assert (tmp_path / "a").read_bytes() == BODY
    assert [r[1] for r in site.requests] == [None, "bytes=100000-", "bytes=300000-", "bytes=350000-"]
    assert all(r[2] for r in site.requests[1:]), "a continued download must name the content it continues"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]


@pytest.mark.parametrize("spoilt", [False, True])
def test_a_later_run_continues_a_half_or_finds_that_it_is_spoilt(
    spoilt: bool, site: Site, tmp_path: Path
) -> None:
    site.cut_after = [100_000]
    with pytest.raises(InputError, match="gave up"):
        _get(site, tmp_path / "a", tries=2, pause=lambda seconds: site.statuses.append(503))
    assert not (tmp_path / "a").exists()
    if spoilt:
        (tmp_path / "a.part").write_bytes(bytes(100_000))
    site.statuses.clear()
    assert _get(site, tmp_path / "a") == DIGEST
    assert (tmp_path / "a").read_bytes() == BODY
    assert spoilt or site.requests[-1][1] == "bytes=100000-"


def test_without_validator_or_digest_nothing_is_continued(site: Site, tmp_path: Path) -> None:
    site.etag = False
    site.cut_after = [100_000]
    assert _get(site, tmp_path / "a", sha256=None) == DIGEST
    assert [r[1] for r in site.requests] == [None, None]


def test_changed_content_is_not_glued_to_the_old_half(site: Site, tmp_path: Path) -> None:
    site.cut_after = [100_000]
    changed = {"/a.bin": BODY[::-1]}
    digest = _get(site, tmp_path / "a", sha256=None, pause=lambda seconds: site.files.update(changed))
    assert digest == hashlib.sha256(BODY[::-1]).hexdigest()


def test_passing_errors_are_tried_again_with_growing_pauses(site: Site, tmp_path: Path) -> None:
    site.statuses = [503, 500, 429]
    pauses: list[float] = []
    _get(site, tmp_path / "a", tries=6, pause=pauses.append, first_pause_s=1.0, longest_pause_s=5.0)
    assert pauses == [2.0, 4.0, 5.0]


@pytest.mark.parametrize(
    ("options", "hide_length"),
    [
        ({"sha256": "0" * 64}, False),
        ({"size": len(BODY) + 1}, False),
        ({"max_bytes": 1000}, False),
        ({"max_bytes": 1000}, True),
    ],
    ids=str,
)
def test_what_is_wrong_is_refused_and_leaves_nothing(
    site: Site, tmp_path: Path, options: dict[str, Any], hide_length: bool
) -> None:
    site.hide_length = hide_length
    with pytest.raises(InputError) as caught:
        _get(site, tmp_path / "a", **options)
    assert site.url in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ranges", [False, True])
def test_a_file_shorter_than_stated_is_given_up(site: Site, tmp_path: Path, ranges: bool) -> None:
    """The server does not tell its length, so each end of it may be a broken connection."""
    site.hide_length, site.ranges = True, ranges
    with pytest.raises(InputError, match="gave up after 4 tries"):
        _get(site, tmp_path / "a", size=len(BODY) + 1)
    assert not (tmp_path / "a").exists() and len(site.requests) < 10


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
        download(url, tmp_path / "a", sha256=None, size=None, max_bytes=9, progress=lambda here, total: None)


@settings(max_examples=25, deadline=None)
@given(cuts=st.lists(st.integers(0, 60_000), max_size=8), ranges=st.booleans(), etag=st.booleans())
def test_whatever_breaks_the_bytes_are_right(
    tmp_path_factory: pytest.TempPathFactory, cuts: list[int], ranges: bool, etag: bool
) -> None:
    with serve() as site:
        site.files["/a.bin"], site.cut_after, site.ranges, site.etag = BODY[:60_000], cuts, ranges, etag
        target = tmp_path_factory.mktemp("d") / "a"
        _get(site, target, sha256=None, tries=20)
        assert target.read_bytes() == BODY[:60_000]


def _zip(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as packed:
        for name, data in files.items():
            packed.writestr(name, data)
    return out.getvalue()


def _asset(**changes: object) -> CatalogueEntry:
    values: dict[str, object] = {"name": "toy", "file": "toy.zip", "url": "http://127.0.0.1:9/toy.zip"}
    values |= {"licence": "CC0-1.0", "into": "toy", "about": "a toy", "archive": True}
    return CatalogueEntry(**(values | changes))  # type: ignore[arg-type]


def test_first_use_is_recorded_and_then_held_to(site: Site, tmp_path: Path) -> None:
    site.files["/toy.zip"] = _zip({"a/b.txt": b"hello", "c.txt": b"there"})
    quick = DownloadPolicy(pause=lambda seconds: None)
    done = fetch(_asset(), tmp_path / "out", cache=tmp_path / "c1", mirror=site.url, policy=quick)
    assert (done.trust, done.files, done.from_cache) == ("first-use", 2, False)
    assert (tmp_path / "out/toy/a/b.txt").read_bytes() == b"hello"
    (entry,) = read_lock(tmp_path / "out").downloads
    assert (entry.name, entry.licence, entry.sha256) == ("toy", "CC0-1.0", done.sha256)

    site.files["/toy.zip"] = _zip({"a/b.txt": b"changed"})
    with pytest.raises(InputError, match="not the expected file"):
        fetch(_asset(), tmp_path / "out", cache=tmp_path / "c2", mirror=site.url, policy=quick)
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


def test_the_catalogue_is_whole() -> None:
    assert len({asset.file for asset in CATALOGUE.values()}) == len(CATALOGUE)
    for asset in CATALOGUE.values():
        assert asset.url.startswith("https://")
        assert asset.licence and asset.about
        assert asset.sha256 is None or len(bytes.fromhex(asset.sha256)) == 32
        assert asset.size is None or 0 < asset.size <= asset.max_bytes
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
