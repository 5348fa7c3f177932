"""What a block changes of the environment is put back as it was, set or not."""

from __future__ import annotations

import os

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datagen.cluster.ray_settings import changed_environment

NAMES = [f"DATAGEN_TEST_{k}" for k in range(4)]
environments = st.dictionaries(st.sampled_from(NAMES), st.sampled_from(["", "1", "two"]))
changes = st.dictionaries(st.sampled_from(NAMES), st.sampled_from([None, "", "1", "other"]))


@given(environments, changes, st.booleans())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_block_sees_its_own_values_and_leaves_those_that_were(
    monkeypatch: pytest.MonkeyPatch, before: dict[str, str], changed: dict[str, str | None], fails: bool
) -> None:
    with monkeypatch.context() as patch:
        for name in NAMES:
            patch.delenv(name, raising=False)
        for name, value in before.items():
            patch.setenv(name, value)
        held = dict(os.environ)
        try:
            with changed_environment(changed):
                seen = {name: os.environ.get(name) for name in NAMES}
                if fails:
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            assert fails
        assert seen == {name: {**before, **changed}.get(name) for name in NAMES}
        assert dict(os.environ) == held
