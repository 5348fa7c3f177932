"""Make labelled base poses, and see which objects can be reached from where.

Usage: python examples/make_labels.py [FOLDER]

Makes two small runs in built-in houses, FOLDER/train and FOLDER/val. For real houses and objects, fetch them
with `datagen assets fetch procthor-10k ycb`, and give houses="procthor:DIR" and objects="ycb:DIR".
"""

import sys
from pathlib import Path

import datagen


def main(folder: Path) -> None:
    # Houses of the two splits are disjoint, so that a model is judged in houses that it never saw.
    for split, n in (("train", 240), ("val", 120)):
        result = datagen.submit("heuristic", n=n, out=folder / split, split=split, seed=0)
        print(f"{result.path}: {result.labels} new labels, {result.end}")

    table = datagen.candidates(folder / "train", folder / "val")
    by_object = table.groupby("object", observed=True)["label"].agg(["count", "mean"])
    print(by_object.rename(columns={"count": "candidates", "mean": "share good"}).round(2))

    near = table[table["distance_m"] < 0.7]
    print(f"good within 0.7 m of the target: {near['label'].mean():.0%}, of all: {table['label'].mean():.0%}")

    # Point clouds, poses and everything else that is stored, read when used.
    dataset = datagen.open_dataset(folder / "train")
    print(f"{dataset.attrs['title']}; {dataset.sizes['scene']} clouds of {dataset.sizes['point']} points")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-runs"))
