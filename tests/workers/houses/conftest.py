"""Every test unpacks into a cache of its own."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True, scope="session")
def house_cache(tmp_path_factory: pytest.TempPathFactory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DATAGEN_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
