"""What `open_robot` refuses, what it keeps, and that it is the same robot in every process."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen.schemas.errors import InputError
from datagen.workers.robots import open_robot, robot_limits


@pytest.mark.parametrize(
    ("name", "reach_m", "height_m", "said"),
    [
        ("panda-scald", 0.7, 0.8, "panda-scaled"),
        ("panda-scaled", 0.29, 0.8, "from 0.3 to 1.0 m"),
        ("panda-scaled", 1.01, 0.8, "from 0.3 to 1.0 m"),
        ("panda-scaled", math.nan, 0.8, "from 0.3 to 1.0 m"),
        ("panda-scaled", None, 0.8, "from 0.3 to 1.0 m"),
        ("panda", 0.8, 0.8, "reach of 0.947 m"),
        ("panda", None, -0.1, "at least 0.0 m"),
        ("panda", None, math.nan, "at least 0.0 m"),
        ("fetch", None, 0.5, "base height of 0.726 m"),
        ("fetch", 1.0, 0.726, "reach of 1.258 m"),
    ],
)
def test_wrong_arguments_name_the_option_and_the_range(
    name: str, reach_m: float | None, height_m: float, said: str
) -> None:
    with pytest.raises(InputError) as refused:
        open_robot(name, reach_m, height_m)
    assert refused.value.place == "--robot" and said in str(refused.value)


@pytest.mark.parametrize("module", ["numba", "mani_skill"])
def test_a_missing_library_is_named_with_the_extra_that_brings_it(module: str) -> None:
    hide = f"import sys; sys.modules['{module}'] = None"
    ask = "from datagen.workers.robots import open_robot, robot_limits; robot_limits('panda')"
    code = f"{hide}\n{ask}\nopen_robot('panda', None, 0.8)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "InputError: " in done.stderr and "pip install" in done.stderr
    assert "--robot" in done.stderr or "panda.toml: urdf" in done.stderr


def test_limits_are_those_that_open_also_rounded_to_float32() -> None:
    for name in ("panda", "xarm7", "fetch"):
        limits = robot_limits(name)
        for height_m in limits.base_height_m or (0.0, 1.5):
            assert open_robot(name, limits.reach_m[0], height_m).base_height_m == height_m
            stored = open_robot(name, None, float(np.float32(height_m)))
            assert stored.base_height_m == pytest.approx(height_m, abs=1e-6)
    for reach_m in robot_limits("panda-scaled").reach_m:
        assert open_robot("panda-scaled", reach_m, 0.8).reach_m == reach_m


def test_pedestals_share_an_arm_and_the_pandas_share_a_hand_with_the_xarm() -> None:
    low, high = open_robot("panda-scaled", 0.7, 0.5), open_robot("panda-scaled", 0.7, 0.9)
    assert (low.base_height_m, high.base_height_m) == (0.5, 0.9)
    assert open_robot("panda-scaled", 0.7, 0.9) is high
    assert low.assembly is high.assembly and low.link_parts_m is high.link_parts_m
    own = open_robot("fetch", None, 0.726)
    family = (("panda", None), ("panda-scaled", 0.3), ("panda-scaled", 1.0), ("xarm7", None))
    shared = {open_robot(name, reach_m, 0.8).gripper.digest for name, reach_m in family}
    assert len(shared) == 1 and own.gripper.digest not in shared


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
    printed = []
    for order in ("1", "2"):
        command, env = [sys.executable, "-c", PRINT_DIGEST, order], os.environ | {"OMP_NUM_THREADS": order}
        printed.append(subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout)
    assert printed[0] == printed[1] and "panda-scaled 0.4" in printed[0]
