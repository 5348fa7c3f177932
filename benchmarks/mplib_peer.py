"""Rates of mplib over given poses; run by an interpreter with numpy 1 and mplib, not by this project's.

    PEER benchmarks/mplib_peer.py < QUESTION.json > ANSWER.json

mplib crashes with numpy 2, so it has an environment of its own. `benchmarks.robots`
runs it; it imports nothing from this project.
"""

import json
import os
import sys
import time

import mplib
import numpy as np


def main() -> None:
    """Read {urdf, srdf, move_group, seeds, start, poses: [[x y z qw qx qy qz]], plans}; print rates."""
    question = json.load(sys.stdin)
    # mplib prints to the standard output, where the answer belongs.
    answer_to = os.dup(1)
    os.dup2(2, 1)
    planner = mplib.Planner(urdf=question["urdf"], srdf=question["srdf"], move_group=question["move_group"])
    limits = np.ones(7)
    planner.joint_vel_limits = planner.joint_acc_limits = limits
    start = np.array(question["start"])
    poses = np.array(question["poses"])
    answer = {}
    for seeds in question["seeds"]:
        began, solved = time.process_time(), 0
        for pose in poses:
            status, _ = planner.IK(pose, start, n_init_qpos=seeds)
            solved += status == "Success"
        spent = time.process_time() - began
        answer[f"ik_{seeds}"] = {"calls_per_s": len(poses) / spent, "solved": solved / len(poses)}
    began, solved = time.process_time(), 0
    for pose in poses[: question["plans"]]:
        result = planner.plan_qpos_to_pose(pose, start, time_step=1 / 20)
        solved += result["status"] == "Success"
    spent = time.process_time() - began
    count = max(1, len(poses[: question["plans"]]))
    answer["plan"] = {"calls_per_s": count / spent, "solved": solved / count}
    with os.fdopen(answer_to, "w") as out:
        json.dump(answer, out)


if __name__ == "__main__":
    main()
