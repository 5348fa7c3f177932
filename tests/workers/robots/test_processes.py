"""The same robot in every process."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

PRINT_DIGEST = """
import hashlib, sys
import numpy as np
from datagen.workers.robots import open_robot
order = [("panda-scaled", 0.4), ("panda", None), ("panda-scaled", 0.7), ("xarm7", None)]
digests = {}
for name, reach in order if sys.argv[1] == "1" else order[::-1]:
    robot, bits = open_robot(name, reach, 0.8), hashlib.sha256()
    low, high = robot.q_lower_rad, robot.q_upper_rad
    for q in np.random.default_rng(0).uniform(low, high, (20, len(low))):
        tcp = robot.T_base_tcp(q)
        found = robot.ik(tcp, (low + high) / 2)
        bits.update(robot.T_base_link(q).tobytes() + tcp.tobytes())
        bits.update(b"none" if found is None else found.tobytes())
        bits.update(bytes([robot.collides_itself(q)]))
    bits.update(repr((robot.self_pairs, robot.gripper.digest)).encode())
    for part in (part for parts in robot.link_parts_m for part in parts):
        bits.update(part.tobytes())
    digests[f"{name} {reach}"] = bits.hexdigest()
print(sorted(digests.items()))
"""


def test_processes_agree_to_the_bit() -> None:
    started = [
        subprocess.Popen(
            [sys.executable, "-c", PRINT_DIGEST, order],
            env=os.environ | {"OMP_NUM_THREADS": order},
            stdout=subprocess.PIPE,
            text=True,
        )
        for order in ("1", "2")
    ]
    printed = [process.communicate(timeout=600)[0] for process in started]
    assert [process.returncode for process in started] == [0, 0]
    assert printed[0] == printed[1] and "panda-scaled 0.4" in printed[0]
