"""Make labels on a Ray cluster, resume what is missing, and merge the runs of several seeds.

Usage: python examples/run_a_cluster.py [FOLDER] [ADDRESS]

ADDRESS is that of a running Ray cluster, as HOST:6379; "local" starts Ray on this machine. FOLDER must be
one that all machines share, or an s3:// address. Ctrl-C, `datagen cancel` and a crash lose nothing that is
committed: the same command continues.
"""

import sys

import datagen


def main(folder: str, address: str = "local") -> None:
    runs = [f"{folder}/seed-{seed}" for seed in (0, 1)]
    for seed, run in enumerate(runs):
        result = datagen.submit("heuristic", n=120, out=run, seed=seed, address=address, workers=2)
        print(f"{run}: {result.end}, {result.labels} new labels, {result.retries} retries")

    for run in runs:
        # Makes what is missing; with `quarantined`, shards that kept failing are tried again.
        result = datagen.resume(run, quarantined=True, address=address, workers=2)
        print(f"{run}: {result.remaining} shards missing, {len(result.quarantined)} in quarantine")

    merged = datagen.merge(runs, out=f"{folder}/merged")
    print(f"{merged['out']}: {merged['labels']} labels")
    table = datagen.candidates(merged["out"], columns=["run", "label", "cost_s"])
    print(table.groupby("run", observed=True).agg({"label": "mean", "cost_s": "sum"}).round(2))


if __name__ == "__main__":
    main(*(sys.argv[1:] or ["example-runs"]))
