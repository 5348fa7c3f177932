r"""CPU seconds of a prediction: imports, loading, and each frame with a model that is kept.

    OMP_NUM_THREADS=1 python -m benchmarks.prediction_latency FRAME [--camera-height H] \
        [--checkpoint CKPT] [--click U,V]

FRAME is a folder of benchmarks.write_frames.
Without a checkpoint the released model is used. The first frame is listed separately; the others by their
median. Each frame has another reach, since scores of the same question are kept.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path


def main() -> None:
    """Predict the frame several times and print what each part costs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("frame", type=Path)
    parser.add_argument("--camera-height", type=float)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--click", type=lambda text: tuple(int(part) for part in text.split(",")))
    parser.add_argument("--footprint", default="0.25")
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    started_s = time.process_time()
    import numpy as np

    from datagen.train.prediction import RobotSize, load_scorer, predict, read_footprint, read_place

    imported_s = time.process_time()
    scorer = load_scorer(options.checkpoint)
    loaded_s = time.process_time()
    print(f"imports {imported_s - started_s:.2f} s, model {loaded_s - imported_s:.2f} s of CPU")
    footprint = read_footprint(options.footprint)
    parts: list[tuple[float, float]] = []
    for k in range(options.repeats + 1):
        robot = RobotSize(1.2, 0.7, 0.9 + 1e-4 * k, footprint)
        begun_s = time.process_time()
        frame = read_place(options.frame)
        if options.click and frame.image is not None:
            frame = replace(frame, image=replace(frame.image, mask=None), on_target=None)
        read_s = time.process_time()
        predict(scorer, [frame], robot, camera_height_m=options.camera_height, click=options.click)
        parts.append((read_s - begun_s, time.process_time() - read_s))
    read, predicted = np.median(parts[1:], axis=0)
    print(f"first frame {sum(parts[0]):.2f} s")
    print(f"later frames {read + predicted:.3f} s, {read:.3f} s of them to read")


if __name__ == "__main__":
    main()
