"""Rates of mplib's paths among points; run by an interpreter with numpy 1 and mplib, not by this project's.

    PEER benchmarks/mplib_scene_peer.py < QUESTION.json > ANSWER.json

`benchmarks.planning` runs it; it imports nothing from this project.
"""

import json
import os
import sys
import time

import mplib
import numpy as np


def main() -> None:
    """Read {urdf, srdf, move_group, resolution_m, problems: [{start, pose, points}]}; print rates."""
    question = json.load(sys.stdin)
    # mplib prints to the standard output, where the answer belongs.
    answer_to = os.dup(1)
    os.dup2(2, 1)
    planner = mplib.Planner(urdf=question["urdf"], srdf=question["srdf"], move_group=question["move_group"])
    planner.joint_vel_limits = planner.joint_acc_limits = np.ones(7)
    points_s = plan_s = 0.0
    solved = 0
    for problem in question["problems"]:
        began = time.process_time()
        planner.update_point_cloud(np.array(problem["points"]), question["resolution_m"])
        seen = time.process_time()
        result = planner.plan_qpos_to_pose(
            np.array(problem["pose"]), np.array(problem["start"]), time_step=1 / 20, use_point_cloud=True
        )
        points_s += seen - began
        plan_s += time.process_time() - seen
        solved += result["status"] == "Success"
    count = len(question["problems"])
    answer = {"plans_per_s": count / plan_s, "solved": solved / count, "points_s": points_s / count}
    with os.fdopen(answer_to, "w") as out:
        json.dump(answer, out)


if __name__ == "__main__":
    main()
