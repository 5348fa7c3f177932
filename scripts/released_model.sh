#!/usr/bin/env bash
# The released model and its benchmark, from nothing: labels, training, tables.
#
#   scripts/released_model.sh [FOLDER]        (make model)
#
# Everything lies below FOLDER (build/model). Finished steps are skipped: the same command continues where it
# stopped. DATAGEN_ASSETS names the folder that has ycb/ and procthor/. Sizes can be set from outside
# (LABELS=3000 MIX=3000 EACH=600 scripts/released_model.sh FOLDER).
set -euo pipefail
ROOT=$(realpath "$(dirname "$0")/..")
. "$ROOT/scripts/campaign.sh"
OUT=$(realpath -m "${1:-$ROOT/build/model}")
LABELS=${LABELS:-200010}  # at open tops, within reach of a scaled Panda
MIX=${MIX:-24000}         # of that arm at places of all kinds
EACH=${EACH:-3600}        # of each other arm there
EPOCHS=${EPOCHS:-12}
OTHERS="fetch xarm7 tiago-pro ur5 stretch3"

need_assets_and_programs
mkdir -p "$OUT"
cd "$OUT"
submit() { # NAME ROBOT LABELS SPLIT SEED CANDIDATES-A-SCENE [OPTION...]
    local name=$1 robot=$2 n=$3 split=$4 seed=$5 each=$6
    shift 6
    step "$name"
    datagen submit plan --robot "$robot" --n "$n" --split "$split" --seed "$seed" --candidates in-range \
        --candidates-per-scene "$each" --out "$name" --houses "procthor:$ASSETS/procthor" --objects ycb:objects/train "$@"
}

[ -f objects/test/objects.json ] || datagen assets split "$ASSETS/ycb" objects
printf '[scene]\nplaces = {}\n' > tops.toml
submit tops panda-scaled "$LABELS" train 301 30 --config tops.toml
submit tops-val panda-scaled 3000 val 203 15 --config tops.toml
submit mix-panda-scaled panda-scaled "$MIX" train 401 30
submit val panda-scaled 3000 val 402 30
seed=403
for robot in $OTHERS; do
    submit "mix-$robot" "$robot" "$EACH" train "$seed" 30
    seed=$((seed + 1))
done
step "the benchmark's runs"
datagen benchmark make --houses "procthor:$ASSETS/procthor" --objects "ycb:$ASSETS/ycb" --out runs
step "training on open tops"
datagen train sim-only tops --val tops-val --epochs "$EPOCHS" --model-config width=96 --model-config embedding=160 \
    --seed 1 --encoded inputs --threads 1 --out tops.ckpt
step "training on all places and arms"
mixes=(mix-panda-scaled)
for robot in $OTHERS; do mixes+=("mix-$robot"); done
datagen train stage2 "${mixes[@]}" --val val --init tops.ckpt --model-config kinematics=true --epochs 8 \
    --encoded mixed-inputs --threads 1 --out model.ckpt
step scores
[ board.json -nt model.ckpt ] || datagen benchmark score model.ckpt scalars reachability reach-share distance proximity \
    --runs runs --fit val --out board.json --out board.html
step "all is done"
