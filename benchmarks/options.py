"""Options that benchmarks over drawn scenes share."""

from __future__ import annotations

import argparse


def scene_options(about: str | None) -> argparse.ArgumentParser:
    """A parser with the sources, number and seed of drawn scenes."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    return parser
