#!/usr/bin/env bash
# The released model, its benchmark and its closed loop, from nothing: labels, training, tables.
#
#   scripts/released_model.sh [FOLDER]        (make model)
#
# Everything lies below FOLDER (build/model). Finished steps are skipped: the same command continues where it
# stopped. DATAGEN_ASSETS names the folder that has ycb/ and procthor/. Sizes can be set from outside
# (LABELS=3000 SCENES=20 scripts/released_model.sh FOLDER).
set -euo pipefail
ROOT=$(realpath "$(dirname "$0")/..")
. "$ROOT/scripts/campaign.sh"
OUT=$(realpath -m "${1:-$ROOT/build/model}")
LABELS=${LABELS:-200010}  # within reach, in training houses
EPOCHS=${EPOCHS:-12}
SCENES=${SCENES:-150}     # whole grids of the closed loop

need_assets_and_programs
mkdir -p "$OUT"
cd "$OUT"
printf '[scene]\nplaces = {}\n' > tops.toml # open tops alone
submit() {
    local name=$1 n=$2 split=$3 seed=$4 each=$5
    step "$name"
    datagen submit plan --n "$n" --split "$split" --seed "$seed" --candidates in-range --candidates-per-scene "$each" \
        --config tops.toml --out "$name" --houses "procthor:$ASSETS/procthor" --objects ycb:objects/train
}

[ -f objects/test/objects.json ] || datagen assets split "$ASSETS/ycb" objects
submit train "$LABELS" train 301 30
submit val 3000 val 203 15
step "the benchmark's runs"
datagen benchmark make --houses "procthor:$ASSETS/procthor" --objects "ycb:$ASSETS/ycb" --out runs
step training
datagen train sim-only train --val val --epochs "$EPOCHS" --model-config width=96 --model-config embedding=160 \
    --seed 1 --encoded inputs --threads 1 --out model.ckpt
step scores
[ board.json -nt model.ckpt ] || datagen benchmark score model.ckpt scalars reachability distance proximity \
    --runs runs --fit val --out board.json --out board.html
step "closed loop"
[ loop.json -nt model.ckpt ] || datagen evaluate model.ckpt runs/grids --fit val --baselines scalars --baselines reachability \
    --baselines distance --closed-loop "$SCENES" --out loop.json --out loop.html
step "all is done"
