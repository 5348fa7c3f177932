"""Tests of plan and sim labels where the extra `sim` is installed; elsewhere a skip that says so."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from datagen.workers.registry import SIM_MODULES

SIM_INSTALLED = all(find_spec(name) is not None for name in (*SIM_MODULES, "sapien"))
needs_sim = pytest.mark.skipif(not SIM_INSTALLED, reason="the extra `sim` is not installed")
