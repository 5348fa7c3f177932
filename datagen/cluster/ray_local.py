"""A minimal Ray node of this machine: only the two native processes that run tasks.

Ray normally also starts a dashboard, monitors and two agents in Python. They take seconds and 400 MB, the
raylet exits where an agent does not start within 15 s, and agents outlive a killed driver. A local job needs
none of them: no runtime environments, no Jobs API, no metrics.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError

_START_WITHIN_S = 300.0
_LOOK_S = 0.05
# Files in which the raylet expects the ports of its agents. Port 1 is never connected to.
_AGENT_PORTS = (
    "dashboard_agent_listen_port",
    "metrics_agent_port",
    "metrics_export_port",
    "runtime_env_agent_port",
)
# In place of an agent: it exits with the raylet, when its input ends.
_NO_AGENT = "/bin/cat"
START_FIX = (
    "Start it again when the machine is less busy; use --workers 0, which needs no Ray, or the --address of "
    "a running cluster"
)


@contextmanager
def slim_node() -> Generator[None]:
    """Make Ray start local clusters with only its two native processes, within the block.

    Inside it, `ray.init` raises InputError where the node does not start in five minutes.
    """
    from ray._private import node, services

    class SlimNode(node.Node):
        def start_head_processes(self) -> None:
            self.start_gcs_server()
            self._write_cluster_info_to_kv()

        def start_ray_processes(self) -> None:
            self._ray_params.update(include_log_monitor=False)
            for name in _AGENT_PORTS:
                Path(self._session_dir, f"{name}_{self._node_id}").write_text("1")
            start = services.start_ray_process
            services.start_ray_process = lambda command, *rest, **options: start(
                [_without_agent(word) for word in command], *rest, **options
            )
            try:
                super().start_ray_processes()
            finally:
                services.start_ray_process = start
            self._await_raylet()

        def _await_raylet(self) -> None:
            """Wait until the node is registered; Ray itself gives up after 30 s."""
            raylet: Any = self.all_processes["raylet"][0].process
            until_s = time.monotonic() + _START_WITHIN_S
            while True:
                try:
                    services.get_node(self.gcs_address, self._node_id)
                    return
                except RuntimeError:
                    if raylet.poll() is not None or time.monotonic() >= until_s:
                        break
                time.sleep(_LOOK_S)
            code = raylet.poll()
            why = f"not within {_START_WITHIN_S:g} s" if code is None else f"it ended with {code}"
            raise InputError("ray", "", f"does not start: {why}", START_FIX)

    before = node.Node
    node.Node = SlimNode
    try:
        yield
    finally:
        node.Node = before


def _without_agent(word: str) -> str:
    option, equals, _ = word.partition("=")
    return f"{option}={_NO_AGENT}" if equals and option.endswith("_agent_command") else word
