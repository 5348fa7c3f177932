#!/usr/bin/env bash
# The released model and its benchmark, from nothing: labels, training, tables.
#
#   scripts/released_model.sh [FOLDER]        (make model)
#
# Everything lies below FOLDER (build/model). Finished steps are skipped: the same command continues where it
# stopped. DATAGEN_ASSETS names the folder that has ycb/ and procthor/. Sizes can be set from outside
# (TOPS=600 MIX=600 HARD=600 EACH=600 VAL=600 EPOCHS=1 scripts/released_model.sh FOLDER).
set -euo pipefail
ROOT=$(realpath "$(dirname "$0")/..")
. "$ROOT/scripts/campaign.sh"
OUT=$(realpath -m "${1:-$ROOT/build/model}")
TOPS=${TOPS:-30000}  # on open tops, of a scaled Panda
MIX=${MIX:-40000}    # of that arm at places of all kinds
HARD=${HARD:-40000}  # of that arm in scenes of which four in five are decisive
EACH=${EACH:-8000}   # of each other arm there
VAL=${VAL:-3000}
EPOCHS=${EPOCHS:-12}
OTHERS="fetch xarm7 tiago-pro ur5 stretch3"

need_assets_and_programs
mkdir -p "$OUT"
cd "$OUT"
submit() { # NAME ROBOT LABELS SPLIT SEED [OPTION...]
    local name=$1 robot=$2 n=$3 split=$4 seed=$5
    shift 5
    step "$name"
    datagen submit plan --robot "$robot" --n "$n" --split "$split" --seed "$seed" --candidates in-range \
        --candidates-per-scene 20 --out "$name" --houses "procthor:$ASSETS/procthor" --objects ycb:objects/train "$@"
    [ "$split" = train ] || return 0
    step "$name from another viewpoint"
    datagen submit plan --scenes-from "$name" --view 1 --n "$n" --out "views/$name"
    mixes+=("$name") views+=("views/$name")
}
mixes=() views=()

[ -d objects/test ] || datagen assets split "$YCB" objects
printf '[scene]\nplaces = {}\n' > tops.toml
printf '[scene]\ndecisive = 0.8\n' > decisive.toml
submit val panda-scaled "$VAL" val 402
submit mix-panda-scaled panda-scaled "$MIX" train 401
submit hard-panda-scaled panda-scaled "$HARD" train 501 --config decisive.toml
submit mix-tops panda-scaled "$TOPS" train 301 --config tops.toml
seed=403
for robot in $OTHERS; do
    submit "mix-$robot" "$robot" "$EACH" train "$seed"
    seed=$((seed + 1))
done
step "training, and beside it the benchmark's runs (runs.log)"
# Training has one thread, since its bits depend on their number; workers leave it a core, as they are nicer, and take
# both when it is done. Jobs in the background do not hear Ctrl-C.
trap 'kill $(jobs -p) 2> /dev/null || true' EXIT
"$BIN/datagen" benchmark make --houses "procthor:$ASSETS/procthor" --objects "ycb:$YCB" --out runs > runs.log 2>&1 &
datagen train sim-only "${mixes[@]}" "${views[@]}" --val val --epochs "$EPOCHS" --model-config width=96 --model-config embedding=160 \
    --model-config kinematics=true --seed 1 --encoded inputs --threads 1 --out model.ckpt
step "the rest of the benchmark's runs"
wait "$!" || { tail -n 3 runs.log >&2 && exit 2; }
step scores
[ board.json -nt model.ckpt ] || datagen benchmark score model.ckpt scalars reachability reach-share distance proximity \
    --runs runs --fit val --out board.json
step "all is done"
